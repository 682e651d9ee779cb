"""Make glibc keep large memory blocks: batched transforms then run about twice as fast."""

from __future__ import annotations

import ctypes
import sys

__all__ = ["keep_big_blocks"]

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def keep_big_blocks() -> None:
    """Raise malloc's thresholds for the whole process (Linux with glibc; no effect elsewhere).

    A library must not change its process, so only commands and benchmarks call this.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(_M_MMAP_THRESHOLD, 1 << 30)
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
    except (OSError, AttributeError):  # musl has no such library
        return
