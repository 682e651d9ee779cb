"""Aligning two clocks by a blinking laser."""

from __future__ import annotations

import numpy as np
import pytest

from tapetum.data.importing.align import Alignment, align_blink
from tapetum.errors import InputError

Series = tuple[np.ndarray, np.ndarray]


def seen(
    code: np.ndarray, *, rate: float, start: float = 0.0, seconds: float = 20.0, bit: float = 0.4, seed: int = 0
) -> Series:
    """What a camera that starts `start` seconds late sees of a code: noise, slow drifts, and a laser among them."""
    rng = np.random.default_rng(seed)
    times = np.arange(0, seconds, 1 / rate)
    on = code[np.clip(((times + start) / bit).astype(int), 0, len(code) - 1)]
    mean = 10 + 0.05 * on + 0.1 * rng.standard_normal(len(times)) + np.sin(times / 3 + seed)
    spot = 20 + 100 * on + 20 * rng.standard_normal(len(times)) + 10 * np.sin(times / 5 + seed)
    return times, np.stack([mean, spot], axis=1)


def code(seed: int, bits: int = 60) -> np.ndarray:
    return np.random.default_rng([seed, 7]).integers(0, 2, bits)


@pytest.mark.parametrize("rate", [12.0, 15.0, 30.0])
@pytest.mark.parametrize("start", [-4.37, 0.0, 2.71])
def test_a_code_gives_the_offset_to_a_frame(rate: float, start: float):
    for seed in range(4):
        word = np.r_[np.ones(20, int), code(seed)]
        probe = seen(word, rate=15, start=8, seed=seed)
        found = align_blink(probe, seen(word, rate=rate, start=8 + start, seconds=18, seed=seed + 100), "pair")
        assert abs(found.offset - start) < 1 / 15
        assert found.correlation > 0.6 and found.rival < 0.75


def test_a_code_at_the_beginning_of_a_long_video_is_enough():
    word = np.r_[code(1, 25), np.ones(400, int)]
    found = align_blink(seen(word, rate=15, seconds=90), seen(word, rate=15, start=3.0, seconds=90, seed=9), "pair")
    assert abs(found.offset - 3.0) < 1 / 15


def refused(probe: Series, target: Series) -> str:
    with pytest.raises(InputError) as told:
        align_blink(probe, target, "pair")
    return str(told.value)


def test_a_regular_blinking_is_ambiguous():
    word = np.tile([0, 1], 40)
    assert "fits at several offsets" in refused(seen(word, rate=15), seen(word, rate=15, start=2, seed=9))


def test_without_a_code_there_is_no_alignment():
    on = np.ones(60, int)
    for seed in range(10):
        told = refused(seen(on, rate=15, seed=seed), seen(on, rate=15, start=2, seed=seed + 50))
        assert "no blinking is seen by both" in told
        two = seen(code(seed), rate=15, seed=seed), seen(code(seed + 20), rate=15, seed=seed + 50)
        assert "no blinking is seen" in refused(*two) or "several offsets" in refused(*two)


def test_still_and_short_videos_are_told():
    still = np.arange(100) / 15, np.full((100, 2), 12.0)
    assert "never changes" in refused(still, still)
    assert "fewer than 8 frames" in refused((still[0][:5], still[1][:5]), still)


def test_the_alignment_says_how_sure_it_is():
    text = Alignment(1.25, 0.9, 0.4, 12.0).text
    assert text == "target +1.2500 s (correlation 0.90 over 12.0 s, next best 40% of it)"
