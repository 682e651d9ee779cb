"""Many frames, several at once: by threads, or by processes that see frames in shared memory.

Half of a search is Python code, which only one thread of an interpreter runs at a time; processes run it at once. On a
machine busy with other work processes were slower all the same; on an idle one they have not been measured.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from tapetum.blas import one_blas_thread
from tapetum.detection.find import find_cameras
from tapetum.detection.found import Found
from tapetum.errors import InputError
from tapetum.futures import in_order
from tapetum.processes import begin_beside, context_of

__all__ = ["find_each"]

Pair = tuple[NDArray[np.generic], NDArray[np.generic] | None]
# Where a frame lies in shared memory: its shape, its type and its first byte.
Lies = tuple[tuple[int, ...], str, int]


def find_each(frames: Iterable[Pair], *, threads: int = 2, processes: int = 0, **options: Any) -> Generator[Found]:
    """Find cameras in many frames, several at once: `find_cameras` of each lit frame and its dark one, or None.

    At most twice as many frames as threads or processes are held. Threads share the work where OpenCV and numpy release
    the interpreter; BLAS keeps to one thread until the last frame, as threads of its own only take cores from other
    frames. Processes share nothing but the frames, which are copied once; each takes a second or so to start, and a
    script that asks for them keeps its own work under ``if __name__ == "__main__":``.

    Parameters
    ----------
    frames
        Lit and dark frames, as for `find_cameras`; read as they are wanted.
    threads
        How many frames are searched at once by threads.
    processes
        How many are by processes; 0: none, threads are used.
    **options
        As for `find_cameras`.

    Yields
    ------
    Found
        In the order of the frames.

    Raises
    ------
    InputError
        What `find_cameras` raises, at the frame's turn.
    """
    if threads < 1:
        raise InputError(f"must be at least 1, is {threads}", where="threads")
    if processes < 0:
        raise InputError(f"must be at least 0, is {processes}", where="processes")
    with contextlib.ExitStack() as stack:
        submit = _by_processes(stack, processes, options) if processes else _by_threads(stack, threads, options)
        held = 2 * (processes or threads)
        # Each with the number of a place that is free.
        found = (submit(number % held, lit, dark) for number, (lit, dark) in enumerate(frames))
        yield from in_order(found, held)


Submit = Callable[[int, NDArray[np.generic], NDArray[np.generic] | None], "Future[Found]"]


def _by_threads(stack: contextlib.ExitStack, threads: int, options: dict[str, Any]) -> Submit:
    stack.enter_context(one_blas_thread())
    pool = stack.enter_context(ThreadPoolExecutor(threads))
    return lambda _, lit, dark: pool.submit(find_cameras, lit, dark, **options)


def _by_processes(stack: contextlib.ExitStack, processes: int, options: dict[str, Any]) -> Submit:
    places: list[SharedMemory | None] = [None] * (2 * processes)

    def released() -> None:
        for one in places:
            if one is not None:
                one.close()
                one.unlink()

    stack.callback(released)
    context = context_of("tapetum.detection.find")
    pool = stack.enter_context(ProcessPoolExecutor(processes, mp_context=context, initializer=_alone))

    def submit(number: int, lit: NDArray[np.generic], dark: NDArray[np.generic] | None) -> Future[Found]:
        arrays = [np.asarray(one) for one in (lit, dark) if one is not None]
        size = max(1, sum(one.nbytes for one in arrays))
        place = places[number]
        if place is None or place.size < size:
            if place is not None:
                place.close()
                place.unlink()
            place = places[number] = SharedMemory(create=True, size=size)
        lies: list[Lies] = []
        first = 0
        for one in arrays:
            if one.dtype.hasobject:
                raise InputError(f"pixels of type {one.dtype} are no levels", where="lit", remedy="give uint8 or float")
            np.ndarray(one.shape, one.dtype, place.buf, first)[...] = one
            lies.append((one.shape, one.dtype.str, first))
            first += one.nbytes
        return pool.submit(_search, place.name, tuple(lies), options)

    return submit


def _alone() -> None:
    """Make a process ready: one thread, and Ctrl-C is its parent's."""
    begin_beside()
    cv2.setNumThreads(1)
    threadpool_limits(1, user_api="blas")


@functools.lru_cache(maxsize=64)
def _attached(name: str) -> SharedMemory:
    """Shared memory that another process holds and gives back."""
    return SharedMemory(name)


def _search(name: str, lies: tuple[Lies, ...], options: dict[str, Any]) -> Found:
    memory = _attached(name)
    arrays = [np.ndarray(shape, dtype, memory.buf, first) for shape, dtype, first in lies]
    return find_cameras(arrays[0], arrays[1] if len(arrays) > 1 else None, **options)
