"""Which places of the target's field have labels, and where more are wanted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["COLUMNS", "ENOUGH", "FINER", "ROWS", "field_guide", "labels_by_cell", "labels_guide"]

COLUMNS, ROWS = 6, 5
"""Cells of the field along x and y."""
ENOUGH = 3
"""Labels that a cell needs."""
FINER = 2
"""Into so many cells along x and y each is divided for a camera unlike those that a model has seen."""

_WORDS = (("upper", "middle", "lower"), ("left", "centre", "right"))


def labels_by_cell(gaze: NDArray[np.float64], columns: int = COLUMNS, rows: int = ROWS) -> NDArray[np.int64]:
    """Return the number of labels in each cell of the field, [rows, columns].

    Parameters
    ----------
    gaze
        [N, 2], in fractions of the field from its centre, x right and y down; places outside count in the next cell.
    columns, rows
        Cells along x and y.
    """
    cells = np.zeros((rows, columns), np.int64)
    known = gaze[np.isfinite(gaze).all(axis=1)]
    at = np.clip(((known + 0.5) * (columns, rows)).astype(int), 0, np.array([columns, rows]) - 1)
    np.add.at(cells, (at[:, 1], at[:, 0]), 1)
    return cells


def field_guide(cells: NDArray[np.int64], enough: int = ENOUGH) -> str:
    """Return a drawing of the field, a sign a cell, and a sentence on what is missing.

    `#` has enough labels, `+` some, `.` none. The drawing is that of the target's picture: x right, y down.
    """
    signs = np.where(cells >= enough, "#", np.where(cells > 0, "+", "."))
    lines = ["  ".join(row) for row in signs]
    lacking = np.argwhere(cells < enough)
    if not len(lacking):
        said = f"all {cells.size} places of the field have {enough} labels or more"
    else:
        wanted: dict[str, int] = {}
        for row, column in lacking:
            name = _place(int(row), int(column), cells.shape)
            wanted[name] = wanted.get(name, 0) + 1
        order = sorted(wanted, key=lambda name: -wanted[name])
        said = f"{len(lacking)} of {cells.size} places lack labels; bring the laser's spot to: {', '.join(order)}"
    return "\n".join([*lines, said])


def labels_guide(gaze: NDArray[np.float64]) -> str:
    """Return the drawing of the cells, and of finer ones where all of these have enough labels.

    A camera like those that a model has seen needs no more than the first. Of another one gazes come out wrong most
    where none was labelled near (docs/learning.md, copy 105).

    Parameters
    ----------
    gaze
        As for `labels_by_cell`.
    """
    cells, finer = labels_by_cell(gaze), labels_by_cell(gaze, FINER * COLUMNS, FINER * ROWS)
    if (finer >= ENOUGH).all():
        return field_guide(finer)
    if (cells < ENOUGH).any():
        return field_guide(cells)
    title = "in finer places, which a camera unlike those that a model has seen wants filled:"
    return "\n".join([field_guide(cells), title, field_guide(finer)])


def _place(row: int, column: int, shape: tuple[int, ...]) -> str:
    up = _WORDS[0][3 * row // shape[0]]
    side = _WORDS[1][3 * column // shape[1]]
    return "the centre" if (up, side) == ("middle", "centre") else f"{up} {side}"
