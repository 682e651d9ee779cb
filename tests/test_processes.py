"""Processes beside this one: they start from one that has loaded the libraries, and keep their memory."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import psutil
import pytest

from tapetum.memory import MALLOC
from tapetum.processes import begin_beside, context_of


class MallInfo(ctypes.Structure):
    """What glibc's mallinfo2 returns; `hblks` counts the blocks that it asked of the system one by one."""

    _names = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"
    _fields_ = tuple((name, ctypes.c_size_t) for name in _names.split())


def blocks_of_their_own() -> int:
    """How many of three arrays of 64 MB get a block of the system's own."""
    info = ctypes.CDLL("libc.so.6").mallinfo2
    info.restype = MallInfo
    before = info().hblks
    arrays = [np.ones(1 << 23) for _ in range(3)]
    return int(info().hblks - before) * (len(arrays) > 0)


def parents() -> tuple[int, bool, bool]:
    """Number of this process's parent, whether Ctrl-C is ignored here, and whether NumPy was here at the start."""
    return os.getppid(), signal.getsignal(signal.SIGINT) == signal.SIG_IGN, "numpy" in sys.modules


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere each process imports for itself")
def test_processes_fork_from_one_that_is_none_of_them_and_ctrl_c_is_left_to_this_one() -> None:
    with ProcessPoolExecutor(1, context_of("numpy"), initializer=begin_beside) as pool:
        parent, ignores, loaded = pool.submit(parents).result()
    # The one that they fork from is a child of this process and stays for the next ones.
    assert parent != os.getpid() and psutil.Process(parent).ppid() == os.getpid()
    assert ignores and loaded
    with ProcessPoolExecutor(1, context_of("numpy")) as pool:
        again, ignores, _ = pool.submit(parents).result()
    # Without it they hear Ctrl-C where this process does: what runs in the background may not.
    assert again == parent and ignores == (signal.getsignal(signal.SIGINT) == signal.SIG_IGN)


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="glibc's own count, since 2.33")
def test_large_arrays_stay_with_the_process() -> None:
    with ProcessPoolExecutor(1, context_of("numpy")) as pool:
        assert pool.submit(blocks_of_their_own).result() == 3
    with ProcessPoolExecutor(1, context_of("numpy"), initializer=begin_beside) as pool:
        assert pool.submit(blocks_of_their_own).result() == 0


def test_the_guide_to_clusters_names_what_keeps_memory_there() -> None:
    guide = (Path(__file__).parents[1] / "docs/cluster.md").read_text(encoding="utf-8")
    assert all(f"{name}={value}" in guide for name, value in MALLOC.items())
