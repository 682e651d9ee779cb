"""The catalogue's lenses traced by optiland, an independent ray tracer."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
import pytest
import torch

from tapetum.bench.lens_file import load_lens
from tapetum.bench.prescription import PrescriptionLens
from tapetum.optics.focus import FocusedLens
from tapetum.optics.rays import Lens, Rays, to_plane, trace

# Its just-in-time compiler takes longer than these few rays.
os.environ.setdefault("NUMBA_DISABLE_JIT", "1")
pytestmark = pytest.mark.filterwarnings("ignore")

WAVELENGTH = 640e-9
# A prime lens each, with even and odd powers and with conics, a fast one, and a zoom between its states.
LENSES = ["phone-a", "phone-c", "phone-f", "compact-6mm-f1.9", "cmount-12mm-f1.4", "photo-50mm-f1.8", "zoom-18-140mm"]


def make(name: str) -> tuple[FocusedLens, float]:
    """The lens focused at infinity, and the field that it covers."""
    lens = PrescriptionLens(name, focal_length=50e-3 if name == "zoom-18-140mm" else None)
    states = load_lens(name).states
    return lens.focused(WAVELENGTH, math.inf), states[1 if len(states) > 1 else 0].half_field


def peer(lens: Lens, image: float, radius: float, angle: float = 0.0) -> Any:
    """The same surfaces in optiland, in millimetres."""
    pytest.importorskip("optiland")
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic

    optic = Optic()
    optic.add_surface(index=0, thickness=np.inf)
    ends = [*lens.z.tolist(), image]
    for i in range(len(lens)):
        powers = lens.asphere[i].tolist()
        # Its odd asphere counts the powers from 1, ours from 2; millimetres.
        coefficients = [0.0, *(a * 1e-3 ** (j + 1) for j, a in enumerate(powers))]
        curvature = float(lens.curvature[i])
        kind: dict[str, Any] = {}
        if any(powers):
            # Rays that miss the surface are never within the tolerance; the others are after eight steps at most.
            kind = {"surface_type": "odd_asphere", "coefficients": coefficients, "tol": 1e-14, "max_iter": 10}
        optic.add_surface(
            index=i + 1,
            radius=1e3 / curvature if curvature else np.inf,
            thickness=1e3 * (ends[i + 1] - ends[i]),
            conic=float(lens.conic[i]),
            material=IdealMaterial(float(lens.index[i + 1])),
            is_stop=i == lens.stop,
            **kind,
        )
    optic.add_surface(index=len(lens) + 1)
    optic.set_aperture("EPD", 2e3 * radius)
    optic.set_field_type("angle")
    optic.add_field(y=math.degrees(angle))
    optic.add_wavelength(WAVELENGTH * 1e6, is_primary=True)
    return optic


def launch(lens: FocusedLens, angle: float, pupil: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Parallel rays of a field angle through points [N, 2] of the entrance pupil."""
    position = torch.cat([pupil, torch.full_like(pupil[:, :1], lens.entrance_pupil)], -1)
    direction = torch.tensor([0.0, math.sin(angle), math.cos(angle)], dtype=torch.float64).expand_as(position)
    return position, direction


def passing(rays: Rays) -> np.ndarray:
    return (rays.good & (rays.height <= 1).all(-1)).numpy()


@pytest.mark.parametrize("name", LENSES)
def test_rays_land_where_the_peer_s_do(name: str, validated) -> None:
    pytest.importorskip("optiland")
    from optiland.rays import RealRays

    focused, half_field = make(name)
    lens = focused.lens
    optic = peer(lens, focused.image, focused.entrance_radius)
    side = torch.linspace(-1, 1, 9, dtype=torch.float64) * focused.entrance_radius
    pupil = torch.cartesian_prod(side, side)
    off, turned, longer, count = 0.0, 0.0, 0.0, 0
    for share in (0.0, 0.5, 0.9):
        position, direction = launch(focused, share * half_field, pupil)
        # From before the first surface: the peer's rays start there.
        position = to_plane(position, direction, -5e-3)[0]
        rays = trace(lens, position, direction)
        landed, way = to_plane(rays.position, rays.direction, focused.image)
        x, y, z = (1e3 * position).T.numpy()
        theirs = RealRays(x, y, z, *direction.T.numpy(), np.ones_like(x), np.full_like(x, 1e6 * WAVELENGTH))
        optic.surface_group.trace(theirs, skip=1)
        kept = passing(rays)
        count += kept.sum()
        off = max(off, np.abs(1e-3 * np.stack([theirs.x, theirs.y], -1) - landed[:, :2].numpy())[kept].max())
        cosines = np.stack([theirs.L, theirs.M, theirs.N], -1)
        turned = max(turned, np.abs(cosines - rays.direction.numpy())[kept].max())
        longer = max(longer, np.abs(1e-3 * theirs.opd - (rays.path + way).numpy())[kept].max())
    assert count > 60
    conditions = f"{name}, 640 nm, on the axis and at 0.5 and 0.9 of the field"
    validated("Ray tracing", f"Where rays land, {conditions}", off, 1e-9, "optiland", "m")
    validated("Ray tracing", f"Their directions, {conditions}", turned, 1e-9, "optiland", "in direction cosines")
    validated("Ray tracing", f"Their optical path, {conditions}", longer, 1e-10, "optiland", "m")


def wavefront_error(focused: FocusedLens, angle: float, pupil: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Optical path against the chief ray's, to the sphere about its landing point through the exit pupil, in waves."""
    lens = focused.lens
    position, direction = launch(focused, angle, torch.cat([torch.zeros_like(pupil[:1]), pupil]))
    rays = trace(lens, position, direction)
    # The incoming wave is flat across its own direction.
    path = rays.path + (position * direction).sum(-1)
    landed, _ = to_plane(rays.position, rays.direction, focused.image)
    centre = landed[0]
    axis = torch.tensor([0.0, 0.0, focused.exit_pupil], dtype=torch.float64)
    radius = torch.linalg.vector_norm(centre - axis)
    toward = centre - rays.position
    along = (toward * rays.direction).sum(-1)
    side = math.copysign(1.0, focused.image - focused.exit_pupil)
    path = path + along - side * torch.sqrt(radius**2 - (toward**2).sum(-1) + along**2)
    return ((path[1:] - path[0]) / WAVELENGTH).numpy(), passing(rays)[1:]


@pytest.mark.parametrize("name", LENSES)
def test_wavefronts_are_the_peer_s(name: str, validated) -> None:
    """The peer launches, aims and refers its rays by itself. Its sign is the other one: ahead is positive."""
    pytest.importorskip("optiland")
    from optiland.distribution import create_distribution
    from optiland.wavefront import Wavefront

    focused, half_field = make(name)
    points = create_distribution("uniform")
    points.generate_points(9)
    pupil = torch.tensor(np.stack([points.x, points.y], -1)) * focused.entrance_radius
    waves = WAVELENGTH * 1e6
    worst = 0.0
    for share in (0.0, 0.5, 0.9):
        optic = peer(focused.lens, focused.image, focused.entrance_radius, share * half_field)
        theirs = Wavefront(optic, [(0, 1)], [waves], num_rays=9, distribution="uniform").get_data((0, 1), waves).opd
        ours, kept = wavefront_error(focused, share * half_field, pupil)
        assert kept.sum() > 15
        assert np.abs(ours[kept]).max() > 0.1
        worst = max(worst, np.abs(ours + np.asarray(theirs))[kept].max())
    what = f"Wavefront of {name}, 640 nm, on the axis and at 0.5 and 0.9 of the field"
    validated("Ray tracing", what, worst, 0.01, "optiland, its own rays and reference sphere", "wavelengths")


def test_focal_lengths_of_a_zoom(validated) -> None:
    """At the states of the patent and between them, against the peer's paraxial trace."""
    for name, wanted in (("zoom-18-140mm", (0.0186, 0.035, 0.085, 0.135)), ("zoom-5-15mm", (0.0052, 0.008, 0.0125))):
        worst = 0.0
        for focal in wanted:
            lens = PrescriptionLens(name, focal_length=focal)
            focused = lens.focused(lens.design_wavelength, math.inf)
            theirs = peer(focused.lens, focused.image, focused.entrance_radius).paraxial.f2()
            worst = max(worst, abs(1e-3 * float(np.squeeze(theirs)) / focal - 1))
        validated("Ray tracing", f"Focal length between the states of {name}", worst, 1e-9, "optiland", "of it")
