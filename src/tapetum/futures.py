"""Results of work in other threads or processes, in the order in which it was asked for."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import Future
from typing import TypeVar

__all__ = ["in_order"]

T = TypeVar("T")


def in_order(submitted: Iterable[Future[T]], held: int) -> Generator[T]:
    """Yield the results of futures in their order; `held` of them are asked for before the first is waited for.

    Raises what the work raised, at its turn; what has not begun by then is cancelled.
    """
    waiting: deque[Future[T]] = deque()
    try:
        for one in submitted:
            waiting.append(one)
            if len(waiting) >= held:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for one in waiting:
            one.cancel()
