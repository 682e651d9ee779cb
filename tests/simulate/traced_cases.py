"""Real lenses for the tests of the traced engine, and their double pass by brute force: no polynomial, no shared grid.

`huygens` follows rays to the exit pupil and sums, over all of them and exactly, waves from there to every point of the
sensor and back: exp(ik |u - p|), without the second-order chirp, fits and interpolation of `TracedPass`.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from tapetum.bench import PrescriptionLens
from tapetum.optics.focus import FocusedLens
from tapetum.optics.fourier import phasor
from tapetum.optics.grid import Grid
from tapetum.optics.rays import to_plane, trace
from tapetum.simulate.probe_path import ProbePath
from tapetum.simulate.pupil_fits import PupilFits, fit_pupils
from tapetum.simulate.surfaces import Mask, Surface
from tapetum.simulate.traced_bundle import trace_bundle
from tapetum.simulate.traced_pass import TracedGrids, TracedPass
from tapetum.simulate.traced_plan import TracedGroup, traced_group

WAVELENGTH, PROBE_FOCAL = 640e-9, 0.1
K = 2 * math.pi / WAVELENGTH
MIRROR = Surface(0.0)


@dataclass(frozen=True)
class Case:
    """A lens of the catalogue, where it is focused, and the largest tilt in degrees."""

    name: str
    degrees: float
    distance: float = math.inf
    focal_length: float | None = None
    f_number: float | None = None
    curvature: float = 0.0

    def __str__(self) -> str:
        far = "∞" if math.isinf(self.distance) else f"{self.distance:g} m"
        zoomed = "" if self.focal_length is None else f" at {self.focal_length * 1e3:g} mm"
        stopped = "" if self.f_number is None else f" f/{self.f_number:.3g}"
        return f"{self.name}{zoomed}{stopped}, x_d = {far}"

    @property
    def steepest(self) -> float:
        return math.sin(math.radians(self.degrees))

    @property
    def lens(self) -> PrescriptionLens:
        values: dict[str, Any] = {"focal_length": self.focal_length, "f_number": self.f_number}
        return PrescriptionLens(self.name, **{key: value for key, value in values.items() if value is not None})


@functools.lru_cache(maxsize=16)
def traced(case: Case) -> tuple[FocusedLens, PupilFits]:
    """A case's lens and its pupils."""
    focused = case.lens.focused(WAVELENGTH, case.distance)
    return focused, fit_pupils(focused, case.steepest, curvature=case.curvature)


def picture(case: Case, pixels: int = 41, rings: float = 6.0) -> Grid:
    """Probe pixels that hold so many Airy rings of a return, on either side of the middle."""
    ring = WAVELENGTH * PROBE_FOCAL / (2 * case.lens.aperture_radius)
    return Grid(pixels, pixels, 2 * rings * ring / pixels)


def planned(
    case: Case, output: Grid, accuracy: float = 1e-2, *surfaces: Surface, pictures: int = 1000, **other: Any
) -> TracedGroup:
    """What the planner makes of a case, with as few samples as will do where `pictures` are many."""
    focused, fits = traced(case)
    options = {"wavelength": WAVELENGTH, "probe_focal_length": PROBE_FOCAL, "curvature": case.curvature, **other}
    return traced_group(focused, fits, surfaces or (MIRROR,), output, accuracy=accuracy, pictures=pictures, **options)


def finer(
    one: TracedPass,
    output: Grid,
    times: float = 2.0,
    *,
    window: float = 2.0,
    leaving: float | None = None,
    **other: Any,
) -> TracedPass:
    """The same pass, in double precision, with a wider window on the sensor and more samples of everything.

    `leaving` is how many times as many there are on the way out, `times` where it is left out.
    """
    g = one.grids
    half = window * g.half_width
    # A wider window turns faster: its samples grow with both.
    grids = TracedGrids(
        math.ceil(times * window * g.pupil),
        math.ceil(times * window * g.sensor),
        half,
        half - (g.half_width - g.flat) / 2,
        math.ceil(times * window * g.returning),
        math.ceil((leaving or times) * (g.leaving or g.pupil)),
    )
    return bare(other.pop("fits", one.fits), grids, output, other.pop("surface", one.surface), one.accepted)


def bare(
    fits: PupilFits,
    grids: TracedGrids,
    output: Grid,
    surface: Surface = MIRROR,
    accepted: float | None = None,
    mask: Mask | None = None,
) -> TracedPass:
    """A pass to the far field in double precision."""
    ends = 1.3 * fits.aperture[1] * torch.tensor([-1.0, 1.0], dtype=torch.float64)
    path = ProbePath(
        output,
        ends,
        ends,
        wavelength=WAVELENGTH,
        probe_focal_length=PROBE_FOCAL,
        dtype=torch.complex128,
    )
    options = {"wavelength": WAVELENGTH, "accepted": accepted, "mask": mask, "dtype": torch.complex128}
    return TracedPass(fits, grids, surface, path, **options)


def along_y(*degrees: float) -> torch.Tensor:
    """Sines [B, 2] of tilts along y."""
    sines = torch.sin(torch.deg2rad(torch.tensor(degrees, dtype=torch.float64)))
    return torch.stack([torch.zeros_like(sines), sines], -1)


def without_phase(field: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """The field times the one phase that brings it nearest to another."""
    overlap = (field.conj() * like).sum()
    return field * (overlap / overlap.abs())


def difference(field: torch.Tensor, like: torch.Tensor) -> float:
    """Largest difference of two fields but for one phase, in fractions of the second one's peak."""
    return float((without_phase(field, like) - like).abs().max() / like.abs().max())


def energy(one: TracedPass, sines: torch.Tensor) -> torch.Tensor:
    """[B] power that leaves for 1 W/m² of light, in W."""
    pupil, x, y = one.exit_pupil(sines)
    return (pupil.abs() ** 2).sum((1, 2)).double() * (x[:, 1] - x[:, 0]) * (y[:, 1] - y[:, 0])


@dataclass(frozen=True)
class Spokes:
    """Places in an entrance pupil, by its real edge, and their weights in m²."""

    e: torch.Tensor
    weights: torch.Tensor


def spokes(focused: FocusedLens, sine: float, radial: int, around: int, curvature: float = 0.0) -> Spokes:
    """Gauss's nodes on spokes that end where a rim stops the ray: the edge costs no accuracy."""
    coarse = trace_bundle(focused, torch.tensor([sine], dtype=torch.float64), curvature=curvature, count=41)
    inside = coarse.e[0][coarse.passing[0]]
    centre = torch.stack([torch.zeros(()).double(), (inside[:, 1].max() + inside[:, 1].min()) / 2])
    angle = 2 * math.pi * (torch.arange(around, dtype=torch.float64) + 0.5) / around
    unit = torch.stack([torch.cos(angle), torch.sin(angle)], -1)
    low = torch.zeros(around, dtype=torch.float64)
    high = low + 1.5 * float(torch.linalg.vector_norm(inside - centre, dim=-1).max())
    for _ in range(34):
        middle = (low + high) / 2
        rays, _ = _from_entrance(focused, centre + middle[:, None] * unit, sine, curvature)
        passes = rays.good & (rays.height <= 1).all(-1)
        low, high = torch.where(passes, middle, low), torch.where(passes, high, middle)
    nodes, weights = np.polynomial.legendre.leggauss(radial)
    share, weight = torch.tensor((nodes + 1) / 2), torch.tensor(weights / 2)
    e = centre + (low[:, None] * share)[..., None] * unit[:, None, :]
    area = low[:, None] ** 2 * share * weight * (2 * math.pi / around)
    return Spokes(e.reshape(-1, 2), area.reshape(-1))


def _from_entrance(focused: FocusedLens, e: torch.Tensor, sine: float, curvature: float) -> tuple[Any, torch.Tensor]:
    start = torch.cat([e, torch.full_like(e[:, :1], focused.entrance_pupil)], -1)
    axis = torch.tensor([0.0, sine, math.sqrt(1 - sine**2)], dtype=torch.float64)
    if curvature == 0:
        return trace(focused.lens, start, axis.expand_as(start)), e[:, 1] * sine
    source = -axis / curvature
    apart = torch.cat([e, torch.zeros_like(e[:, :1])], -1) - source
    length = torch.linalg.vector_norm(apart, dim=-1)
    return trace(focused.lens, start, apart / length[:, None]), length - 1 / curvature


@dataclass(frozen=True)
class Huygens:
    """The field that leaves, U3'(e), at places of the entrance pupil."""

    places: Spokes
    field: torch.Tensor
    sine: float

    @property
    def energy(self) -> float:
        return float((self.places.weights * self.field.abs() ** 2).sum())

    def image(self, output: Grid) -> torch.Tensor:
        """Field on the probe's pixels, [H, W]."""
        e, cosine = self.places.e, math.sqrt(1 - self.sine**2)
        columns = phasor(-K / PROBE_FOCAL * e[:, 0, None] * output.x())
        rows = phasor(-K / PROBE_FOCAL * cosine * e[:, 1, None] * output.y())
        value = self.field * self.places.weights * math.sqrt(cosine) / (1j * WAVELENGTH * PROBE_FOCAL)
        return rows.T @ (value[:, None] * columns)


def huygens(
    focused: FocusedLens,
    degrees: float,
    *,
    half_width: float,
    sensor: int,
    radial: int,
    around: int,
    curvature: float = 0.0,
) -> Huygens:
    """The double pass by rays to the exit pupil and waves from it to the sensor and back, summed one by one."""
    sine = math.sin(math.radians(degrees))
    into = spokes(focused, sine, radial, around, curvature)
    forth, y0, p_forth = _kernel_parts(focused, into.e, sine, curvature)
    out, back, p_back = into, forth, p_forth
    if curvature != 0:
        out = spokes(focused, sine, radial, around)
        back, _, p_back = _kernel_parts(focused, out.e, sine, 0.0, y0)
    step = 2 * half_width / sensor
    line = (torch.arange(sensor, dtype=torch.float64) - (sensor - 1) / 2) * step
    # Left is right, mirrored: half of the sensor tells of both, and of the middle column, if there is one, each half.
    right = line[line > -step / 4]
    share = torch.where(right < step / 4, 0.5, 1.0)
    total = torch.zeros(len(out.e), dtype=torch.complex128)
    weights = into.weights * (1 - sine**2) ** 0.25
    for v in line:
        places = torch.stack([right, v + torch.zeros_like(right)], -1)
        fade = ((torch.linalg.vector_norm(places, dim=-1) / half_width - 0.75) / 0.25).clamp(0, 1)
        lit = fade < 1
        u = torch.cat([places[lit], torch.zeros_like(places[lit][:, :1])], -1) + y0
        to = phasor(K * _beyond(u, p_forth, y0)) * forth
        spot = to @ weights.to(to.dtype) * torch.cos(fade[lit] * math.pi / 2) ** 2 * share[lit]
        fro = to if p_back is p_forth else phasor(K * _beyond(u, p_back, y0)) * back
        total += fro.T @ spot
    # Spokes lie mirrored about x = 0 where their number is even.
    assert around % 2 == 0
    mirrored = (around // 2 - 1 - torch.arange(around)) % around
    total = total + total.reshape(around, radial)[mirrored].flatten()
    return Huygens(out, total * step**2 / (1j * WAVELENGTH) ** 2, sine)


def _beyond(u: torch.Tensor, p: torch.Tensor, y0: torch.Tensor) -> torch.Tensor:
    """|u - p| - |y0 - p|, [U, N], without the difference of two long ways."""
    first, move = y0 - p, u - y0
    near = torch.linalg.vector_norm(first, dim=-1)
    more = 2 * move @ first.T + (move**2).sum(-1)[:, None]
    return more / (near + torch.sqrt(near**2 + more))


def _kernel_parts(
    focused: FocusedLens, e: torch.Tensor, sine: float, curvature: float, y0: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What a ray brings to y0, [N], with sqrt|∂s/∂e|; y0 [3]; and the exit pupil's points p [N, 3]."""
    e = e.clone().requires_grad_()
    rays, before = _from_entrance(focused, e, sine, curvature)
    landing, _ = to_plane(rays.position, rays.direction, focused.image)
    if y0 is None:
        y0 = torch.tensor([0.0, float(landing[:, 1].detach().mean()), focused.image], dtype=torch.float64)
    p, more = to_plane(rays.position, rays.direction, focused.exit_pupil)
    apart = y0 - p
    length = torch.linalg.vector_norm(apart, dim=-1)
    s = apart / length[:, None]
    rows = [torch.autograd.grad(s[:, i].sum(), e, retain_graph=True)[0] for i in (0, 1)]
    jacobian = (rows[0][:, 0] * rows[1][:, 1] - rows[0][:, 1] * rows[1][:, 0]).abs()
    psi = (before + rays.path + more + length).detach()
    # A common path of many wavelengths says nothing.
    return torch.sqrt(jacobian) * phasor(K * (psi - psi.mean())), y0, p.detach()


def with_mirror_at(focused: FocusedLens, depth: float) -> FocusedLens:
    """The lens with its sensor so much nearer."""
    return replace(focused, image=focused.image - depth)
