"""Which places of the field lack labels."""

from __future__ import annotations

import numpy as np

from tapetum.data.field import field_guide, labels_by_cell


def test_each_label_counts_in_the_cell_where_the_target_sees_the_laser() -> None:
    # Upper left, lower right, beyond the edge, and one that is not known.
    gaze = np.array([[-0.49, -0.49], [0.49, 0.49], [0.7, 0.0], [np.nan, 0.1]])
    cells = labels_by_cell(gaze, 3, 3)
    np.testing.assert_array_equal(cells, [[1, 0, 0], [0, 0, 1], [0, 0, 1]])


def test_the_drawing_says_where_to_go() -> None:
    cells = np.full((5, 6), 9)
    assert field_guide(cells).splitlines()[-1] == "all 30 places of the field have 3 labels or more"
    cells[0, 0], cells[4, 5], cells[4, 4] = 0, 1, 0
    drawn = field_guide(cells).splitlines()
    assert drawn[0].startswith(".  #") and drawn[4].endswith("#  .  +")
    assert drawn[-1] == "3 of 30 places lack labels; bring the laser's spot to: lower right, upper left"
