"""How long work reports its progress: one protocol that every room can take, and one bar that the commands pass.

A function that works long takes `progress: Progress = quiet` and wraps its loop:
`for x in progress(items, "filming", total=n)`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

__all__ = ["Progress", "bar", "quiet"]

T = TypeVar("T")


class Progress(Protocol):
    """Passes the items of an iterable on, unchanged, while it shows how far the loop is."""

    def __call__(self, items: Iterable[T], what: str, *, total: int | None = None) -> Iterator[T]: ...


def quiet(items: Iterable[T], what: str, *, total: int | None = None) -> Iterator[T]:
    """Show nothing."""
    del what, total
    yield from items


def bar(items: Iterable[T], what: str, *, total: int | None = None) -> Iterator[T]:
    """Show a bar with the time left on standard error; where that is no terminal, one line when the loop is done."""
    # Rich is slow to import, and most uses of the library never show a bar.
    from rich import progress as rich
    from rich.console import Console

    if total is None:
        # An object with a length may still refuse to give it, as an iterable dataset's loader does.
        with contextlib.suppress(TypeError, NotImplementedError):
            total = len(items)  # type: ignore[arg-type]
    console = Console(stderr=True)
    if not console.is_terminal:
        # In a log one line is enough, and of a loop that failed the error says why.
        start, done = time.monotonic(), 0
        for item in items:
            yield item
            done += 1
        console.print(f"{what}: {done} in {time.monotonic() - start:.1f} s", markup=False, soft_wrap=True)
        return
    counts = (rich.BarColumn(bar_width=30), rich.MofNCompleteColumn(), rich.TimeElapsedColumn())
    left = (rich.TextColumn("left"), rich.TimeRemainingColumn())
    with rich.Progress(rich.TextColumn("{task.description:<28}"), *counts, *left, console=console) as shown:
        yield from shown.track(items, total=total, description=what)
