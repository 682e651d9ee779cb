"""Processes beside this one: they start from one that has loaded the libraries, and keep their memory."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.context import BaseContext
from pathlib import Path

import numpy as np
import psutil
import pytest

from tapetum.memory import MALLOC
from tapetum.processes import begin_beside

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere each process imports for itself")
glibc = pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="glibc's own count, since 2.33")


class MallInfo(ctypes.Structure):
    """What glibc's mallinfo2 returns; `hblks` counts the blocks that it asked of the system one by one."""

    _names = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"
    _fields_ = tuple((name, ctypes.c_size_t) for name in _names.split())


def blocks_of_their_own() -> int:
    """How many of three arrays of 64 MB get a block of the system's own."""
    info = ctypes.CDLL(None).mallinfo2
    info.restype = MallInfo
    before, arrays = info().hblks, [np.ones(1 << 23) for _ in range(3)]
    found = info().hblks - before
    del arrays
    return int(found)


def arenas_of_threads(path: Path) -> int:
    """How many pools of memory three threads add that allocate at the same time."""
    libc = ctypes.CDLL(None)
    libc.fopen.restype = libc.malloc.restype = ctypes.c_void_p

    def arenas() -> int:
        file = ctypes.c_void_p(libc.fopen(str(path).encode(), b"w"))
        libc.malloc_info(0, file)
        libc.fclose(file)
        return path.read_text(encoding="utf-8").count("<heap nr=")

    before, together = arenas(), threading.Barrier(4)

    def allocate() -> None:
        libc.malloc(ctypes.c_size_t(100_000))
        together.wait()

    for _ in range(3):
        threading.Thread(target=allocate).start()
    together.wait()
    return arenas() - before


def parent_and_ctrl_c() -> tuple[int, bool]:
    """Number of this process's parent, and whether Ctrl-C is ignored here."""
    return os.getppid(), signal.getsignal(signal.SIGINT) == signal.SIG_IGN


@linux
def test_processes_fork_from_one_that_is_none_of_them_and_ctrl_c_is_left_to_this_one(processes: BaseContext) -> None:
    with ProcessPoolExecutor(1, processes, initializer=begin_beside) as pool:
        parent, ignores = pool.submit(parent_and_ctrl_c).result()
    # The one that they fork from is a child of this process and stays for the next ones.
    assert parent != os.getpid() and psutil.Process(parent).ppid() == os.getpid() and ignores
    with ProcessPoolExecutor(1, processes) as pool:
        again, ignores = pool.submit(parent_and_ctrl_c).result()
    # Without it they hear Ctrl-C where this process does: what runs in the background may not.
    assert again == parent and ignores == (signal.getsignal(signal.SIGINT) == signal.SIG_IGN)


@linux
def test_what_processes_need_is_loaded_once(tmp_path: Path) -> None:
    # In a program of its own: here the one that processes fork from may run already.
    library = "import os\nloader = os.getpid()\ndef where():\n    return loader, os.getpid()\n"
    (tmp_path / "library.py").write_text(library)
    program = tmp_path / "program.py"
    program.write_text(
        "from concurrent.futures import ProcessPoolExecutor\n"
        "from tapetum.processes import context_of\n"
        "if __name__ == '__main__':\n"
        "    import library\n"
        "    for _ in range(2):\n"
        "        with ProcessPoolExecutor(1, context_of('library')) as pool:\n"
        "            print(*pool.submit(library.where).result())\n"
    )
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path}
    told = subprocess.check_output([sys.executable, program], text=True, timeout=60, env=environment)
    (loader, one), (again, other) = (line.split() for line in told.splitlines())
    assert loader == again and len({loader, one, other}) == 3


@glibc
def test_large_arrays_stay_with_the_process(processes: BaseContext) -> None:
    with ProcessPoolExecutor(1, processes) as pool:
        assert pool.submit(blocks_of_their_own).result() == 3
    with ProcessPoolExecutor(1, processes, initializer=begin_beside) as pool:
        assert pool.submit(blocks_of_their_own).result() == 0


@glibc
def test_threads_share_one_pool_of_memory(processes: BaseContext, tmp_path: Path) -> None:
    with ProcessPoolExecutor(1, processes) as pool:
        assert pool.submit(arenas_of_threads, tmp_path / "a").result() > 0
    with ProcessPoolExecutor(1, processes, initializer=begin_beside) as pool:
        assert pool.submit(arenas_of_threads, tmp_path / "b").result() == 0


def test_the_guide_to_clusters_names_what_keeps_memory_there() -> None:
    guide = (Path(__file__).parents[1] / "docs/cluster.md").read_text(encoding="utf-8")
    assert all(f"{name}={value}" in guide for name, value in MALLOC.items())
