"""Models by turns: whose turn it is, and how many a budget allows."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.record.source import Frame
from tapetum.track.detections import Detections
from tapetum.track.pipeline import track
from tapetum.track.turns import Turns


def spots(count: int, frame: int = 0) -> Frame:
    """A dark frame with bright squares in a row, each a little farther in every frame."""
    image = np.random.default_rng(frame).normal(8, 1, (120, 80 * count)).clip(0, 255).astype(np.uint8)
    for k in range(count):
        image[50:58, 80 * k + 30 + frame % 3 : 80 * k + 38 + frame % 3] = 200
    return Frame(frame, frame / 20, image)


class Slow:
    """A model that takes a time for each crop, and notes how many it was shown."""

    target_names = ("gaze_x",)

    def __init__(self, seconds: float) -> None:
        self.seconds, self.shown = seconds, []

    def predict(self, crops: np.ndarray, full_scale: float) -> Any:
        self.shown.append(len(crops))
        time.sleep(self.seconds * len(crops))
        count = len(crops)

        class Said:
            def columns(self) -> dict[str, list[Any]]:
                return {"gaze_x": [0.1] * count, "applies": [True] * count, "reason": [""] * count}

        return Said()


def test_every_spot_gets_its_turn_and_the_frame_rate_stays() -> None:
    model, turns = Slow(0.002), Turns(0.009)
    asked: dict[int, list[int]] = {}
    frames = [spots(9, k) for k in range(40)]
    for tracked in track(frames, model=model, batch=1, turns=turns, side=40):  # pyright: ignore[reportArgumentType]
        for row in tracked.rows:
            if "applies" in row.estimates:
                asked.setdefault(row.track, []).append(tracked.frame)
    # Some of nine in each frame, by what they take; never more than the budget by far.
    assert 1 <= max(model.shown[5:]) <= 5 and min(model.shown) >= 1
    assert len(asked) == 9
    for frames_of_one in asked.values():
        gaps = np.diff(frames_of_one)
        assert gaps.max() <= 15, "one waits while others are asked again"


def test_few_spots_are_asked_about_in_every_frame() -> None:
    model = Slow(0.0)
    frames = [spots(2, k) for k in range(10)]
    list(track(frames, model=model, batch=1, turns=Turns(10.0), side=40))  # pyright: ignore[reportArgumentType]
    assert model.shown == [2] * 10


def test_new_spots_come_first_and_the_count_follows_the_time() -> None:
    turns = Turns(0.02)
    found = Detections.of({**{name: np.zeros(4) for name in Detections.names()}, "ghost": np.zeros(4, bool)})
    found.x[:] = [0, 100, 200, 300]
    assert turns.choose(found).tolist() == [0, 1]
    turns._known = {1: (0.0, 0.0, 5.0), 2: (100.0, 0.0, 4.0), 3: (200.0, 0.0, 6.0)}
    assert turns.choose(found).tolist() == [1, 3]
    turns.spent(2, 0.2)
    assert turns.choose(found).tolist() == [3]
    turns.spent(1, 0.001)
    assert len(turns.choose(found)) == 2
    found.ghost[:] = True
    assert turns.choose(found).tolist() == []
    with pytest.raises(InputError, match="budget: must be positive"):
        Turns(0)
