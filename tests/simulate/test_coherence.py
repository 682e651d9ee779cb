"""Planes in partially coherent light: each pair interferes by its own degree of coherence, whatever lies between."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch

from tapetum.bench import Scene, load_scene, with_values
from tapetum.errors import InputError
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
    """Against a sum fine enough that nothing repeats."""
    bandwidth = 20e-9
    paths = tuple(float(path) for path in np.cumsum(steps) * WAVELENGTH**2 / bandwidth)
    on = tuple(range(len(paths) + 1))
    got = image(scene(paths, on, bandwidth=bandwidth))
    sigma = bandwidth / (2 * math.sqrt(2 * math.log(2)))
    at = np.linspace(-4.5, 4.5, 45)
    weights = np.exp(-(at**2) / 2)
    want = sum(
        (w * image(scene(paths, on, wavelength=WAVELENGTH + sigma * x)) for x, w in zip(at, weights, strict=True)),
        torch.zeros(()),
    ) / float(weights.sum())
    apart = float((got - want).abs().max() / want.max())
    what = f"planes {', '.join(f'{one:g}' for one in steps)} λ²/Δλ apart, 20 nm wide light"
    validated(SECTION, what, apart, 0.01, "45 laser lines", "of the peak")


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
    # The middle of a line is one of its wavelengths; more of them where more of the phase turns over the line.
    few, many = wavelengths(wide), wavelengths(wide, 0.0, 3 * WAVELENGTH**2 / 20e-9)
    assert len(few) < len(many) and all(len(one) % 2 == 1 for one in (few, many))
    assert few[len(few) // 2][0] == many[len(many) // 2][0] == WAVELENGTH
    assert sum(power for _, power in many) == pytest.approx(wide.power)
    with pytest.raises(InputError, match="bandwidth: a line 2e-08 m wide takes"):
        wavelengths(wide, 1.0)


@pytest.mark.parametrize("depth", [40.21e-6, 40.25e-6, 40.29e-6])
def test_each_line_interferes_by_its_own_wavelength(depth: float, validated: Any) -> None:
    """The first line's reach decided for all: a picture changed by 0.87 of its peak when its lines changed places."""
    lines = [(500e-9, 1e-9), (1500e-9, 1e-3)]
    pictures = [
        image(
            scene(
                (2 * INDEX * depth,),
                (0, 1),
                wavelength=first[0],
                power=first[1],
                bandwidth=5e-9,
                lines=[{"wavelength": second[0], "power": second[1]}],
            )
        )
        for first, second in (lines, lines[::-1])
    ]
    apart = float((pictures[0] - pictures[1]).abs().max() / pictures[1].max())
    what = f"500 and 1500 nm, a layer {1e6 * depth:g} µm before the sensor, in either order"
    validated(SECTION, what, apart, 1e-5, "the other order", "of the peak")


@pytest.mark.parametrize(("focal_length", "depth"), [pytest.param(0.012, 1.5e-3, marks=pytest.mark.slow), (0.02, 3e-3)])
def test_a_filters_wide_return_has_wavelengths_for_its_rings(focal_length: float, depth: float, validated: Any) -> None:
    """Only the sensor's rings counted, and the accuracy did not: 0.067 of the peak off where 0.0011 was stated."""
    sensor = {"reflectance": 0.0, "layers": [{"depth": depth, "index": INDEX, "reflectance": 0.3}]}
    radius = 2e-3
    angle = 2 * radius * depth / INDEX / focal_length**2
    grid = Grid(33, 33, 0.2 * 2.4 * angle / 33 / 4)
    changes = {
        "target.lens.focal_length": focal_length,
        "target.lens.aperture_radius": radius,
        "target.object_distance": math.inf,
        "target.sensor": sensor,
        "sampling.propagation": "far field",
    }
    one = with_values(load_scene("thin-lens"), changes)
    tilt = torch.tensor([[0.004, 0.003]], dtype=torch.float64)

    def picture(given: Scene) -> torch.Tensor:
        return Camera(given, 0.005, output=grid, accuracy=1e-2, dtype=torch.complex128, device="cpu")(tilt)[0]

    got = picture(with_values(one, {"illumination.bandwidth": 20e-9}))
    sigma = 20e-9 / (2 * math.sqrt(2 * math.log(2)))
    at = np.linspace(-4, 4, 41)
    weights = np.exp(-(at**2) / 2) / np.exp(-(at**2) / 2).sum()
    want = torch.zeros_like(got)
    for x, w in zip(at, weights, strict=True):
        want += float(w) * picture(with_values(one, {"illumination.wavelength": WAVELENGTH + sigma * float(x)}))
    apart = float((got - want).abs().max() / want.max())
    what = f"a filter {1e3 * depth:g} mm before the focus of {1e3 * focal_length:g} mm, light 20 nm wide"
    validated(SECTION, what, apart, 0.004, "41 laser lines", "of the peak")


def test_a_weak_first_line_does_not_decide_how_finely_a_source_is_sampled(validated: Any) -> None:
    """Directions were those of the first line's fringes: 0.11 of the peak off where 0.01 was stated."""
    changes = {"target.lens.focal_length": 0.02, "target.lens.aperture_radius": 2e-3, "sampling.accuracy": 0.01}
    one = with_values(load_scene("thin-lens"), {**changes, "illumination.source_size": 3e-4})
    own = {"illumination.wavelength": 300e-9}
    weak = {
        "illumination.wavelength": 1900e-9,
        "illumination.power": 1e-9,
        "illumination.lines": [{"wavelength": 300e-9, "power": 1e-3}],
    }
    got, want = (
        Camera(with_values(one, each), 0.0, output=GRID, dtype=torch.complex128, device="cpu")(torch.zeros(1, 2))[0]
        for each in (weak, own)
    )
    apart = float((got - want).abs().max() / want.max())
    validated(SECTION, "300 nm beside a weak first line of 1900 nm", apart, 1e-3, "300 nm alone", "of the peak")
