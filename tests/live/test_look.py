"""Cameras of ours by their look: what a look is, what is ignored by it, and what is told of all the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.live.conftest import Scripted, watched

from tapetum.errors import InputError
from tapetum.live.events import Event, Ignored
from tapetum.live.log import Log
from tapetum.live.look import LEAST, NAMES, distance, look
from tapetum.live.loop import Watch
from tapetum.live.state import State
from tapetum.record.source import Frame

RATE = 10


_REACH = 48
# A picture's noise is a piece of this one: a new one for each would take longer than to watch it.
_NOISE = np.random.default_rng(0).normal(0, 1, (640, 800)).astype(np.float32)


def drawn(*places: tuple[float, float, str], seed: int = 0) -> np.ndarray:
    """A dark bench with returns: a disc with rings, or a wide one with a fringe."""
    image = np.full((480, 640), 8.0, np.float32)
    for x, y, kind in places:
        top, left = round(y) - _REACH, round(x) - _REACH
        rows, columns = np.mgrid[top : top + 2 * _REACH, left : left + 2 * _REACH]
        away = np.hypot(columns - x, rows - y)
        radius = 22.0 if kind == "rings" else 34.0
        light = (
            110 * (0.6 + 0.4 * np.cos(0.5 * away)) if kind == "rings" else 150 * (1 + 0.7 * np.cos(0.3 * columns)) / 2
        )
        image[top : top + 2 * _REACH, left : left + 2 * _REACH] += light / (1 + np.exp((away - radius) / 1.5))
    down, along = np.random.default_rng(seed).integers(0, 160, 2)
    image += (1 + 0.05 * np.sqrt(image)) * _NOISE[down : down + 480, along : along + 640]
    return np.clip(image, 0, 255).astype(np.uint8)


def film(seconds: float, *places: tuple[float, float, str], start: int = 0) -> list[Frame]:
    count = round(seconds * RATE)
    moved = [[(x + 0.3 * np.sin(k / 5), y, kind) for x, y, kind in places] for k in range(count)]
    return [Frame(start + k, (start + k) / RATE, drawn(*moved[k], seed=start + k)) for k in range(count)]


def watch(frames: list[Frame], log: Log) -> list[dict[str, object]]:
    before = log.newest
    watched(lambda: Scripted(frames), detector="spots", log=log)
    return [one for one in log.events(after=before) if one["kind"] == "seen"]


class Names:
    """Somebody who names the camera as ours by its look, at a frame."""

    def __init__(self, watch: Watch, frame: int) -> None:
        self.watch, self.frame, self.refused = watch, frame, ""

    def event(self, event: Event) -> None: ...

    def state(self, state: State) -> None:
        if state.frame == self.frame:
            try:
                self.watch.ignore_look(state.cameras[0].id)
            except InputError as error:
                self.refused = str(error)

    def close(self) -> None: ...


@pytest.fixture(scope="module")
def named(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log in which the camera with rings was named as ours by its look, while it was followed."""
    path = tmp_path_factory.mktemp("look") / "log.db"
    frames = film(8, (200.0, 150.0, "rings"))
    one = Watch(lambda: Scripted(frames), detector="spots", mode="all", log=Log(path))

    one.listeners.append(Names(one, round(6.5 * RATE)))
    one.start()
    assert one.join(60)
    seen, gone = [event for event in one.log.events() if event["id"] != "source"]
    # Told of until it was named, and then silent, though it was still there.
    assert (seen["kind"], gone["kind"]) == ("seen", "gone") and one.state.health.fault == ""
    assert 6.0 < (gone["utc_ns"] - seen["after"]["since_utc_ns"]) / 1e9 < 6.8
    one.close()
    return path


def test_a_look_does_not_change_by_place_and_turn_and_differs_between_kinds() -> None:
    at = {
        name: drawn((x, y, "rings"), seed=seed)
        for seed, (name, x, y) in enumerate((("a", 200, 150), ("b", 411.4, 310.7)))
    }
    one = look(at["a"], 200, 150, 44, 255)
    other = look(at["b"], 411.4, 310.7, 44, 255)
    turned = look(np.ascontiguousarray(np.rot90(at["a"])), 150, 639 - 200, 44, 255)
    strange = look(drawn((300, 200, "fringe")), 300, 200, 68, 255)
    assert one and other and turned and strange and len(one) == len(NAMES)
    assert max(distance(other, np.array([one])), distance(turned, np.array([one]))) < 0.5
    assert distance(strange, np.array([one])) > 2
    assert look(at["a"], 200, 150, LEAST - 1, 255) is None, "small returns look alike"
    assert look(np.full((480, 640), 255, np.uint8), 200, 150, 44, 255) is None, "saturated"


def test_ours_stays_ignored_elsewhere_and_another_is_told_of(named: Path) -> None:
    log = Log(named)
    assert watch(film(3, (430.0, 300.0, "rings"), start=1000), log) == []
    (seen,) = watch(film(3, (430.0, 300.0, "fringe"), start=2000), log)
    assert abs(seen["after"]["x"] - 430) < 20  # pyright: ignore[reportIndexIssue]
    # Both at once: the stranger only.
    (seen,) = watch(film(3, (150.0, 150.0, "rings"), (480.0, 330.0, "fringe"), start=3000), log)
    assert seen["after"]["x"] > 400  # pyright: ignore[reportIndexIssue]
    log.close()


def test_of_two_that_look_like_ours_one_is_told_of(named: Path) -> None:
    log = Log(named)
    assert len(watch(film(3, (150.0, 150.0, "rings"), (480.0, 330.0, "rings"), start=4000), log)) == 1
    log.close()


def test_ours_is_told_of_once_it_looks_different(named: Path) -> None:
    log = Log(named)
    frames = film(2, (430.0, 300.0, "rings"), start=5000) + film(4, (430.0, 300.0, "fringe"), start=5000 + 2 * RATE)
    (seen,) = watch(frames, log)
    assert seen["kind"] == "seen"
    log.close()


def test_the_list_is_kept_and_undone_one_by_one(named: Path) -> None:
    log = Log(named)
    (one,) = log.ignored()
    assert one.looks and one.id == Ignored.from_text(one.as_text()).id
    log.ignore(Ignored(1.0, 2.0, 3.0))
    log.ignore(Ignored(device="phone-03"))
    log.forget_ignored(Ignored(1.0, 2.0, 3.0))
    assert {each.id for each in log.ignored()} == {one.id, Ignored(device="phone-03").id}
    # As a watch before looks wrote it.
    log._base.execute("INSERT INTO ignored VALUES (?)", ('{"x": 5.0, "y": 6.0, "radius": 7.0, "device": ""}',))
    assert Ignored(5.0, 6.0, 7.0) in log.ignored()
    log.forget_ignored(Ignored(5.0, 6.0, 7.0))
    log.forget_ignored(Ignored(device="phone-03"))
    assert log.ignored() == (one,)
    log.close()


def test_a_return_that_is_too_small_is_no_look(some_seconds: list[Frame]) -> None:
    one = Watch(lambda: Scripted(some_seconds), mode="all")
    names = Names(one, 32)
    one.listeners.append(names)
    one.start()
    assert one.join(60)
    assert "pixels wide: returns below 20 all look alike; ignore it by its place or device" in names.refused
    assert one.log.ignored() == ()
    with pytest.raises(InputError, match="nobody: is not here now"):
        one.ignore_look("nobody")
