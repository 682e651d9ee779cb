"""Windows of different sizes laid out on one picture, so that one call treats them all.

A call takes ten microseconds however few pixels it gets; thirty spots with a dozen steps each are hundreds of calls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

__all__ = ["Window", "laid_out"]

Window = tuple[slice, slice]


def laid_out(sizes: Sequence[tuple[int, int]], step: int = 1) -> tuple[list[Window], tuple[int, int]]:
    """Lay windows of sizes (height, width) out in rows, the highest first; they do not overlap.

    Returns where each lies, in the order of `sizes`, and the size of the sheet. Corners and the sheet's sides are
    multiples of `step`.

    Examples
    --------
    >>> laid_out([(2, 3), (5, 3)], 4)
    ([(slice(0, 2, None), slice(4, 7, None)), (slice(0, 5, None), slice(0, 3, None))], (8, 8))
    """

    def up(size: int) -> int:
        return -(-size // step) * step

    # A little wider than high, for rows are not filled to their ends.
    wide = max(math.isqrt(sum(up(h) * up(w) for h, w in sizes)) * 5 // 4, *(up(w) for _, w in sizes))
    windows: list[Window] = [(slice(0), slice(0))] * len(sizes)
    top = left = right = row = 0
    for n in sorted(range(len(sizes)), key=lambda n: -sizes[n][0]):
        height, width = sizes[n]
        if left and left + width > wide:
            top, left, row = top + row, 0, 0
        windows[n] = slice(top, top + height), slice(left, left + width)
        left, row = left + up(width), max(row, up(height))
        right = max(right, left)
    return windows, (top + row, right)
