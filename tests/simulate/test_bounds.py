"""Limits for the sets' figures against closed forms and against `fisher` itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tapetum.bench import Scene, load_scene, with_values
from tapetum.errors import InputError
from tapetum.simulate import fisher, tilt_of_gaze
from tapetum.simulate.bounds import (
    FRAME,
    FocusBounds,
    GazeInformation,
    focus_bounds,
    gaze_bounds,
    gaze_information,
    gaze_prior,
    rings_of_gazes,
)

BENCH = (
    "target.lens.aperture_radius=2 mm",
    "target.object_distance=2.5",
    "illumination.diameter=50 mm",
    "probe.sensor.pixels=[64, 64]",
    "probe.sensor.pitch=13.2 um",
    "probe.sensor.exposure=20 us",
    "probe.sensor.bits=14",
    "probe.sensor.background=20",
    "sampling.accuracy=1e-2",
)
SINGLET = "target.lens={kind: prescription, name: la1509, f_number: 30, design_wavelength: 640 nm}"
NAMES = ("gaze_x", "gaze_y", *FRAME)


def thin() -> Scene:
    return load_scene("thin-lens", [*BENCH])


def turned(scene: Scene, gaze: tuple[float, float]) -> Scene:
    import torch

    sines = tilt_of_gaze(scene, torch.tensor(gaze, dtype=torch.float64))
    return with_values(scene, {"target.rotation": torch.rad2deg(torch.asin(sines)).tolist()})


@pytest.mark.parametrize("lens", [(), (SINGLET,)], ids=["thin", "traced"])
def test_one_camera_for_all_gazes_tells_what_each_one_does(lens: tuple[str, ...]) -> None:
    scene = load_scene("thin-lens", [*BENCH, *lens])
    gazes = [(0.02, 0.05), (-0.1, 0.04)]
    shown: list[tuple[str, int | None]] = []

    def progress(items: Any, what: str, *, total: int | None = None) -> Any:
        shown.append((what, total))
        return iter(items)

    found = gaze_bounds(scene, gazes, FRAME, progress=progress)
    assert shown == [("bounding the gaze", 2)]
    for gaze, one in zip(gazes, found, strict=True):
        want = fisher(turned(scene, gaze), NAMES, device="cpu").bounds
        # The samples are planned for the steeper of the two: samplings of 1e-2 differ by 0.15 in a mirror's limits.
        assert one == pytest.approx([want["gaze_x"], want["gaze_y"]], rel=0.2 if lens else 1e-6)


def made(deviations: np.ndarray, gazes: np.ndarray) -> GazeInformation:
    """Independent gaze_x, gaze_y and power, and a place that imitates half of what gaze_x changes."""
    matrices = [np.diag([1 / x**2, 1 / y**2, 4.0, 1.0]) for x, y in deviations]
    for one in matrices:
        one[0, 3] = one[3, 0] = math.sqrt(0.5 * one[0, 0])
    return GazeInformation(("gaze_x", "gaze_y", "power", "place_x"), gazes, np.stack(matrices))


def test_curve_is_the_error_of_the_best_unbiased_estimate() -> None:
    gazes = rings_of_gazes([0.0, 0.2, 0.4], 3)
    assert gazes.shape == (7, 2)
    assert np.hypot(*gazes.T) == pytest.approx([0, 0.2, 0.2, 0.2, 0.4, 0.4, 0.4])
    deviations = np.array([[0.03, 0.04], *[[0.003, 0.004], [0.3, 0.4], [0.03, 0.04]] * 2])
    curve = made(deviations, gazes).curve(("power",))
    assert curve.distance == pytest.approx([0, 0.2, 0.4])
    # The median over azimuths, and over both axes what metrics take: roots of mean squares, and means.
    assert curve.rms == pytest.approx(math.sqrt((0.03**2 + 0.04**2) / 2) * np.ones(3))
    errors = np.abs(np.random.default_rng(2).normal(size=(200_000, 2)) * [0.03, 0.04]).mean()
    assert curve.mae == pytest.approx(errors * np.ones(3), rel=5e-3)


def test_what_is_unknown_costs_and_what_is_known_before_pays() -> None:
    found = made(np.array([[0.03, 0.04]]), np.zeros((1, 2)))
    assert found.bounds(("power",))[0] == pytest.approx([0.03, 0.04])
    assert found.bounds()[0] == pytest.approx([0.03 * math.sqrt(2), 0.04])
    # A place that is known well enough beforehand imitates nothing.
    assert found.bounds(priors={"place_x": 1e-3})[0] == pytest.approx([0.03, 0.04], rel=1e-4)
    prior = gaze_prior(0.06)
    assert found.bounds((), {"gaze_x": prior})[0] == pytest.approx([1 / math.hypot(1 / 0.03, math.pi / 0.06), 0.04])
    # What tells nothing is no better known than before.
    blind = made(np.array([[1e9, 1e9]]), np.zeros((1, 2)))
    assert blind.bounds((), {"gaze_x": prior, "gaze_y": prior})[0] == pytest.approx([prior, prior])


def test_van_trees_keeps_below_the_error_of_the_mean() -> None:
    """Drawn from cos²(πx/2e) and seen through noise: the posterior's mean errs by more than the bound, not by much."""
    extent, sigma = 0.5, 0.2
    x = np.linspace(-extent, extent, 2001)
    prior = np.cos(math.pi * x / (2 * extent)) ** 2
    seen = np.linspace(-3, 3, 1201)
    joint = prior * np.exp(-((seen[:, None] - x) ** 2) / (2 * sigma**2))
    joint /= joint.sum()
    mean = (joint @ x) / joint.sum(1)
    error = math.sqrt(float((joint * (x - mean[:, None]) ** 2).sum()))
    bound = made(np.array([[sigma, sigma]]), np.zeros((1, 2))).bounds((), {"gaze_x": gaze_prior(extent)})[0, 0]
    assert 0.9 * error < bound < error < sigma


def test_focus_table_is_what_fisher_says_of_each_pair() -> None:
    scene = turned(thin(), (0.06, 0.04))
    distances, lengths = (2.0, 2.5), (0.09, 0.1)
    found = focus_bounds(thin(), distances, lengths)
    assert isinstance(found, FocusBounds) and found.deviation.shape == (2, 2, 2)
    names = ("object_distance", "focal_length", *NAMES)
    for i, distance in enumerate(distances):
        for j, length in enumerate(lengths):
            values = {"target.object_distance": distance, "target.lens.focal_length": length}
            want = fisher(turned(with_values(scene, values), (0.06, 0.04)), names, device="cpu")
            assert found.deviation[i, j] == pytest.approx(list(want.bounds.values())[:2], rel=1e-6)
            alone = found.bounds(("focal_length",), ())[i, j, 0]
            assert alone == pytest.approx(want.alone["focal_length"], rel=1e-6)
            assert alone < found.deviation[i, j, 1]
    assert found.mae == pytest.approx(found.deviation * math.sqrt(2 / math.pi))


@pytest.mark.slow
def test_processes_bound_what_one_does() -> None:
    alone, shared = (focus_bounds(thin(), (2.0, 2.5), (0.1,), workers=n) for n in (1, 2))
    assert shared.deviation == pytest.approx(alone.deviation, rel=1e-6)


@pytest.mark.parametrize(
    ("gazes", "says"),
    [([0.1, 0.2, 0.3], "must be"), ([[0.1, math.nan]], "numbers"), ([[0.6, 0.0]], "fractions of the field")],
)
def test_refuses(gazes: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        gaze_information(thin(), gazes)


def test_names_what_was_not_asked_for() -> None:
    found = made(np.array([[0.03, 0.04]]), np.zeros((1, 2)))
    with pytest.raises(InputError, match="'roll' was not differentiated by"):
        found.bounds(("roll",))
