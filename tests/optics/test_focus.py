"""Best focus: closed forms of the defocus that balances aberrations, and its being the best."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_rays import lens

from tapetum.errors import InputError
from tapetum.optics.focus import (
    best_focus,
    bundle,
    front_focus,
    moved_group,
    paraxial_image,
    pupil_height,
    stopped_down,
    wavefront,
)
from tapetum.optics.paraxial import paraxial
from tapetum.optics.rays import Lens, trace

F64 = torch.float64
N = 1.5
# Plano-convex, flat side to the light: much spherical aberration.
PLAIN = lens([0.0, 3e-3], [0.0, -1 / 25e-3], [1.0, N, 1.0], semi_diameter=4e-3)


def rms(one: Lens, distance: float, image: float) -> float:
    edge = pupil_height(one, distance)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    heights = torch.tensor(edge * np.sqrt((nodes + 1) / 2))
    values = wavefront(one, distance, image, heights).numpy()
    return float(np.sqrt(np.average((values - np.average(values, weights=weights)) ** 2, weights=weights)))


@pytest.mark.parametrize("distance", [math.inf, 2.0, 0.3])
def test_no_neighbour_is_better(distance: float) -> None:
    image = best_focus(PLAIN, distance)
    least = rms(PLAIN, distance, image)
    for step in (1e-6, 1e-5, 1e-4):
        assert least < rms(PLAIN, distance, image + step) and least < rms(PLAIN, distance, image - step)


def test_it_balances_spherical_aberration_half_way(validated) -> None:
    """Defocus balances primary spherical aberration half-way between the paraxial and the marginal focus."""
    small = replace(PLAIN, semi_diameter=torch.full((2,), 1.2e-3, dtype=F64))
    near = paraxial(small).focus
    edge = pupil_height(small)
    position, direction, _ = bundle(torch.tensor([edge], dtype=F64), 0.0, math.inf)
    rays = trace(small, position, direction)
    marginal = rays.position[0, 2] - rays.position[0, 1] * rays.direction[0, 2] / rays.direction[0, 1]
    half_way = (near + float(marginal)) / 2
    error = abs(best_focus(small, math.inf) - half_way) / abs(near - float(marginal))
    against = "half-way between paraxial and marginal focus"
    validated(
        "Ray tracing", "Best focus with primary spherical aberration, f/21", error, 5e-3, against, "of their distance"
    )


def test_a_perfect_lens_focuses_where_it_should(validated) -> None:
    """An ellipsoid and a sphere about its focus: the best focus is the only one."""
    radius, n = 10e-3, 1.6
    focus = n * radius / (n - 1)
    thick = 6e-3
    perfect = lens(
        [0.0, thick], [1 / radius, 1 / (thick - focus) * -1], [1.0, n, 1.0], conic=[-1 / n**2, 0.0], semi_diameter=4e-3
    )
    error = abs(best_focus(perfect, math.inf) - focus)
    validated("Ray tracing", "Focus of an ellipsoid, f/3.3", error, 1e-13, "n R/(n - 1)", "m")
    heights = torch.linspace(0, 4e-3, 9, dtype=F64)
    values = wavefront(perfect, math.inf, focus, heights)
    validated("Ray tracing", "Its wavefront", (values - values[0]).abs().max(), 1e-15, "none", "m")


def test_a_nearer_object_is_focused_farther_behind() -> None:
    slim = replace(PLAIN, semi_diameter=torch.full((2,), 0.2e-3, dtype=F64))
    f = paraxial(slim).focal_length
    image = best_focus(slim, math.inf)
    for distance in (5.0, 1.0, 0.2):
        before = distance + front_focus(slim) - paraxial(slim).entrance_pupil
        expected = f**2 / (before)
        assert best_focus(slim, distance) - image == pytest.approx(expected, rel=1e-4)
        assert paraxial_image(slim, distance) - paraxial(slim).focus == pytest.approx(expected, rel=1e-12)


def test_the_outermost_ray_is_the_rim_s() -> None:
    assert pupil_height(PLAIN) == pytest.approx(4e-3, rel=1e-4)
    # The second surface stops what the first lets through.
    second = replace(PLAIN, semi_diameter=torch.tensor([4e-3, 2.5e-3], dtype=F64))
    assert pupil_height(second) == pytest.approx(2.5e-3, rel=1e-4)
    assert pupil_height(second, 20e-3) < 2.4e-3


@pytest.mark.parametrize("f_number", [8.0, 13.5])
def test_stopping_down_closes_the_stop_alone(f_number: float) -> None:
    stop = lens([0.0, 3e-3, 9e-3], [60.0, -40.0, 0.0], [1.0, N, 1.0, 1.0], semi_diameter=4e-3, stop=2)
    closed = stopped_down(stop, f_number)
    taken = pupil_height(closed)
    assert taken == pytest.approx(paraxial(stop).focal_length / (2 * f_number), rel=1e-6)
    assert torch.equal(closed.semi_diameter[:2], stop.semi_diameter[:2])
    with pytest.raises(InputError, match="f_number: no ray is as far out"):
        stopped_down(stop, 0.1)


def test_moving_a_group_moves_no_other_surface() -> None:
    three = lens([0.0, 1e-3, 2e-3, 3e-3], [0.0] * 4, [1.0, 1.5, 1.0, 1.5, 1.0])
    assert moved_group(three, (1, 2), 1e-4).z.tolist() == pytest.approx([0.0, 1.1e-3, 2.1e-3, 3e-3])
    assert three.z.tolist() == [0.0, 1e-3, 2e-3, 3e-3]


def test_distances_without_an_image_are_refused() -> None:
    f = paraxial(PLAIN).focal_length
    for distance in (f / 2, -1.0, 0.0, math.nan):
        with pytest.raises(InputError, match=r"object_distance: .*; (focus farther away|give a positive one)"):
            best_focus(PLAIN, distance)
    hollow = lens([0.0, 1e-3], [-1 / 20e-3, 1 / 20e-3], [1.0, N, 1.0], semi_diameter=2e-3)
    with pytest.raises(InputError, match="has no image behind a lens"):
        best_focus(hollow, math.inf)


def test_a_lens_without_light_is_refused() -> None:
    shut = lens([0.0], [0.0], [1.5, 1.0], semi_diameter=1e-3)
    with pytest.raises(InputError, match="telecentric towards the object, or afocal"):
        best_focus(shut, math.inf)
