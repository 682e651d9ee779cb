"""Parts of a labelled film: so many seconds, in a row or spread over the field."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tapetum.data.film_parts import spread_over


def walk(count: int, seed: int = 0) -> np.ndarray:
    """A slow path over the field, [N, 2], as a hand's."""
    t = np.arange(count) / 15
    phase = np.random.default_rng(seed).uniform(0, 6, 2)
    return 0.48 * np.sin(2 * np.pi * t[:, None] * np.array([0.11, 0.07]) + phase)


def cells(gaze: np.ndarray, side: int = 5) -> int:
    return len(np.unique((np.clip(gaze + 0.5, 0, 0.999) * side).astype(int) @ np.array([1, side])))


@given(count=st.integers(1, 400), seed=st.integers(0, 5))
def test_places_ascend_once_each_and_are_the_same_again(count: int, seed: int) -> None:
    found = spread_over(walk(300), count, seed)
    assert len(found) == min(count, 300) and (np.diff(found) > 0).all()
    np.testing.assert_array_equal(found, spread_over(walk(300), count, seed))


def test_few_frames_reach_all_parts_that_the_film_reaches() -> None:
    gaze = walk(1500)
    spread = spread_over(gaze, 75, 1)
    assert cells(gaze[spread]) >= 0.95 * cells(gaze) > 2 * cells(gaze[:75])


def test_one_quantity_and_a_constant_one_are_spread_too() -> None:
    values = np.stack([np.linspace(0, 1, 200) ** 4, np.full(200, 3.0)], axis=1)
    for columns in (values, values[:, :1]):
        chosen = values[spread_over(columns, 20, 0), 0]
        assert (np.histogram(chosen, 5, (0, 1))[0] > 0).all()
