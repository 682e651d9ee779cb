"""Where the rim of a pupil is sharp, by rays that share no code with its planes."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from scipy.optimize import brentq

from tapetum.bench import PrescriptionLens
from tapetum.optics.focus import FocusedLens
from tapetum.optics.rays import trace
from tapetum.simulate.pupil_rim import leaving_by, pupil_depth, rim_depths, rim_plane, sharp_plane

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
