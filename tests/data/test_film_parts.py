"""Parts of a labelled film: so many seconds, in a row or spread over the field."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from tapetum.data import dataset_from_arrays
from tapetum.data.embargo import meeting, reach_of
from tapetum.data.film_parts import spread_beside, spread_over


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


def film(count: int, *, recordings: int = 1, reach: float = 0.4) -> xr.Dataset:
    """A film at 15 frames a second whose labels rest on so many seconds before and after each frame."""
    gaze, number = walk(count), np.arange(count) * recordings // count
    gazes = {"gaze_x": gaze[:, 0], "gaze_y": gaze[:, 1]}
    made = dataset_from_arrays(np.ones((count, 8, 8), np.uint8), gazes, recording=number)
    made["time"] = xr.Variable(("frame",), np.arange(count) / 15)
    for name in ("label_back", "label_ahead"):
        made[name] = xr.Variable(("frame",), np.full(count, reach))
    return made


NAMES = ("gaze_x", "gaze_y")


@pytest.mark.parametrize("recordings", [1, 40])
def test_frames_aside_are_of_random_moments_and_share_no_measurement_with_the_others(recordings: int) -> None:
    data = film(1600, recordings=recordings)
    found = spread_beside(data, NAMES, 450, 112, 3)
    assert found is not None
    places, moments = found
    aside = moments >= 0
    assert len(places) == len(aside) == 450 and np.count_nonzero(aside) == 112 and (np.diff(places) > 0).all()
    part = data.isel(frame=places)
    span, number = reach_of(part), np.asarray(part["recording"].values)
    assert span is not None and not meeting(span, number, ~aside, aside).any()
    # Moments all over the film, up to three frames of each, in a row.
    numbers, each = np.unique(moments[aside], return_counts=True)
    assert 37 <= len(numbers) <= 45 and each.max() == 3
    assert all(np.ptp(places[moments == one]) < 3 for one in numbers)
    assert np.histogram(places[aside], 4, (0, 1600))[0].min() > 10
    again = spread_beside(data, NAMES, 450, 112, 3)
    np.testing.assert_array_equal(places, again[0] if again else None)
    other = spread_beside(data, NAMES, 450, 112, 4)
    assert other is not None and not np.array_equal(places[aside], other[0][other[1] >= 0])


def test_frames_aside_lie_in_the_field_as_all_frames_do_and_spread_ones_do_not() -> None:
    """Of spread frames alone, those kept aside erred by up to four times as much as the film's."""
    data = film(1600)
    far = np.hypot(*data.tp.values(NAMES).T)
    found = [one for seed in range(40) if (one := spread_beside(data, NAMES, 450, 112, seed)) is not None]
    shares = [[(far[places[here]] > 0.5).mean() for here in (of >= 0, of < 0)] for places, of in found]
    aside, spread = np.mean(shares, axis=0)
    whole = (far > 0.5).mean()
    assert len(shares) == 40 and abs(aside - whole) < 0.04 and abs(spread - whole) > 0.15


def test_a_film_that_has_too_few_other_frames_is_not_divided_so() -> None:
    assert spread_beside(film(500), NAMES, 450, 112, 0) is None
    # Labels that rest on nothing else leave all other frames.
    alone = film(500).drop_vars(["label_back", "label_ahead"])
    found = spread_beside(alone, NAMES, 450, 112, 0)
    assert found is not None and len(found[0]) == 450 and np.count_nonzero(found[1] >= 0) == 112
