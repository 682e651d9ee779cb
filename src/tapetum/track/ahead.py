"""Reading and detecting ahead of inference, in threads of their own: the order of the frames stays.

Reading, detection and inference compute outside Python's lock for most of their time. A second thread that detects
gained nothing on two cores: it took from inference what it gave.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from typing import TypeAlias

from tapetum.record.source import Frame
from tapetum.track.detections import Detections

__all__ = ["found_ahead", "found_next"]

# Frames that wait, and one more in each thread.
_WAITING = 2
# Seconds between two looks whether nobody wants more, and for which a read under way is waited for.
_LOOK, _PATIENCE = 0.1, 5.0

Item: TypeAlias = tuple[Frame, "Future[Detections]"] | BaseException | None


def found_ahead(frames: Iterable[Frame], find: Callable[[Frame], Detections]) -> Iterator[tuple[Frame, Detections]]:
    """Yield each frame with its spots, in order, while the next ones are read and searched.

    Parameters
    ----------
    frames
        Read in a thread of its own, a few frames ahead. It is closed there when it ends or nobody wants more.
    find
        The detector. It gets the frames in order, one after another, in one thread.

    Raises
    ------
    BaseException
        What reading or detecting raised, after the frames before it.
    """
    ready: queue.Queue[Item] = queue.Queue(_WAITING)
    over = threading.Event()

    def offered(item: Item) -> bool:
        while not over.is_set():
            with suppress(queue.Full):
                ready.put(item, timeout=_LOOK)
                return True
        return False

    def read() -> None:
        end: BaseException | None = None
        walk = iter(frames)
        try:
            for frame in walk:
                if over.is_set() or not offered((frame, pool.submit(find, frame))):
                    break
        except BaseException as error:
            end = error
        finally:
            # A generator is closed by the thread that runs it.
            close = getattr(walk, "close", None)
            if close is not None:
                with suppress(Exception):
                    close()
            offered(end)

    pool = ThreadPoolExecutor(1, "detect")
    thread = threading.Thread(target=read, name="read", daemon=True)
    thread.start()
    try:
        while (item := ready.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item[0], item[1].result()
    finally:
        over.set()
        # A generator that nobody holds any more may be closed in one of these threads, which cannot wait for itself.
        with suppress(RuntimeError):
            thread.join(_PATIENCE)
        with suppress(RuntimeError):
            pool.shutdown(cancel_futures=True)


def found_next(frames: Iterable[Frame], find: Callable[[Frame], Detections]) -> Iterator[tuple[Frame, Detections]]:
    """Yield each frame with its spots, in order, while the next one is asked for and searched.

    Of a camera that is watched a frame that waits grows old: so one frame is taken ahead of what follows, and no more.

    Parameters
    ----------
    frames
        Asked in a thread of its own for one frame when the one before it is yielded. They must end soon when whoever
        wants no more says so to them: for this long closing waits, up to some seconds.
    find
        The detector. It gets the frames in order, one after another, in that thread.

    Raises
    ------
    BaseException
        What reading or detecting raised, after the frame before it.
    """
    walk = iter(frames)

    def step() -> tuple[Frame, Detections] | None:
        frame = next(walk, None)
        return None if frame is None else (frame, find(frame))

    pool = ThreadPoolExecutor(1, "detect")
    coming = pool.submit(step)
    try:
        while (pair := coming.result()) is not None:
            coming = pool.submit(step)
            yield pair
    finally:
        over, _ = wait([coming], _PATIENCE)
        pool.shutdown(wait=bool(over), cancel_futures=True)
