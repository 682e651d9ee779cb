"""Leaks: each kind, planted, is found and named; where none is planted nothing is found."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter1d
from threadpoolctl import threadpool_limits

from tapetum.data import dataset_from_arrays
from tapetum.data.leaks import Leak, find_leaks, score_leaks

SIDE = 48
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Small matrices gain nothing by threads, which on a busy machine lose seconds waiting for each other."""
    with threadpool_limits(1):
        yield


def wander(rng: np.random.Generator, count: int, width: int) -> np.ndarray:
    """Smooth motion of a hand in `width` directions, some ten independent stretches a recording; [count, width]."""
    path = gaussian_filter1d(rng.normal(size=(count, width)), 4.0, axis=0, mode="reflect")
    return path / path.std(axis=0)


class Made:
    """Recordings of an RR whose shape tells gaze and device; to be spoilt, then turned into a dataset."""

    def __init__(self, seed: int = 0, *, recordings: int = 6, frames: int = 100, tail: float = 1.0) -> None:
        self.rng = np.random.default_rng(seed)
        count = recordings * frames
        self.recording = np.repeat(np.arange(recordings), frames)
        self.device = self.recording % 3
        self.time = np.tile(np.arange(frames) / 15, recordings)
        self.split = (self.time >= 0.8 * frames / 15).astype(int)
        motion = np.concatenate([wander(self.rng, frames, 4) for _ in range(recordings)])
        self.gaze, self.centre = 0.15 * motion[:, :2], 300 + 40 * motion[:, 2:]
        self.quality = self.rng.uniform(0.8, 1, count)
        self.background = np.full(count, 20.0)
        self.hot_crop: dict[int, tuple[int, int]] = {}
        self.hot_frame: dict[int, np.ndarray] = {}
        self.tail = tail

    def images(self) -> np.ndarray:
        x, y = (self.gaze[:, i, None, None] for i in (0, 1))
        # Two lobes that part with the gaze, and rings whose light falls off with the third power.
        near, far = ((COLUMNS - s * 20 * x) ** 2 + (ROWS - s * 20 * y) ** 2 for s in (1, -1))
        width = 8 + 4 * self.device[:, None, None]
        fall = self.tail * (1 + 2 * x + y) * 3000 / (8 + np.hypot(ROWS, COLUMNS)) ** 3
        light = 80 * (np.exp(-near / width) + 0.7 * np.exp(-far / width)) + fall
        image = light + self.background[:, None, None] + self.rng.normal(0, 2, light.shape)
        for device, (row, column) in self.hot_crop.items():
            image[self.device == device, row, column] += 60
        left, top = np.floor(self.centre - (SIDE - 1) / 2 + 0.5).astype(int).T
        for device, places in self.hot_frame.items():
            for n in np.flatnonzero(self.device == device):
                seen = places - (left[n], top[n])
                seen = seen[((seen >= 0) & (seen < SIDE)).all(axis=1)]
                image[n, seen[:, 1], seen[:, 0]] += 60
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def dataset(self, *targets: str) -> xr.Dataset:
        labels = {
            "gaze_x": self.gaze[:, 0],
            "gaze_y": self.gaze[:, 1],
            "device": np.array(["phone-01", "phone-02", "phone-03"])[self.device],
        }
        kept = {name: labels[name] for name in targets or ("gaze_x", "gaze_y")}
        made = dataset_from_arrays(self.images(), kept, split=self.split, recording=self.recording)
        more = {
            "time": self.time,
            "quality": self.quality,
            "centre_x": self.centre[:, 0],
            "centre_y": self.centre[:, 1],
            # Each label is measured for itself.
            "label_back": np.zeros(len(self.time)),
            "label_ahead": np.zeros(len(self.time)),
        }
        return made.assign({name: ("frame", values) for name, values in more.items()})


def named(leaks: list[Leak]) -> set[tuple[str, str, str]]:
    return {(leak.target, leak.name, leak.scope) for leak in leaks}


@pytest.mark.parametrize("seed", [0, 1])
def test_a_clean_set_leaks_nothing(seed: int):
    tried = score_leaks(Made(seed).dataset("gaze_x", "gaze_y", "device"))
    assert [str(leak) for leak in tried if leak.verdict == "found"] == []
    # Of place in the store a set so small cannot tell; hot pixels there are none.
    assert {leak.name for leak in tried if leak.verdict == "untested"} == {"store order"}
    assert len(tried) == 2 * 9 + 3


def at_the_side(made: Made) -> None:
    made.centre[:, 0] = 300 + 200 * made.gaze[:, 0] + made.rng.normal(0, 20, len(made.gaze))


def lamp(made: Made) -> None:
    made.background = made.background + 4 * made.gaze[:, 0]


def drift(made: Made) -> None:
    made.gaze[:, 0] = 0.4 * (made.time / made.time.max() - 0.5) + 0.02 * made.rng.normal(size=len(made.gaze))


def split_at_random(made: Made) -> None:
    made.split = (made.rng.uniform(size=len(made.gaze)) < 0.2).astype(int)


def sorted_frames(made: Made) -> None:
    order = np.argsort(made.gaze[:, 0])
    for name in ("gaze", "centre", "quality", "device"):
        setattr(made, name, getattr(made, name)[order])
    made.recording = np.zeros_like(made.recording)
    made.time = made.rng.permutation(len(order)) / 15
    made.split = (made.rng.uniform(size=len(order)) < 0.2).astype(int)


def sure_on_the_right(made: Made) -> None:
    made.quality = np.clip(0.9 + 0.2 * made.gaze[:, 0], 0, 1)


@pytest.mark.parametrize(
    ("spoil", "name"),
    [
        (at_the_side, "position"),
        (lamp, "background"),
        (drift, "time"),
        (split_at_random, "neighbours in time"),
        (sorted_frames, "neighbours in store"),
        (sure_on_the_right, "label quality"),
    ],
)
def test_what_tells_the_gaze_is_found(spoil: Callable[[Made], None], name: str):
    made = Made(2)
    spoil(made)
    found = named(find_leaks(made.dataset("gaze_x")))
    assert ("gaze_x", name, "split") in found
    # Nothing in the corners tells it but a lamp.
    assert (name == "background") == bool({"background", "fixed pattern", "hot pixels"} & {n for _, n, _ in found})


def test_the_other_label_stays_clean():
    made = Made(2)
    lamp(made)
    assert named(find_leaks(made.dataset())) == {("gaze_x", "background", "split")}


def brighter(made: Made) -> None:
    made.background = made.background + 1.0 * made.device


def brighter_room(made: Made) -> None:
    """Every recording has a level of its own, whatever its device."""
    made.background = made.background + np.array([5, 0, 9, 2, 11, 7, 3, 8, 1, 10, 6, 4])[made.recording]


def dirt(made: Made) -> None:
    made.hot_crop = {0: (1, 2), 1: (SIDE - 3, 1), 2: (2, SIDE - 2)}


def other_probe(made: Made) -> None:
    made.centre = 300 + (made.centre - 300) / 20
    # Where the corners of the crops stand in the probe's frame.
    made.hot_frame = {
        d: 280 + 40 * made.rng.integers(0, 2, (8, 2)) + made.rng.integers(-3, 3, (8, 2)) for d in range(3)
    }


@pytest.mark.parametrize(
    ("spoil", "name", "scopes"),
    [
        (brighter, "background", {"split", "recordings"}),
        (brighter_room, "background", {"split"}),
        (dirt, "fixed pattern", {"split", "recordings"}),
        (other_probe, "hot pixels", {"split", "recordings"}),
    ],
)
def test_what_tells_the_device_is_found(spoil: Callable[[Made], None], name: str, scopes: set[str]):
    made = Made(3, recordings=12, frames=40)
    spoil(made)
    found = named(find_leaks(made.dataset("device")))
    assert {scope for _, n, scope in found if n == name} == scopes


def test_the_light_of_the_rr_is_no_background():
    """Rings eight times brighter: their light in the corners tells the gaze, and is the picture."""
    tried = {leak.name: leak for leak in score_leaks(Made(4, tail=8.0).dataset("gaze_x"))}
    assert tried["background"].verdict != "found"


def test_a_lamp_is_found_beside_the_light_of_the_rr():
    made = Made(4, tail=8.0)
    lamp(made)
    assert named(find_leaks(made.dataset("gaze_x"))) == {("gaze_x", "background", "split")}


def test_bright_corners_are_not_judged():
    tried = {leak.name: leak for leak in score_leaks(Made(4, tail=100.0).dataset("gaze_x"))}
    assert tried["background"].verdict == "untested"
    assert "light reaches the corners" in str(tried["background"])


def test_too_few_frames_are_not_judged():
    (told,) = score_leaks(Made(5).dataset("gaze_x").isel(frame=slice(0, 40)))
    assert told.verdict == "untested" and "too few" in told.why


def test_a_label_that_never_changes_is_not_tried():
    made = Made(5, recordings=1)
    assert score_leaks(made.dataset("device")) == []
