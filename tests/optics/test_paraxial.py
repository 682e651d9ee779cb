"""Cardinal numbers against the closed forms of thin and thick lenses."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_rays import RICH, lens

from tapetum.optics.glass import refractive_index
from tapetum.optics.paraxial import paraxial
from tapetum.optics.rays import Lens, reversed_lens, to_plane, trace

F64 = torch.float64


def thick(n: float, first: float, second: float, thickness: float) -> Lens:
    return lens([0.0, thickness], [1 / first, 1 / second], [1.0, n, 1.0])


@given(st.floats(1.4, 1.9), st.floats(20e-3, 90e-3), st.floats(-90e-3, -20e-3), st.floats(1e-3, 8e-3))
def test_a_thick_lens_by_the_lens_makers_formula(n: float, first: float, second: float, d: float) -> None:
    one = paraxial(thick(n, first, second, d))
    power = (n - 1) * (1 / first - 1 / second + (n - 1) * d / (n * first * second))
    assert one.focal_length == pytest.approx(1 / power, rel=1e-12)
    back = (1 - (n - 1) * d / (n * first)) / power
    assert one.focus == pytest.approx(d + back, rel=1e-12)


def test_la1509(validated) -> None:
    """The maker states 99.7 mm at the d line and, R being 51.5 mm, this at a laser's."""
    for nm, millimetres in ((587.562, 99.7), (640, 100.03), (785, 100.77)):
        n = refractive_index("N-BK7", nm * 1e-9)
        one = paraxial(lens([0.0, 3.6e-3], [1 / 51.5e-3, 0.0], [1.0, n, 1.0]))
        error = abs(one.focal_length / (millimetres * 1e-3) - 1)
        what = f"Focal length of LA1509-B at {nm:g} nm"
        validated("Ray tracing", what, error, 6e-4 if nm < 600 else 1e-4, f"{millimetres} mm", "of it")


def test_two_thin_lenses_and_a_stop_between() -> None:
    """f = f1 f2/(f1 + f2 - d); each pupil is the stop's image through the lens on its side."""
    n, f1, f2, gap, at = 1.5, 50e-3, 80e-3, 20e-3, 8e-3
    thin = 1e-9
    r1, r2 = 2 * (n - 1) * f1, 2 * (n - 1) * f2
    pair = lens(
        [0.0, thin, at, gap, gap + thin],
        [1 / r1, -1 / r1, 0.0, 1 / r2, -1 / r2],
        [1.0, n, 1.0, 1.0, n, 1.0],
        semi_diameter=3e-3,
        stop=2,
    )
    one = paraxial(pair)
    assert one.focal_length == pytest.approx(f1 * f2 / (f1 + f2 - gap), rel=1e-6)
    # The image of a point a behind a thin lens, seen through it: 1/s = 1/a - 1/f, virtual and behind it.
    assert one.entrance_pupil == pytest.approx(1 / (1 / at - 1 / f1), rel=1e-6)
    assert one.exit_pupil == pytest.approx(gap - 1 / (1 / (gap - at) - 1 / f2), rel=1e-6)
    assert one.entrance_radius == pytest.approx(3e-3 * one.entrance_pupil / at, rel=1e-6)
    assert one.f_number == pytest.approx(one.focal_length / (2 * one.entrance_radius))


def test_real_rays_close_to_the_axis() -> None:
    """The r² term of an asphere is curvature, too."""
    one = paraxial(RICH)
    height = 1e-6
    rays = trace(RICH, torch.tensor([0.0, height, -1e-3], dtype=F64), torch.tensor([0.0, 0.0, 1.0], dtype=F64))
    # Behind the last surface there is glass here: its image distance is longer by the index.
    landed, _ = to_plane(rays.position, rays.direction, RICH.z[-1])
    n = float(RICH.index[-1])
    slope = float(rays.direction[1] / rays.direction[2])
    assert one.focal_length == pytest.approx(-height / (n * slope), rel=1e-4)
    assert float(landed[1]) > 0


def test_turning_a_lens_round_keeps_its_focal_length_and_swaps_its_pupils() -> None:
    one = lens([0.0, 2e-3, 5e-3, 9e-3, 11e-3], [60.0, 20.0, 0.0, 10.0, -50.0], [1.0, 1.7, 1.0, 1.0, 1.6, 1.0], stop=2)
    there, back = paraxial(one), paraxial(reversed_lens(one))
    end = float(one.z[-1])
    assert back.focal_length == pytest.approx(there.focal_length, rel=1e-12)
    assert end - back.exit_pupil == pytest.approx(there.entrance_pupil, rel=1e-12)
    assert end - back.entrance_pupil == pytest.approx(there.exit_pupil, rel=1e-12)


def test_a_stop_in_the_focus_is_telecentric() -> None:
    n, r = 1.5, 30e-3
    f = r / (n - 1)
    one = paraxial(lens([0.0, 2e-3, 2e-3 + f], [0.0, -1 / r, 0.0], [1.0, n, 1.0, 1.0], stop=2))
    assert abs(one.entrance_pupil) > 1e6 or math.isinf(one.entrance_pupil)
