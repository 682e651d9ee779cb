"""Planes in partially coherent light: each pair interferes by its own degree of coherence, whatever lies between."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch

from tapetum.bench import Scene, load_scene, with_values
from tapetum.optics.grid import Grid
from tapetum.simulate import Camera
from tapetum.simulate.light import degree_of_coherence, wavelengths
from tapetum.simulate.reflections import specular_groups

SECTION = "The target's sensor"
WAVELENGTH, INDEX = 640e-9, 1.5
GRID = Grid(24, 24, 6e-6)


def scene(paths: tuple[float, ...], on: tuple[int, ...], **light: Any) -> Scene:
    """A sensor and layers nearer by these paths, there and back; those numbered `on` mirror, 0 being the sensor."""
    layers = [
        {"depth": path / 2 / INDEX, "index": INDEX, "reflectance": 0.1 if n + 1 in on else 0.0, "transmittance": 0.9}
        for n, path in enumerate(paths)
    ]
    return with_values(
        load_scene("thin-lens"),
        {
            "target.lens.focal_length": 0.02,
            "target.lens.aperture_radius": 1e-3,
            "target.object_distance": math.inf,
            "target.sensor": {"reflectance": 0.1 if 0 in on else 0.0, "layers": layers},
            **{f"illumination.{key}": value for key, value in light.items()},
        },
    )


def image(one: Scene) -> torch.Tensor:
    tilt = torch.tensor([[0.004, 0.003]], dtype=torch.float64)
    return Camera(one, 0.005, output=GRID, accuracy=1e-2, dtype=torch.complex128, device="cpu")(tilt)[0].double()


@pytest.mark.parametrize("steps", [(0.9, 0.9), (0.6, 0.6, 0.3)])
def test_each_pair_interferes_by_its_own_path(steps: tuple[float, ...], validated: Any) -> None:
    """The ends of a chain of planes do not interfere because each has a neighbour that it interferes with."""
    length = 1e-4
    paths = tuple(float(path) for path in np.cumsum(steps) * length)
    count = len(paths) + 1
    alone = [image(scene(paths, (n,))) for n in range(count)]
    want = torch.stack(alone).sum(0)
    for i, j in itertools.combinations(range(count), 2):
        apart = abs((0.0, *paths)[i] - (0.0, *paths)[j])
        share = max(0.0, 1 - apart / length)
        want = want + share * (image(scene(paths, (i, j))) - alone[i] - alone[j])
    got = image(scene(paths, tuple(range(count)), coherence_length=length))
    apart = float((got - want).abs().max() / want.max())
    what = f"planes {', '.join(f'{one:g}' for one in steps)} coherence lengths apart"
    validated(SECTION, what, apart, 1e-4, "pairs of planes in laser light, weighed by 1 - path/L", "of the peak")


@pytest.mark.parametrize("steps", [(0.9, 0.9)])
def test_a_bandwidth_is_the_sum_of_its_wavelengths(steps: tuple[float, ...], validated: Any) -> None:
    """Against a sum fine enough that nothing repeats; both cut the Gaussian off where the engine does."""
    bandwidth = 20e-9
    paths = tuple(float(path) for path in np.cumsum(steps) * WAVELENGTH**2 / bandwidth)
    on = tuple(range(len(paths) + 1))
    got = image(scene(paths, on, bandwidth=bandwidth))
    sigma = bandwidth / (2 * math.sqrt(2 * math.log(2)))
    at = np.linspace(-2.5, 2.5, 25)
    weights = np.exp(-(at**2) / 2)
    want = sum(
        (w * image(scene(paths, on, wavelength=WAVELENGTH + sigma * x)) for x, w in zip(at, weights, strict=True)),
        torch.zeros(()),
    ) / float(weights.sum())
    apart = float((got - want).abs().max() / want.max())
    what = f"planes {', '.join(f'{one:g}' for one in steps)} λ²/Δλ apart, 20 nm wide light"
    validated(SECTION, what, apart, 0.02, "25 laser lines", "of the peak")


def test_sets_hold_the_mutual_coherence() -> None:
    """Σ over the sets of the outer product of the planes' amplitudes is γ_ij times their amplitudes: never negative."""
    length = 1e-4
    rng = np.random.default_rng(7)
    for _ in range(20):
        paths = tuple(float(one) for one in np.sort(rng.uniform(0.02, 3, 5)) * length)
        one = scene(paths, tuple(range(6)), coherence_length=length)
        z = torch.tensor(0.02, dtype=torch.float64)
        found = np.zeros((6, 6))
        single = np.zeros(6)
        for group in specular_groups(one, WAVELENGTH, z, 0.1):
            row = np.zeros(6)
            for surface in group:
                plane = int(np.argmin(np.abs(np.array([0.0, *paths]) - 2 * surface.index * surface.depth)))
                row[plane] = complex(surface.orders[0].amplitude).real
            found += np.outer(row, row)
            single += row**2
        size = np.sqrt(single)
        places = np.array([0.0, *paths])
        gamma = np.maximum(0, 1 - np.abs(places[:, None] - places) / length)
        np.testing.assert_allclose(found, gamma * np.outer(size, size), atol=1e-6)
        # From the lens inwards each plane is dimmed by those before it.
        np.testing.assert_allclose(size**2, 0.1 * 0.9 ** (2 * (5 - np.arange(6))), rtol=1e-5)


def test_planes_that_do_not_interfere_are_not_computed_twice() -> None:
    z = torch.tensor(0.02, dtype=torch.float64)
    apart = specular_groups(scene((3e-4, 6e-4), (0, 1, 2), coherence_length=1e-4), WAVELENGTH, z, 0.1)
    assert [len(one) for one in apart] == [1, 1, 1]
    (every,) = specular_groups(scene((1e-3, 2e-3), (0, 1, 2)), WAVELENGTH, z, 0.1)
    assert len(every) == 3


def test_degrees_and_samples() -> None:
    light = scene((1e-4,), (0, 1), coherence_length=1e-4).illumination
    assert [degree_of_coherence(light, path) for path in (0.0, 2.5e-5, -5e-5, 1e-4, 1.0)] == [1.0, 0.75, 0.5, 0.0, 0.0]
    wide = scene((1e-4,), (0, 1), bandwidth=20e-9).illumination
    # Interference in sampled light comes back after λ²/δλ: not before the path has been left behind by 1.6 λ²/Δλ.
    path = 3 * WAVELENGTH**2 / 20e-9
    samples = [length for length, _ in wavelengths(wide, 1.0, path)]
    assert WAVELENGTH**2 / (samples[1] - samples[0]) > path + 1.6 * WAVELENGTH**2 / 20e-9
    assert len(wavelengths(wide, 1.0)) == 5
