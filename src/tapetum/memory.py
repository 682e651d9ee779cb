"""Memory that was freed, kept by the process for what comes next."""

from __future__ import annotations

import functools

import numpy as np

__all__ = ["keep_freed"]

# A little below the most that glibc takes for a threshold.
_MOST = 2**25 - 2**16


@functools.cache
def keep_freed() -> None:
    """Have the C library keep up to some tens of megabytes of freed memory.

    glibc returns large blocks to the system when they are freed, and the system clears each of their pages when they
    are asked for again: of a frame of five megapixels, which needs a dozen blocks of a few megabytes, that takes longer
    than half of the search for spots. The library returns no block smaller than the largest that was freed so far, up
    to 32 MB (`mallopt`, M_MMAP_THRESHOLD): so one is asked for here, which is never written to, and freed. Where a
    person has set a threshold, and in other libraries, this changes nothing.

    Examples
    --------
    >>> keep_freed()
    """
    np.empty(_MOST, np.uint8)
