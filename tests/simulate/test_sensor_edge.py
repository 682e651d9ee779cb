"""The target's sensor ends: spots beside it return nothing, spots across its edge what lies on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import j1

from tapetum.bench import Scene, load_scene, with_values
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.record.returns import Returns
from tapetum.simulate import Camera, retroreflect, tilt_of_gaze
from tapetum.simulate.sensor_edge import SensorEdge, SpotLight, Spots
from tapetum.simulate.sensor_end import SensorEnd

SECTION = "The sensor's edge"
Validated = Callable[..., None]
WAVELENGTH, FOCAL, RADIUS, PROBE_FOCAL = 640e-9, 0.05, 2e-3, 0.2
K = 2 * math.pi / WAVELENGTH
OUTPUT = Grid(33, 33, 8e-6)


def scene(**changes: Any) -> Scene:
    given = {
        "target.lens": {"focal_length": FOCAL, "aperture_radius": RADIUS},
        "target.object_distance": math.inf,
        "target.sensor.pixels": [100, 80],
        "sampling.accuracy": 1e-2,
    }
    return with_values(load_scene("thin-lens"), {**given, **changes})


def pictures(one: Scene, *gazes: tuple[float, float], **options: Any) -> torch.Tensor:
    at = tilt_of_gaze(one, torch.tensor(gazes, dtype=torch.float64))
    steepest = float(at.norm(dim=-1).max())
    return Camera(one, steepest, **{"output": OUTPUT, "device": "cpu", **options})(at).double()


def test_a_spot_beside_the_sensor_returns_nothing() -> None:
    middle, beside = pictures(scene(), (0.0, 0.0), (0.85, 0.0))
    assert float(middle.max()) > 0
    assert float(beside.max()) == 0


def test_a_spot_on_the_sensor_is_as_ever() -> None:
    wide = scene(**{"target.sensor.pixels": [1000, 800]})
    inside = pictures(scene(), (0.1, -0.2))[0]
    same = pictures(wide, (0.01, -0.02))[0]
    assert float((inside - same).abs().max()) < 1e-6 * float(same.max())


@pytest.mark.parametrize("outside", [0.0, 4e-6, -6e-6])
def test_a_focused_spot_across_the_edge(outside: float, validated: Validated) -> None:
    """By reciprocity: the spot times the one that a pixel would put there, summed over the sensor."""
    one = scene()
    width = one.target.sensor.pixels[0] * one.target.sensor.pitch
    gaze = 0.5 + outside / width
    ours = pictures(one, (gaze, 0.1))[0]
    place = np.array([gaze * width, 0.1 * one.target.sensor.pixels[1] * one.target.sensor.pitch])

    def spot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        rho = np.maximum(np.hypot(x, y), 1e-12)
        return RADIUS * j1(K * RADIUS * rho / FOCAL) / rho

    # The last column ends at the sensor's edge; along it nothing turns too fast for wider steps.
    x = width / 2 - (np.arange(600) + 0.5) * 0.6e-6 - place[0]
    y = (np.arange(150) - 74.5) * 2.4e-6
    # Both spots' chirps about the lens's axis, the laser's place taken out.
    bend = (x[None, :] ** 2 + y[:, None] ** 2 + 2 * place[0] * x[None, :] + 2 * place[1] * y[:, None]) / FOCAL
    lit = spot(x[None, :], y[:, None]) * np.exp(1j * K * bend)
    q_x, q_y = OUTPUT.x().numpy()[::4], OUTPUT.y().numpy()[::4]
    want = np.empty((len(q_y), len(q_x)))
    for i, b in enumerate(q_y):
        for j, a in enumerate(q_x):
            seen = spot(x[None, :] + FOCAL * a / PROBE_FOCAL, y[:, None] + FOCAL * b / PROBE_FOCAL)
            want[i, j] = abs((lit * seen).sum()) ** 2
    got = ours.numpy()[::4, ::4]
    scale = pictures(one, (0.0, 0.0))[0].max() / abs(_whole(spot)) ** 2
    error = np.abs(got - float(scale) * want).max() / (float(scale) * want).max()
    what = f"in focus, f/12.5, middle of the spot {outside * 1e6:g} um beyond the edge"
    validated(SECTION, what, error, 3e-3, "the two spots' product summed over the sensor")


def _whole(spot: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> complex:
    x, y = (np.arange(1000) - 499.5) * 0.6e-6, (np.arange(250) - 124.5) * 2.4e-6
    square = x[None, :] ** 2 + y[:, None] ** 2
    return complex((spot(x[None, :], y[:, None]) ** 2 * np.exp(1j * K * square / FOCAL)).sum())


def test_a_sensor_that_scatters_too_ends_at_its_edge() -> None:
    """Its mirror was taken for one of all light, which with the scattered share was more than all."""
    values = {"target.sensor.reflectance": 0.5, "target.sensor.diffuse": {"albedo": 0.5}}
    one = with_values(
        load_scene("thin-lens"), {**values, "target.sensor.pixels": [60, 60], "probe.sensor.pixels": [32, 32]}
    )
    edge = 30 * one.target.sensor.pitch
    y = math.degrees(math.atan(edge / one.target.lens.focal_length))
    image = retroreflect(one, [[0.0, y]], accuracy=1e-2, device="cpu")
    assert math.isfinite(image.metadata["expected_error"]) and float(image.irradiance.max()) > 0


def test_the_return_fades_over_the_edge(validated: Validated) -> None:
    """Sampled where the edge cuts, by the table elsewhere: nothing jumps between them."""
    focused = 1.0
    one = scene(**{"target.object_distance": focused})
    width = one.target.sensor.pixels[0] * one.target.sensor.pitch
    spot = RADIUS * FOCAL / focused
    at = [0.5 + step * spot / width for step in (-3, -1.6, -0.8, 0, 0.8, 1.6)]
    power = pictures(one, *((gaze, 0.0) for gaze in at), output=Grid(97, 97, 18e-6)).sum((1, 2))
    power = power / power[0]
    assert bool((power.diff() < 2e-2).all())
    # Of the rays that the lens lets out again, 2 z t beside where they entered, those that the sensor held.
    z = 1 / (1 / FOCAL - 1 / focused)
    side = torch.linspace(-RADIUS, RADIUS, 401, dtype=torch.float64)
    square = side[:, None] ** 2
    inward, back = side, width - side * (2 * z / FOCAL - 1)
    out = (inward**2 + square < RADIUS**2) & (back**2 + square * (2 * z / FOCAL - 1) ** 2 < RADIUS**2)
    held = out & (inward * (1 - z / FOCAL) < 0)
    by_rays = float(held.sum() / out.sum())
    wide = with_values(one, {"target.sensor.pixels": [1000, 80]})
    whole, cut = (
        pictures(sensor, (gaze, 0.0), output=Grid(97, 97, 18e-6)).sum() for sensor, gaze in ((wide, 0.05), (one, 0.5))
    )
    error = abs(float(cut / whole) - by_rays)
    validated(SECTION, "power of a defocused spot whose half the edge cuts", error, 0.03,
              "rays", "of the whole")  # fmt: skip
    assert float(power[-1]) < 1e-3


def test_layers_answer_beside_the_sensor() -> None:
    one = scene(**{"target.sensor.layers": [{"depth": 2e-4, "reflectance": 0.2}]})
    only = replace(one, target=replace(one.target, sensor=replace(one.target.sensor, reflectance=0.0)))
    beside, cut = pictures(one, (0.85, 0.0), (0.5, 0.0))
    want, _ = pictures(only, (0.85, 0.0), (0.5, 0.0))
    assert float((beside - want).abs().max()) < 1e-6 * float(want.max())
    assert float((cut - want).abs().max()) > 0


def test_behind_a_traced_lens_a_cut_spot_is_refused_or_dimmed() -> None:
    """The rule itself: gazes of one batch go each their own way."""
    light = SpotLight(1e-4, 1e-6, 1e7, 0.1, 5e-3, torch.tensor([[1.0, 0.0, 0.0]]))
    places = torch.tensor([[2e-3, 0], [0, 0], [1e-3, 0.0]])
    spots = Spots.of(SensorEdge(-1e-3, 1e-3, -1e-3, 1e-3), places, light, 0.05)
    end = SensorEnd(lambda: lambda sines, _: torch.full((len(sines), 1, 1), 0.25), None, Grid(1, 1, 1e-6))
    at = torch.tensor([[0.3, 0.0], [0.1, 0.0], [0.2, 0.0]])

    def whole(sines: torch.Tensor, _: torch.Tensor | None) -> torch.Tensor:
        return 10 * sines[:, :1, None]

    seen = end.seen(whole, spots, "dimmed", at, None).flatten()
    assert seen.tolist() == pytest.approx([0.25, 1.0, 0.5 * 2 + 0.5 * 0.25])
    with pytest.raises(InputError, match="across the edge"):
        end.seen(whole, spots, "exact", at, None)


@pytest.mark.slow
def test_across_the_edge_of_a_traced_lens_is_refused_and_filmed() -> None:
    traced = load_scene("rotation", ["sampling.accuracy=0.05"])
    at = tilt_of_gaze(traced, torch.tensor([[0.0, 0.4999]], dtype=torch.float64))
    camera = Camera(traced, float(at.norm()), output=OUTPUT, device="cpu")
    with pytest.raises(InputError, match="across the edge"):
        camera(at)
    middle, dimmed = Camera(traced, float(at.norm()), output=OUTPUT, edge="dimmed", device="cpu")(
        torch.cat([torch.zeros_like(at), at])
    )
    assert bool(torch.isfinite(dimmed).all()) and float(dimmed.max()) < float(middle.max())


def test_films_over_the_edge() -> None:
    one = scene(**{"sampling.accuracy": 3e-2})
    gaze = torch.tensor([[0.0, 0.0], [0.498, 0.0], [0.52, 0.3], [0.7, 0.0]], dtype=torch.float64)
    count, still = len(gaze), np.zeros(len(gaze))
    filmed = Returns(one, tilt_of_gaze(one, gaze), np.zeros((count, 2)), still, np.full(count, one.distance))
    light = [float(filmed.patches(i)[0].light.sum()) for i in range(count)]
    assert light[0] > light[1] > 0
    assert light[3] == 0
