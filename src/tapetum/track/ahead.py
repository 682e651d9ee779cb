"""Reading and detecting ahead of inference, in two threads of their own: the order of the frames stays.

Reading, detection and inference compute outside Python's lock for most of their time. A second thread that detects
gained nothing on two cores: it took from inference what it gave.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import TypeAlias

from tapetum.record.source import Frame
from tapetum.track.detections import Detections

__all__ = ["found_ahead"]

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

    with ThreadPoolExecutor(1, "detect") as pool:
        thread = threading.Thread(target=read, name="read", daemon=True)
        thread.start()
        try:
            while (item := ready.get()) is not None:
                if isinstance(item, BaseException):
                    raise item
                yield item[0], item[1].result()
        finally:
            over.set()
            thread.join(_PATIENCE)
            pool.shutdown(wait=False, cancel_futures=True)
