"""Make glibc keep big blocks: batched transforms then run some twice as fast, for they stop asking the kernel."""

from __future__ import annotations

import ctypes
import sys

__all__ = ["keep_big_blocks"]

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def keep_big_blocks() -> None:
    """Raise malloc's thresholds for the whole process (Linux with glibc; elsewhere nothing happens).

    A command owns its process and may do so; a library may not, so nothing but commands and benchmarks calls this.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(_M_MMAP_THRESHOLD, 1 << 30)
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
    except (OSError, AttributeError):  # musl has no such library or call, and needs none
        return
