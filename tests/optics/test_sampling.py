"""The planner keeps what it claims, and refuses what it cannot hold."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tapetum.errors import InputError
from tapetum.optics.grid import Grid, lens_numbers
from tapetum.optics.sampling import (
    ACCURACIES,
    REFERENCE,
    DoublePassGeometry,
    disc_overlap,
    plan_aside,
    plan_round,
    plan_round_with,
)
from tapetum.simulate.round_pass import RoundPass

PAPER = DoublePassGeometry(640e-9, 3e-3, 0.1, lens_numbers(0.1, 1.0)[0], 0.2, 4e-4, math.sin(math.radians(1)))


def random_geometry(rng: np.random.Generator) -> tuple[DoublePassGeometry, Grid, torch.Tensor]:
    """Wavelength, lens, focus, illumination, tilt, probe and pixels drawn from what people use."""
    focal = 10 ** rng.uniform(-2, math.log10(0.15))
    radius = min(focal / rng.uniform(4, 20) / 2, 10 ** rng.uniform(-2.7, -2.2))
    z, _ = lens_numbers(focal, 2 * focal + 10 ** rng.uniform(-0.3, 1.3))
    sine = rng.choice([0.0, 1.0, 1.0]) * rng.uniform(0, 0.9) * radius / focal
    pixels = Grid(48, 48, 10 ** rng.uniform(-6.0, -5.0))
    geometry = DoublePassGeometry(
        wavelength=rng.uniform(450e-9, 900e-9),
        radius=radius,
        focal_length=focal,
        image_distance=z,
        probe_focal_length=rng.uniform(0.1, 0.3),
        window=pixels.width / math.sqrt(2),
        sine=float(sine),
        curvature=float(rng.choice([0.0, 1 / rng.uniform(1, 10)])),
    )
    angle = rng.uniform(0, 2 * math.pi)
    tilt = torch.tensor([[sine * math.cos(angle), sine * math.sin(angle)]], dtype=torch.float64)
    return geometry, pixels, tilt


def ratios(seed: int, count: int, largest: int = 28_000_000) -> np.ndarray:
    """Measured over claimed error, [scenes, accuracies]; scenes whose reference is too large are passed over."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        geometry, pixels, tilt = random_geometry(rng)
        best = plan_round_with(geometry, REFERENCE)
        if best.columns * best.rows > largest:
            continue
        reference = RoundPass(geometry, best, pixels)(tilt)[0]
        row = []
        for accuracy in ACCURACIES:
            plan = plan_round(geometry, accuracy)
            image = RoundPass(geometry, plan, pixels)(tilt)[0]
            row.append(float((image - reference).abs().max() / reference.max()) / plan.expected_error)
        found.append(row)
    return np.array(found)


def _validate(found: np.ndarray, validated: Any) -> None:
    for accuracy, column in zip(ACCURACIES, found.T, strict=True):
        what = f"worst error over claim of {accuracy:g}, {len(found)} random scenes (median {np.median(column):.2g})"
        validated("Sampling", what, column.max(), 1, "the same at many times the samples", "of the claim")


def test_error_stays_below_the_claim_on_random_scenes(validated: Any) -> None:
    _validate(ratios(11, 6), validated)


@pytest.mark.slow
def test_error_stays_below_the_claim_on_many_random_scenes(validated: Any) -> None:
    _validate(ratios(14, 200), validated)


@pytest.mark.parametrize("accuracy", [1e-3, 3e-4])
def test_tilted_lenses_need_no_samples_for_the_rim_s_own_light(accuracy: float, validated: Any) -> None:
    """Head on that light meets in the middle of the picture; under a tilt it misses it."""
    rng, found = np.random.default_rng(23), []
    while len(found) < 4:
        geometry, pixels, _ = random_geometry(rng)
        geometry = replace(geometry, sine=0.9 * rng.uniform() ** 2 * geometry.radius / geometry.focal_length)
        best, plan = plan_round_with(geometry, REFERENCE), plan_round(geometry, accuracy)
        aside = plan_aside(geometry, accuracy, plan)
        if aside is None or best.columns * best.rows > 8_000_000:
            continue
        coarser, least = aside
        assert coarser.columns < plan.columns
        # Where it begins to serve it errs most.
        sine = 1.0001 * math.sqrt(least)
        tilt = sine * torch.tensor([[0.6, 0.8]], dtype=torch.float64)
        reference = RoundPass(geometry, best, pixels)(tilt)[0]
        image = RoundPass(geometry, plan, pixels, aside=aside)(tilt)[0]
        assert torch.equal(image, RoundPass(geometry, coarser, pixels)(tilt)[0])
        found.append(float((image - reference).abs().max() / reference.max()) / plan.expected_error)
    what = f"worst error over claim of {accuracy:g} without the rim's own light, 4 random tilted scenes"
    validated("Sampling", what, max(found), 1, "the same at many times the samples", "of the claim")


def test_gazes_on_both_sides_of_the_rim_s_tilt_in_one_batch() -> None:
    plan = plan_round(PAPER)
    aside = plan_aside(PAPER, 1e-3, plan)
    assert aside is not None
    one = RoundPass(PAPER, plan, Grid(24, 24, 1e-5), aside=aside)
    sines = torch.tensor([[0.0, 0.0], [0.017, 0.0], [0.0, 0.001], [0.01, 0.01]], dtype=torch.float64)
    together, centres = one(sines), torch.full((4, 2), 1e-5, dtype=torch.float64)
    for each, image in zip(sines, together, strict=True):
        assert torch.allclose(one(each[None])[0], image, rtol=0, atol=1e-5 * float(image.max()))
    assert torch.allclose(
        one(sines, centres)[2], one(sines[2:3], centres[2:3])[0], rtol=0, atol=1e-5 * float(together.max())
    )
    # Head on nothing is coarser.
    assert torch.equal(together[0], RoundPass(PAPER, plan, Grid(24, 24, 1e-5))(sines[:1])[0])


def test_finer_claims_cost_more_samples() -> None:
    plans = [plan_round(PAPER, accuracy) for accuracy in ACCURACIES]
    assert [plan.expected_error for plan in plans] == sorted((p.expected_error for p in plans), reverse=True)
    assert [plan.columns for plan in plans] == sorted(plan.columns for plan in plans)


@pytest.mark.parametrize("accuracy", [0.0, 1e-6, math.nan, -1.0])
def test_accuracy_out_of_reach_is_refused(accuracy: float) -> None:
    with pytest.raises(InputError, match="accuracy"):
        plan_round(PAPER, accuracy)


def test_forced_grids_that_alias_are_refused() -> None:
    with pytest.raises(InputError, match=r"sampling\.pupil: 40 samples .* use at least"):
        plan_round(PAPER, pupil_samples=40)


def test_forced_grids_finer_than_needed_keep_the_claim_coarser_ones_lose_it() -> None:
    usual = plan_round(PAPER)
    finer = plan_round(PAPER, pupil_samples=usual.columns + 50)
    assert finer.columns == usual.columns + 50
    assert finer.expected_error == usual.expected_error
    coarser = plan_round(PAPER, pupil_samples=usual.columns - 20)
    assert math.isinf(coarser.expected_error)


def test_a_scene_too_large_is_refused_with_the_nearest_that_fits() -> None:
    huge = replace(PAPER, radius=0.05, image_distance=lens_numbers(0.1, 0.3)[0])
    with pytest.raises(InputError, match="GiB") as refused:
        plan_round(huge)
    told = str(refused.value)
    radius = float(re.search(r"radius of ([\d.]+) mm", told)[1]) * 1e-3
    distance = float(re.search(r"focus it at ([\d.]+) m", told)[1])
    # What it proposes does fit, and is not far from what does not.
    plan_round(replace(huge, radius=radius))
    plan_round(replace(huge, image_distance=lens_numbers(0.1, distance * 1.01)[0]))
    with pytest.raises(InputError):
        plan_round(replace(huge, radius=radius * 1.1))


def test_a_target_focused_on_the_source_sees_a_point() -> None:
    z, _ = lens_numbers(0.1, 5.5)
    assert replace(PAPER, image_distance=z, curvature=1 / 5.5).spot_radius == pytest.approx(0, abs=1e-9)
    assert replace(PAPER, image_distance=z).spot_radius == pytest.approx(3e-3 * (z - 0.1) / 0.1)


def test_disc_overlap() -> None:
    assert disc_overlap(1, 1, 0) == 1
    assert disc_overlap(1, 1, 2) == 0
    assert disc_overlap(2, 1, 0) == pytest.approx(0.25)
    assert disc_overlap(1, 2, 0.5) == 1
    # Two unit discs one radius apart: 2π/3 - √3/2.
    assert disc_overlap(1, 1, 1) == pytest.approx((2 * math.pi / 3 - math.sqrt(3) / 2) / math.pi)
