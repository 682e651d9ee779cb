"""Whether a camera images: the asymmetry of made returns, and what follows from a sequence of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tapetum.record.source import Frame
from tapetum.track import read_tracks, retrack, track_to_file
from tapetum.track.activity import EDGES, Activity, asymmetry


def disc(radius: float = 40.0, height: float = 120.0, *, at: tuple[float, float] = (150.3, 148.6)) -> np.ndarray:
    """A disc with concentric rings on a background of 8, without noise."""
    rows, columns = np.indices((300, 300))
    away = np.hypot(columns - at[0], rows - at[1])
    return 8 + height * (0.7 + 0.3 * np.cos(0.6 * away)) / (1 + np.exp((away - radius) / 1.5))


def fringed(image: np.ndarray, depth: float) -> np.ndarray:
    """The same with fringes across."""
    rows, columns = np.indices(image.shape)
    return 8 + (image - 8) * (1 + depth * np.cos(0.35 * columns + 0.12 * rows))


def noisy(image: np.ndarray, seed: int = 3) -> np.ndarray:
    return np.clip(np.random.default_rng(seed).normal(image, np.sqrt(1 + 0.1 * image)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("radius", [15.0, 40.0, 70.0])
def test_concentric_rings_have_none_and_fringes_have_much(radius: float) -> None:
    plain, crossed = disc(radius), fringed(disc(radius), 0.6)
    smooth, broken = asymmetry(noisy(plain), 255), asymmetry(noisy(crossed), 255)
    assert smooth is not None and broken is not None
    assert smooth.value < EDGES[0]
    assert broken.value > EDGES[2]
    assert smooth.radius == pytest.approx(radius, abs=4)


def test_faint_returns_say_nothing() -> None:
    assert asymmetry(noisy(np.full((300, 300), 8.0)), 255) is None
    assert asymmetry(noisy(disc(height=0.1)), 255) is None


def test_noise_does_not_look_like_the_sensor() -> None:
    for seed in range(8):
        found = asymmetry(noisy(disc(height=6.0), seed), 255)
        assert found is not None
        assert found.value < EDGES[2]


def test_a_ghost_beside_the_disc_does_not_count() -> None:
    ghost = disc(height=12.0, at=(120.0, 125.0)) - 8
    found = asymmetry(noisy(disc() + ghost), 255)
    assert found is not None
    assert found.value < EDGES[1]


def test_a_saturated_disc_is_judged_by_its_outline() -> None:
    round_, ragged = disc(height=900.0), fringed(disc(height=700.0), 0.9)
    rows, columns = np.indices(ragged.shape)
    ragged[(columns - 150) ** 2 + (rows - 120) ** 2 < 400] = 8
    whole, cut = asymmetry(noisy(round_), 255), asymmetry(noisy(ragged), 255)
    assert whole is not None and cut is not None
    assert whole.saturated > 0.5 and cut.saturated > 0.25
    assert whole.value < EDGES[0]
    assert cut.value > EDGES[1]


def test_idle_is_only_said_of_a_camera_that_was_seen_imaging() -> None:
    one = Activity()
    # The filter may hide the sensor at this wavelength.
    assert {one.update(2e-4, k / 15) for k in range(60)} == {None}
    seen = [one.update(3e-2, (60 + k) / 15) for k in range(8)]
    assert seen[-1] is True and seen.index(True) <= 4
    closed = [one.update(2e-4, (68 + k) / 15) for k in range(15)]
    assert closed[-1] is False and True not in closed[8:]
    # Half a second at 15 frames a second.
    assert closed.index(False) < 8
    opened = [one.update(3e-2, (83 + k) / 15) for k in range(8)]
    assert opened.index(True) < 8


def test_a_camera_that_rested_for_long_is_believed_nearly_as_soon() -> None:
    frames: list[int] = []
    for rest in (10, 1000):
        one = Activity()
        for k in range(rest * 15):
            assert one.update(2e-4, k / 15) is None
        frames.append([one.update(3e-2, rest + k / 15) for k in range(60)].index(True))
    assert frames[1] - frames[0] <= 2


def test_what_is_certain_takes_more_returns_than_what_is_said() -> None:
    one = Activity()
    said = [(one.update(3e-2, k / 15), one.certain) for k in range(10)]
    assert 0 < said.index((True, False)) < said.index((True, True)) <= 4


def test_nothing_is_said_where_no_return_is_seen() -> None:
    one = Activity()
    assert [one.update(3e-2, k / 15) for k in range(10)][-5:] == [True] * 5
    assert one.update(None, 11 / 15) is None
    assert one.update(3e-2, 12 / 15) is True


def test_what_was_known_is_forgotten_in_time() -> None:
    one = Activity()
    for k in range(10):
        one.update(3e-2, k / 15)
    assert one.imaging > 0.95
    one.update(None, 200.0)
    assert 0.45 < one.imaging < 0.55


def test_faint_departures_of_a_filter_that_passes_little_are_not_taken_for_idle() -> None:
    """As measured at 785 nm behind filters that pass 3 %: most frames look idle, some do not."""
    rng = np.random.default_rng(1)
    one = Activity()
    said = [
        one.update(v, k / 15) for k, v in enumerate(rng.choice([4e-4, 1.5e-3, 4e-3, 1e-2], 300, p=[0.3, 0.3, 0.2, 0.2]))
    ]
    assert said.count(False) <= 3
    assert said.count(True) > 100


def test_tracks_say_what_their_camera_does(tmp_path: Path) -> None:
    states = [True] * 20 + [False] * 20 + [True] * 20
    idle = disc()
    imaging = fringed(idle, 0.6)
    frames = [Frame(k, k / 15, noisy(imaging if on else idle, seed=k), f"probe[{k}]") for k, on in enumerate(states)]
    track_to_file(frames, tmp_path / "t.csv", activity=True, detections=tmp_path / "d.parquet")
    rows = read_tracks(tmp_path / "t.csv").to_pylist()
    assert {row["track"] for row in rows} == {1}
    told = {row["frame"]: row["active"] for row in rows}
    # After half a second in a state the answer is right.
    assert all(told[k] is states[k] for k in (*range(8, 20), *range(28, 40), *range(48, 60)))
    assert all(told[k] is not False for k in range(20)), "idle before it was ever seen to image"
    again = retrack(tmp_path / "d.parquet").to_pylist()
    assert [row["active"] for row in again] == [row["active"] for row in rows]
    # Where nobody asks nothing is said.
    track_to_file(frames[:3], tmp_path / "n.csv", detections=tmp_path / "e.parquet")
    assert {row["active"] for row in read_tracks(tmp_path / "n.csv").to_pylist()} == {None}
    assert {row["active"] for row in retrack(tmp_path / "e.parquet").to_pylist()} == {None}
