"""Sources and watches for the tests of the live watch."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest

from tapetum.detection import Found
from tapetum.live.loop import Watch
from tapetum.record.drawn_room import DrawnRoom
from tapetum.record.source import Frame, Source
from tapetum.track import cameras


@dataclass
class Scripted:
    """Frames that a test wrote: of a camera (`live`), which fails after them, or stored."""

    frames: Sequence[Frame]
    live: bool = False
    fault: Exception | None = None
    name: str = "scripted"
    full_scale: int = 255
    rate: float | None = 20.0
    closed: threading.Event = field(default_factory=threading.Event)

    @property
    def count(self) -> int | None:
        return None if self.live else len(self.frames)

    @property
    def hardware(self) -> dict[str, Any]:
        return {}

    def __len__(self) -> int:
        return len(self.frames)

    def first(self) -> Frame:
        return self.frames[0]

    def close(self) -> None:
        self.closed.set()

    def __iter__(self) -> Iterator[Frame]:
        yield from self.frames
        if self.fault is not None:
            raise self.fault


def room_frames(seconds: float, *, rate: float = 20.0, start: float = 0.0) -> list[Frame]:
    """Return the drawn room's frames, every other one lit."""
    room = DrawnRoom()
    times = [k / rate for k in range(round(start * rate), round((start + seconds) * rate))]
    return [Frame(k, t, room.picture(t, lit=bool(k % 2)), lit=bool(k % 2)) for k, t in enumerate(times)]


def watched(opens: Callable[[], Source], **options: Any) -> Watch:
    """Watch a source to its end."""
    watch = Watch(opens, **{"mode": "all", **options})
    watch.start()
    assert watch.join(60), "the watch did not end"
    return watch


@pytest.fixture(scope="session")
def searched_once() -> tuple[list[Frame], Callable[..., Found]]:
    """Frames of a room, and a search that keeps what it found in pairs of them; others it searches each time."""
    frames = room_frames(2.4, rate=15.0)
    # A watch copies its frames: they are known by their pixels.
    number = {one.image.tobytes(): k for k, one in enumerate(frames)}
    found, search = dict[tuple[object, ...], Found](), cameras.find_cameras

    def searched(lit: Any, dark: Any, **options: Any) -> Found:
        pair = tuple(None if one is None else number.get(one.tobytes(), -1) for one in (lit, dark))
        if -1 in pair:
            return search(lit, dark, **options)
        key = *pair, *options.items()
        if key not in found:
            found[key] = search(lit, dark, **options)
        return found[key]

    return frames, searched


@pytest.fixture(scope="module")
def some_seconds(searched_once: tuple[list[Frame], Callable[..., Found]]) -> Iterator[list[Frame]]:
    """Frames enough for cameras to be seen before the source ends.

    Nearly all of a watch's time is the search, which finds the same in the same pictures: each pair is searched once.
    """
    frames, searched = searched_once
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cameras, "find_cameras", searched)
        yield frames


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright
    from tests.live.pages import CHROMIUM

    if not CHROMIUM:
        pytest.skip("Chromium is not installed: apt install chromium")
    with sync_playwright() as play:
        # Its sandbox refuses root.
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = play.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield browser
        browser.close()
