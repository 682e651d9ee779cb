"""BLAS in one thread, for as long as anybody wants it.

OpenBLAS divides even small products, and its threads spin for milliseconds after each: detection, which makes many of
them, then keeps all cores busy and takes them from inference beside it.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np  # noqa: F401, its BLAS is to be loaded before it is looked for
from threadpoolctl import ThreadpoolController

__all__ = ["one_blas_thread"]

_lock = threading.Lock()
_wanted = 0
_limit: Any = None


@functools.cache
def _controller() -> ThreadpoolController:
    """Find the libraries, which takes a millisecond, once."""
    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep BLAS to one thread, in the whole process, until the last of those that overlap has ended.

    Each of them alone would give back the number of threads that it found, which for the second is one.

    Examples
    --------
    >>> with one_blas_thread():
    ...     pass
    """
    global _wanted, _limit
    with _lock:
        if _wanted == 0:
            _limit = _controller().limit(limits=1, user_api="blas")
        _wanted += 1
    try:
        yield
    finally:
        with _lock:
            _wanted -= 1
            if _wanted == 0:
                _limit.restore_original_limits()
                _limit = None
