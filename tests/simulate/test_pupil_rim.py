"""Where the rim of a pupil is sharp, by rays that share no code with its planes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from tapetum.bench import PrescriptionLens
from tapetum.optics.focus import FocusedLens
from tapetum.optics.rays import trace
from tapetum.simulate.pupil_fits import fit_pupils, values_at
from tapetum.simulate.pupil_rim import leaving_by, pupil_depth, rim_depths, rim_plane, seen_heights, sharp_plane
from tapetum.simulate.traced_return import corrected, trace_return

SECTION = "Traced lenses"


def crossing(lens: FocusedLens, surface: int, sine: float, side: float) -> tuple[float, float]:
    """Height and z at which two rays cross, before the lens, that meet the rim of a surface above (1) or below (-1)."""
    ends = []
    for tilt in (sine - 1e-3, sine + 1e-3):
        way = torch.tensor([[[0.0, tilt, math.sqrt(1 - tilt**2)]]], dtype=torch.float64)

        def beyond(y: float, way: torch.Tensor = way) -> float:
            place = torch.tensor([[[0.0, side * y, lens.entrance_pupil]]], dtype=torch.float64)
            return float(trace(lens.lens, place, way).height[0, 0, surface]) - 1

        y = brentq(beyond, 0.7 * lens.entrance_radius, 1.3 * lens.entrance_radius, xtol=1e-13)
        ends.append((side * y, tilt / math.sqrt(1 - tilt**2)))
    (first, one), (second, other) = ends
    z = (first - second) / (other - one)
    return first + one * z, lens.entrance_pupil + z


@pytest.mark.parametrize(
    ("name", "f_number", "degrees"),
    [
        ("compact-6mm-f1.9", 4.0, 2.0),
        ("photo-50mm-f1.8", 5.6, 2.0),
        ("cmount-12mm-f1.4", 4.0, 3.0),
        ("la1509", 8.0, 2.0),
    ],
)
def test_the_plane_leans_as_rays_through_the_rim_cross(
    name: str, f_number: float, degrees: float, validated: Any
) -> None:
    lens = PrescriptionLens(name, f_number=f_number).focused(640e-9, 1.0)
    sine = math.sin(math.radians(degrees))
    sines = torch.tensor([sine], dtype=torch.float64)
    lean, deeper = (float(one) for one in sharp_plane(lens, sines))
    middle, worst = rim_plane(lens, sines)[0], 0.0
    stop = lens.lens.stop
    for side in (1.0, -1.0):
        y, z = crossing(lens, stop, sine, side)
        worst = max(worst, abs(float(middle[2]) + deeper + lean * (y - float(middle[1])) - z))
        e = torch.tensor([[0.0, y - float(middle[1])]], dtype=torch.float64)
        depth = float(rim_depths(lens, e, torch.tensor([[0.0, sine]], dtype=torch.float64), torch.tensor([stop])))
        assert abs(float(middle[2]) + depth - z) < 0.01 * abs(z - float(middle[2])) + 3e-4 * lens.entrance_radius
    what = f"place at which the rim is sharp under a tilt, {name} f/{f_number:g}, {degrees:g}°"
    validated(SECTION, what, worst / lens.entrance_radius, 0.01, "rays through the rim", "of the pupil's radius")


def places_of_the_rim(lens: FocusedLens, sine: float, turned: float, side: float, shares: NDArray[Any]) -> NDArray[Any]:
    """Along the tilt, where rays meet the stop's rim that are turned against it by these shares of a turn, each taken
    where it crosses the plane of `leaving_by` and from there along the tilt."""
    sines = torch.tensor([sine], dtype=torch.float64)
    lean, deeper = (float(one) for one in sharp_plane(lens, sines))
    middle, slope = rim_plane(lens, sines)[0], sine / math.sqrt(1 - sine**2)
    found: list[float] = []
    for share in shares:
        cosine = sine - share * turned
        way = torch.tensor([[[0.0, cosine, math.sqrt(1 - cosine**2)]]], dtype=torch.float64)

        def beyond(y: float, way: torch.Tensor = way) -> float:
            place = middle + torch.tensor([0.0, y, deeper + lean * y], dtype=torch.float64)
            return float(trace(lens.lens, place[None, None], way).height[0, 0, lens.lens.stop]) - 1

        y = side * brentq(
            lambda y: beyond(side * y), 0.7 * lens.entrance_radius, 1.3 * lens.entrance_radius, xtol=1e-15
        )
        found.append(y - (deeper + lean * y) * slope)
    return np.array(found)


@pytest.mark.parametrize(
    ("name", "f_number", "degrees"),
    [("cmount-12mm-f1.4", 4.0, 0.0), ("cmount-12mm-f1.4", 4.0, 1.5), ("compact-6mm-f1.9", 4.0, 2.0)],
)
def test_what_a_rim_sends_along_the_tilt_is_that_of_an_edge_at_the_mean_of_its_places(
    name: str, f_number: float, degrees: float, validated: Any
) -> None:
    """By the rim's places for 8 directions between the ray's and the tilt's, found one by one."""
    lens = PrescriptionLens(name, f_number=f_number).focused(640e-9, 0.2)
    sine, stop = math.sin(math.radians(degrees)), lens.lens.stop
    sines, worst = torch.tensor([sine], dtype=torch.float64), 0.0
    nodes, weights = np.polynomial.legendre.leggauss(8)
    for side in (1.0, -1.0):
        turned = -0.012 * side
        places = places_of_the_rim(lens, sine, turned, side, (nodes + 1) / 2)
        own = float(places_of_the_rim(lens, sine, turned, side, np.array([1.0]))[0])
        e = torch.tensor([[[0.0, float((weights * places).sum() / 2)], [0.0, own]]], dtype=torch.float64)
        turn = torch.tensor([[[0.0, turned]] * 2], dtype=torch.float64)
        # Rays' heights where they meet the rim are 1; beside it they grow with the square of e.
        heights = (e[..., 1:] / own) ** 2
        seen = seen_heights(lens, sines, e, turn, heights, [stop])[0, :, 0]
        moved = float((heights[0, 0, 0] - 1).abs())
        assert moved > 1e-5
        worst = max(worst, abs(float(seen[0]) - 1) / moved)
    what = f"edge by which a rim sends light along the tilt, {name} f/{f_number:g}, {degrees:g}°"
    validated(SECTION, what, worst, 0.02, "the rim's places by rays", "of the way from where rays meet it")


def test_corrected_pupils_have_the_edges_that_rims_send_from() -> None:
    """12 mm f/4 focused at 0.2 m, head on from 1 m: rays meet the rim 0.13 um, or 0.02 rad, from where its light seems
    to come from. Light that enters is sent by the rim as from there too, less what the paths of returning rays have
    in excess."""
    lens = PrescriptionLens("cmount-12mm-f1.4", f_number=4.0, focal_length=0.012).focused(640e-9, 0.2)
    fits = fit_pupils(lens, 0.03, curvature=1.0)
    pupils = corrected(lens, fits, curvature=1.0)
    assert pupils is not None
    zero = torch.zeros(1, dtype=torch.float64)
    tilt = pupils.nodes.terms(zero)
    back = trace_return(lens, zero, curvature=1.0, count=101)
    height = back.height[0, :, back.bundle.height.shape[-1] + lens.lens.stop]
    upwards = torch.nonzero(back.good[0] & (back.e[0, :, 0].abs() < 1e-9) & (back.e[0, :, 1] > 0))[:, 0]
    ray = upwards[(height[upwards] - 1).abs().argmin()]
    turned = float(back.turned[0, ray, 1])
    nodes, weights = np.polynomial.legendre.leggauss(8)
    places = places_of_the_rim(lens, 0.0, turned, 1.0, (nodes + 1) / 2)
    own = float(places_of_the_rim(lens, 0.0, turned, 1.0, np.array([1.0]))[0])
    wanted = float((weights * places).sum() / 2)

    def edge(heights: Callable[[float], float]) -> float:
        return brentq(lambda y: heights(y) - 1, 0.99 * wanted, 1.01 * wanted, xtol=1e-14)

    def leaving(y: float) -> float:
        return float(values_at(pupils.leaving, tilt, torch.tensor([[[0.0, y]]], dtype=torch.float64))[0][0, 3, 0])

    bundle = back.bundle
    line = torch.nonzero(bundle.good[0] & (bundle.e[0, :, 0].abs() < 1e-9) & (bundle.e[0, :, 1] > 0))[:, 0]
    s_of_e = CubicSpline(bundle.e[0, line, 1].numpy(), bundle.s[0, line, 1].numpy())

    def entering(y: float) -> float:
        place = torch.tensor([[[0.0, float(s_of_e(y))]]], dtype=torch.float64)
        return float(values_at(pupils.entering, tilt, place)[0][0, 2, 0])

    assert abs(edge(leaving) - wanted) < 0.05 * abs(own - wanted)
    at = torch.stack([bundle.e[0, ray], back.e[0, ray]])[None]
    more = values_at(pupils.leaving, tilt, at)[0][0, 0] - values_at(fits.leaving, fits.nodes.terms(zero), at)[0][0, 0]
    aside = -float(more[0] - more[1]) / turned
    assert abs(edge(entering) - (wanted + aside)) < 0.03 * abs(own - wanted)


def test_light_that_returns_the_way_it_came_has_the_place_and_the_path_it_had() -> None:
    lens = PrescriptionLens("compact-6mm-f1.9").focused(640e-9, 1.0)
    sines = torch.tensor([0.0, 0.05], dtype=torch.float64)
    e = 1e-3 * torch.tensor([[[0.3, -0.9], [0.0, 1.2]], [[-0.5, 0.4], [1.0, 0.0]]], dtype=torch.float64)
    start = torch.cat([e, torch.zeros(2, 2, 1, dtype=torch.float64)], -1) + rim_plane(lens, sines)[:, None]
    towards = torch.stack([torch.zeros_like(sines), sines, torch.sqrt(1 - sines**2)], -1)[:, None].expand(2, 2, 3)
    found, path = leaving_by(lens, sines, start + 3e-3 * towards, -towards)
    assert torch.allclose(found, e, rtol=0, atol=1e-15)
    # 3 mm back, and what the tilt has in it.
    assert torch.allclose(path, 3e-3 + sines[:, None] * e[..., 1], rtol=0, atol=1e-15)


def test_a_stop_before_all_surfaces_is_sharp_where_it_stands() -> None:
    lens = PrescriptionLens("phone-a").focused(640e-9, 1.0)
    lean, deeper = sharp_plane(lens, torch.tensor([0.3], dtype=torch.float64))
    assert pupil_depth(lens) == pytest.approx(0, abs=1e-12)
    assert float(lean) == pytest.approx(0, abs=1e-6) and float(deeper) == pytest.approx(0, abs=1e-9)
