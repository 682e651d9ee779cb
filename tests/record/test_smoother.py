"""A hand's path between frames: from samples alone, with a deviation that holds."""

from __future__ import annotations

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.record.clocks import Joined
from tapetum.record.motion import HandMotion
from tapetum.record.smoother import Samples, Smoothed, block_seconds, smooth

NOISE, UNIT = 5e-5, 1.5e-4


def sampled(
    rate: float, seed: int, *, seconds: float = 24.0, readout: float = 0.012, exposure: float = 0.01, **motion: object
) -> tuple[Samples, np.ndarray, np.ndarray]:
    """Samples of a hand by a camera of its own lag and rate; times between them, and the true places then."""
    rng = np.random.default_rng([seed, 8])
    hand = HandMotion(**motion).draw(seed)  # type: ignore[arg-type]
    frames = rng.uniform(0, 1 / rate) + np.arange(int(seconds * rate)) / (rate * 1.0007)
    frames += np.clip(1e-3 * rng.standard_normal(len(frames)), -0.2 / rate, 0.2 / rate)
    rows = frames
    for _ in range(4):
        rows = frames + readout * hand.gaze(rows)[:, 1]
    steps = exposure * ((np.arange(16) + 0.5) / 16 - 0.5)
    places = np.mean([hand.gaze(rows + one) for one in steps], axis=0) + NOISE * rng.standard_normal((len(rows), 2))
    asked = np.arange(1.0, seconds - 1, 1 / 15)
    return Samples(rows, places, np.full(len(rows), NOISE), exposure), asked, hand.gaze(asked)


def rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).mean()))


@pytest.mark.parametrize(("rate", "most"), [(15, 6.0), (30, 1.5), (60, 0.4)])
def test_a_tremor_of_unknown_spectrum_is_followed(rate: float, most: float) -> None:
    errors, scores = [], []
    for seed in (21, 22, 23):
        # Few frames a second take longer to show the spectrum.
        samples, asked, true = sampled(rate, seed, seconds={15: 19, 30: 11, 60: 7}[rate])
        found = smooth(samples, asked, rate)
        error = found.places - true
        line = np.stack([np.interp(asked, samples.times, axis) for axis in samples.places.T], axis=1)
        assert rms(error) < most * UNIT < rms(line - true)
        assert (found.reach > 0).all() and found.reach.max() < 0.55
        errors.append(error)
        scores.append(error / found.deviations)
    score = np.abs(np.concatenate(scores))
    assert 0.85 < (score < 1.645).mean() < 0.97
    assert np.quantile(score, 0.99) < 4


@pytest.mark.parametrize("rate", [15, 60])
def test_each_axis_has_its_own_deviation(rate: float) -> None:
    """As a wide image moves fewer pixels along y; at 60 frames a second the measured places' errors decide."""
    scores, widths = [], []
    for seed in range(31, 37):
        samples, asked, true = sampled(rate, seed, seconds={15: 19, 60: 7}[rate])
        scale = np.array([1.0, 0.5])
        found = smooth(Samples(samples.times, samples.places * scale, 0.7 * samples.deviations, 0.01), asked, rate)
        scores.append(np.abs(found.places - true * scale) / found.deviations)
        widths.append(found.deviations)
    inside = (np.concatenate(scores) < 1.645).mean(axis=0)
    assert (inside > 0.84).all() and (inside < 0.98).all() and abs(inside[0] - inside[1]) < 0.04, inside
    assert 0.45 < np.median(np.concatenate(widths)[:, 1]) / np.median(np.concatenate(widths)[:, 0]) < 0.7


def test_another_band_is_found_too() -> None:
    samples, asked, true = sampled(15, 22, seconds=19, tremor_band=(4.0, 6.5), tremor=1e-3)
    assert rms(smooth(samples, asked, 15).places - true) < 2 * UNIT


def test_what_no_frame_tells_has_a_wide_deviation() -> None:
    """Frames of an even beat and a global shutter do not tell 10 Hz from 5 Hz."""
    hand, frames = HandMotion(extent=0.05).draw(5), np.arange(300) / 15 + 0.021
    samples = Samples(frames, hand.gaze(frames), np.full(len(frames), NOISE))
    asked = np.arange(2.0, 18, 1 / 15)
    found = smooth(samples, asked, 15)
    assert np.median(found.deviations) > 0.5 * 0.002
    error = np.abs(found.places - hand.gaze(asked))
    assert (error < 1.645 * found.deviations).mean() > 0.75


def test_the_exposure_and_the_rows_count() -> None:
    samples, asked, true = sampled(60, 23, seconds=5, readout=0.012, exposure=0.015)
    ignored = Samples(samples.times, samples.places, samples.deviations, 0.0)
    good, bad = (rms(smooth(one, asked, 60).places - true) for one in (samples, ignored))
    # The mean over 15 ms loses 4 % of a tremor at 10 Hz.
    assert good < 0.4 * UNIT and bad > 2 * good
    frames = samples.times - 0.012 * samples.places[:, 1]
    wrong = rms(smooth(Samples(frames, samples.places, samples.deviations, 0.015), asked, 60).places - true)
    assert wrong > 3 * good


def test_strays_gaps_and_blinks_spoil_only_themselves() -> None:
    samples, asked, true = sampled(30, 24, seconds=16)
    places, kept = samples.places.copy(), np.ones(len(samples), bool)
    places[[100, 333]] += 0.02
    kept[200:230] = kept[401] = False
    spoilt = Samples(samples.times, places, samples.deviations, samples.exposure).part(kept)
    found = smooth(spoilt, asked, 30)
    dark = samples.times[[200, 229]]
    away = (asked < dark[0] - 0.1) | (asked > dark[1] + 0.1)
    assert rms((found.places - true)[away]) < 1.5 * UNIT
    assert np.flatnonzero(found.strays).tolist() == [100, 333 - 30]  # those that were moved, and not their neighbours
    inside = (asked > dark[0] + 0.3) & (asked < dark[1] - 0.3)
    assert (found.deviations[inside] > 1e-3).all()


def test_a_pose_that_stays_and_too_few_samples() -> None:
    times = np.arange(300) / 30
    still = Samples(times, np.full((300, 2), 0.1), np.full(300, NOISE))
    found = smooth(still, times[30:-30] + 0.01, 30)
    assert np.abs(found.places - 0.1).max() < 1e-6 and found.deviations.max() < 2 * NOISE
    few = smooth(still.part(times < 1.5), times[5:40], 30)
    assert np.isnan(few.places).all() and np.isinf(few.deviations).all()
    with pytest.raises(InputError, match="finite"):
        Samples(times, np.full((300, 2), np.nan), np.full(300, NOISE))


def test_a_part_of_a_recording_gives_the_whole_s_path() -> None:
    samples, asked, _ = sampled(30, 25, seconds=16)
    length, back, ahead = block_seconds(30)
    asked = asked[(asked >= length) & (asked < 4 * length)]
    whole = smooth(samples, asked, 30)
    inside = (asked >= 2 * length) & (asked < 4 * length)
    held = (samples.times >= 2 * length - back) & (samples.times < 4 * length + ahead)
    part: Smoothed = smooth(samples.part(held), asked[inside], 30)
    np.testing.assert_allclose(part.places, whole.places[inside], atol=1e-9)
    np.testing.assert_allclose(part.deviations, whole.deviations[inside], atol=1e-9)


def test_neighbours_at_the_times_of_their_rows() -> None:
    frames, moments = np.arange(6) / 15, np.array([0.1, 0.2])
    before = np.array([1, 3])
    joined = Joined(before, before + 1, np.array([0.5, 0.0]), np.array([0.03, 0.0]), frames)
    rows = frames + 0.004 * np.array([1, -1, 1, -1, 1, -1.0])
    assert np.allclose(joined.at_rows(rows, moments).interpolate(3 * rows), 3 * moments)
    assert not np.allclose(joined.interpolate(3 * rows), 3 * moments, atol=1e-3)
