"""Glints: reflections by the surfaces of a traced lens themselves.

A ray that meets a surface along its normal retraces its path. For each gaze each surface has one such ray, or a few, or
none where its normal points out of the lens. Near that ray the surface, seen through those before it, acts as a curved
mirror: parallel light of 1 W/m² leaves as if from a point, with R dA/dΩ watts a steradian, dA/dΩ = 1/|det ∂s/∂e| by the
neighbouring rays (e in the entrance pupil, s the direction at the end). That point lies millimetres to centimetres from
the pupil. From the probe, metres away, all glints differ only in place and brightness: they are defocused discs of the
probe's aperture, with its rings. As the lens turns, the glint of each surface moves at its own rate, like the Purkinje
images of an eye.

This is geometrical optics, except at the probe's aperture: an edge of the lens cuts a glint at once, where waves would
fade within a Fresnel zone √(λL). Glints add to each other and to the light of mirrors as intensities: their paths
differ by millimetres times the gaze, and hand motion averages fringes within an exposure. Left out are double
reflections, and the coatings' loss in the light that passes.
"""

# Torch types svdvals in part only.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from tapetum.optics.focus import FocusedLens
from tapetum.optics.grid import Grid
from tapetum.optics.radial import disc_transform
from tapetum.optics.rays import Lens, before, normals, sag, to_plane, trace, trace_out
from tapetum.simulate.foreshortening import foreshortening
from tapetum.simulate.round_picture import BandLimitedDisc

__all__ = ["GlintTable", "Glints", "glint_table", "glint_tables"]

# Places along each surface, and the displacement of the rays beside each, in pupil radii.
_PLACES, _BESIDE = 1201, 1e-4
# Between the indices of air and of any glass.
_AIR = 1.1
# Share of the accuracy, over the peak of a gaze's brightest glint, below which rings are not drawn; over the peak of
# all its light, where more returns than glints.
_NOT_DRAWN, _NOT_SEEN = 1e-3, 3e-4
# At least the shadow of the aperture is drawn: fractions of a glint's peak that its rings stay below.
_SHADOW = 0.05
# Samples of the pictures of glints that are drawn together.
_AT_ONCE = 1 << 22
# Step of the radial profile, in parts of the finest ring's period.
_FINE = 8


@dataclass(frozen=True, eq=False)
class GlintTable:
    """Glints of one surface, by the place where light meets it: [N] each, from one rim to the other.

    Parameters
    ----------
    surface
        Its number in the lens.
    sine
        Sine of the tilt that lights the place along its normal, positive as for `trace_bundle`.
    e
        Where that ray crosses the entrance pupil, along the tilt, in metres.
    area
        dA/dΩ, in m²/sr.
    passes
        Whether no rim stops the ray.
    """

    surface: int
    sine: torch.Tensor
    e: torch.Tensor
    area: torch.Tensor
    passes: torch.Tensor

    @cached_property
    def _between(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Sines [N - 1] that light passes between each two places; no sine lies between infinities."""
        both = self.passes[:-1] & self.passes[1:]
        low, high = self.sine[:-1], self.sine[1:]
        # Half-open, so that a tilt that falls on a node counts once.
        return torch.where(both, torch.minimum(low, high), math.inf), torch.maximum(low, high)

    def at(self, sines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Glints of tilts [B] (sines): the index of each one's tilt, its place e and its area, [G] each."""
        low, high = self.sine[:-1], self.sine[1:]
        lower, upper = self._between
        which, k = ((lower <= sines[:, None]) & (sines[:, None] < upper)).nonzero(as_tuple=True)
        t = (sines[which] - low[k]) / (high[k] - low[k])
        e = self.e[k] + t * (self.e[k + 1] - self.e[k])
        # The area is smooth where it is finite, its inverse elsewhere.
        inverse = 1 / self.area[k] + t * (1 / self.area[k + 1] - 1 / self.area[k])
        return which, e, 1 / inverse


def glint_tables(focused: FocusedLens, wavelength: float) -> list[GlintTable]:
    """Tables of all surfaces between glass and air except plane plates, at the wavelength of `focused`."""
    return [glint_table(focused, i, wavelength) for i in range(len(focused.lens)) if _coated(focused.lens, i)]


def glint_table(focused: FocusedLens, surface: int, wavelength: float) -> GlintTable:
    """Trace the rays that meet the surface of this number along its normal; `wavelength` in metres."""
    lens = focused.lens
    h = torch.linspace(-1, 1, _PLACES, dtype=torch.float64) * lens.semi_diameter[surface]
    zero = torch.zeros_like(h)
    height, _ = sag(lens, surface, h**2)
    at = torch.stack([zero, h, lens.z[surface] + height], -1)
    # Outwards along the normal: the reversed path of a ray that enters.
    out = trace_out(before(lens, surface), at, -normals(lens, surface, at))
    crossing, _ = to_plane(out.position, out.direction, focused.entrance_pupil)
    sine, e = -out.direction[:, 1], crossing[:, 1]
    inwards = -out.direction
    passes = out.good & (out.height <= 1).all(-1)
    # Only rays that leave are followed back.
    some = passes.nonzero()[:, 0]
    area = torch.full_like(sine, torch.nan)
    area[some], passes[some] = _areas(focused, surface, e[some], inwards[some], wavelength)
    return GlintTable(surface, sine, e, area, passes)


def _areas(
    focused: FocusedLens, surface: int, e: torch.Tensor, inwards: torch.Tensor, wavelength: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """dA/dΩ [N] of rays along a surface's normals, given by e [N] and their directions [N, 3]; and which come back."""
    zero = torch.zeros_like(e)
    # Three rays of one direction: this one, and its neighbours across and along the tilt.
    step = _BESIDE * focused.entrance_radius
    beside = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64) * step
    start = torch.stack([zero, e, zero + focused.entrance_pupil], -1)[:, None] + beside
    back, good = _there_and_back(focused.lens, surface, start, inwards[:, None].expand_as(start))
    # In coordinates across the ray: its own, and those of the displacements.
    along = torch.stack([zero, inwards[:, 2], -inwards[:, 1]], -1)
    turned = (back[:, 1:] - back[:, :1]) / step
    matrix = torch.stack([turned[..., 0], (turned * along[:, None]).sum(-1)], -1)
    # At folds, and where a whole ring of the surface faces the light, all rays go one way; diffraction by the pupil
    # then spreads the return like an L of its Fresnel length a²/λ.
    most = focused.entrance_radius**2 / wavelength
    spread = torch.linalg.svdvals(torch.nan_to_num(matrix)).clamp_min(1 / most)
    area = inwards[:, 2] / spread.prod(-1)
    return area, good.all(-1) & torch.isfinite(matrix).all(-1).all(-1)


class Glints:
    """The glints of a lens before a probe, for any number of gazes.

    Parameters
    ----------
    tables
        Of its surfaces, at the wavelength.
    reflectance
        Of each surface between glass and air, for power.
    output, dtype
        Pixels of the probe's sensor, and the pictures' type.
    wavelength, distance, probe_radius, probe_focal_length
        λ, d, R_p and f_p, in metres.
    accuracy
        Of the picture, in fractions of its peak: a thousandth of it is left out of a glint's faint rings.
    """

    def __init__(
        self,
        tables: Sequence[GlintTable],
        reflectance: float,
        output: Grid,
        *,
        wavelength: float,
        distance: float,
        probe_radius: float,
        probe_focal_length: float,
        accuracy: float = 1e-2,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        self._tables, self._dtype = tables, dtype
        self._output, self._scale = output, probe_focal_length / distance
        k = 2 * math.pi / wavelength
        # Shadow of the aperture, its rings, and the picture's extent beyond them.
        reach = math.hypot(output.width, output.height) + probe_radius * self._scale
        finest = wavelength * probe_focal_length / (2 * probe_radius)
        values, step = disc_transform(
            probe_radius, k / (2 * distance), k / probe_focal_length, reach, spacing=finest / _FINE
        )
        strength = reflectance / (distance * wavelength * probe_focal_length) ** 2
        radii, profile = np.arange(len(values)) * step, abs(values) ** 2 * strength
        self._disc = BandLimitedDisc(radii, profile, output.pitch, finest, dtype)
        # The most irradiance at a distance or beyond, rising, to look up where a glint becomes faint.
        self._beyond, self._radii = np.maximum.accumulate(profile[::-1]), radii[::-1]
        self._accuracy, self._peak = accuracy, float(profile.max())

    def places(self, sines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """All G glints of tilts [B, 2] (sines).

        Returns the index of each one's tilt [G], its (x, y) on the probe's sensor from the RR's centre [G, 2] in
        metres, and its area [G] in m²/sr.
        """
        size = torch.sqrt((sines**2).sum(-1).clamp_min(1e-22))
        found = [table.at(size) for table in self._tables]
        which, e, area = (torch.cat(parts) for parts in zip(*found, strict=True))
        at = e[:, None] * (sines / size[:, None])[which]
        rotation, triangle = foreshortening(sines)
        seen = ((rotation @ triangle)[which] @ at[..., None])[..., 0]
        return which, -self._scale * seen, area

    def __call__(
        self, sines: torch.Tensor, centres: torch.Tensor | None = None, beside: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Irradiance [B, H, W] on the probe's pixels for 1 W/m² at the target.

        `sines` [B, 2] are those of the tilt along x and y; `centres` [B, 2] place the RR's own centre on the probe's
        sensor, in metres, by default in the middle. `beside` [B] is the peak of the other light that returns, also for
        1 W/m² at the target: rings far below it are not drawn.
        """
        sines, grid = sines.cpu().to(torch.float64), self._output
        images = torch.zeros(len(sines), grid.rows, grid.columns, dtype=self._dtype)
        which, places, areas = self.places(sines)
        if not len(which):
            return images
        at = places if centres is None else places + centres.cpu()[which].to(places)
        # All glints of a gaze in a row; those that it lacks are dark, at the place of its first.
        order, count = which.argsort(stable=True), torch.bincount(which, minlength=len(sines))
        number = torch.arange(int(count.max())).expand(len(sines), -1)
        row = (count.cumsum(0) - count)[:, None] + torch.where(number < count[:, None], number, 0)
        row = order[row.clamp_max(len(which) - 1)]
        area = torch.where(number < count[:, None], areas[row], 0.0)
        x = at[row, 0] / grid.pitch + (grid.columns - 1) / 2
        y = at[row, 1] / grid.pitch + (grid.rows - 1) / 2
        lit = count.nonzero()[:, 0]
        reach = self._reach(area.detach().amax(1), beside)[lit]
        wide = torch.maximum(*(one[lit].detach().amax(1) - one[lit].detach().amin(1) for one in (x, y)))
        side = self._disc.side(float((wide + 2 * reach).max()))
        # Pictures of one size about the middle of each gaze's glints, on whole pixels; of these the part on the sensor.
        middle = [(one.detach().amax(1) + one.detach().amin(1) + 1 - side) / 2 for one in (x, y)]
        low = torch.stack([torch.round(one) for one in middle], -1).long()
        first, last = low.clamp_min(0), torch.minimum(low + side, torch.tensor([grid.columns, grid.rows]))
        lit = lit[(last > first).all(-1)[lit]]
        if not len(lit):
            return images
        size = [int(one) for one in (last - first)[lit].amax(0)]
        for some in lit.split(max(1, _AT_ONCE // self._disc.samples(side))):
            start = first[some]
            at_x, at_y = x[some] - start[:, :1], y[some] - start[:, 1:]
            pictures = self._disc.draw(side, area[some], at_x, at_y, columns=size[0], rows=size[1])
            for i, picture in zip(some.tolist(), pictures, strict=True):
                (left, top), (right, bottom) = first[i].tolist(), last[i].tolist()
                images[i, top:bottom, left:right] = picture[: bottom - top, : right - left]
        return images

    def _reach(self, brightest: torch.Tensor, beside: torch.Tensor | None) -> torch.Tensor:
        """Distances [B] in pixels beyond which rings of glints are faint, of gazes whose largest areas are [B]."""
        faint = torch.full_like(brightest, _NOT_DRAWN * self._peak)
        if beside is not None:
            faint = torch.maximum(faint, _NOT_SEEN * beside.cpu().to(faint) / brightest)
        faint = (self._accuracy * faint).clamp_max(_SHADOW * self._peak)
        return torch.from_numpy(self._radii[np.searchsorted(self._beyond, faint.numpy())] / self._output.pitch)


def _coated(lens: Lens, i: int) -> bool:
    """Whether a surface separates glass from air: cement has no coating, and plane plates are a sensor's layers."""
    before, behind = float(lens.index[i]), float(lens.index[i + 1])
    if not min(before, behind) < _AIR < max(before, behind):
        return False
    other = i + 1 if behind > before else i - 1
    return _bends(lens, i) or (0 <= other < len(lens) and _bends(lens, other))


def _bends(lens: Lens, i: int) -> bool:
    return bool((lens.curvature[i] != 0) | (lens.asphere[i] != 0).any())


def _there_and_back(
    lens: Lens, surface: int, position: torch.Tensor, direction: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions [..., 3] in which rays reflected by a surface leave, and whether they came through, rims apart."""
    part = before(lens, surface + 1)
    # The index is the same on both sides: the surface does not bend the rays.
    part = replace(part, index=torch.cat([part.index[:-1], part.index[-2:-1]]))
    rays = trace(part, position, direction)
    normal = normals(lens, surface, rays.position)
    turned = rays.direction - 2 * (rays.direction * normal).sum(-1, keepdim=True) * normal
    back = trace_out(before(lens, surface), rays.position, turned)
    return back.direction, rays.good & back.good
