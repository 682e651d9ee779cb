"""Which places of the field lack labels."""

from __future__ import annotations

import numpy as np

from tapetum.data.field import field_guide, labels_by_cell, labels_guide


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


def test_finer_places_are_drawn_where_the_coarse_ones_have_enough() -> None:
    x, y = np.meshgrid((np.arange(24) + 0.5) / 24 - 0.5, (np.arange(20) + 0.5) / 20 - 0.5)
    everywhere = np.stack([x, y], axis=-1).reshape(-1, 2)
    assert labels_guide(everywhere).splitlines()[-1] == "all 120 places of the field have 3 labels or more"
    # A hole in the lower left corner that only the finer places show.
    holed = everywhere[(everywhere[:, 0] > -0.42) | (everywhere[:, 1] < 0.4)]
    drawn = labels_guide(holed).splitlines()
    assert drawn[5] == "all 30 places of the field have 3 labels or more" and drawn[6].startswith("in finer places")
    assert (
        drawn[-2].startswith(".  #")
        and drawn[-1] == "1 of 120 places lack labels; bring the laser's spot to: lower left"
    )
    # Where a coarse place lacks labels, that comes first.
    assert labels_guide(everywhere[everywhere[:, 0] < 0.3]).splitlines()[-1].startswith("5 of 30 places lack labels")
