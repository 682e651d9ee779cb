"""A traced lens as the sampled pass sees it: directions, paths and shares of light by polynomials of its rays.

A(s) is the share of the pupil that no rim covers times the root of |∂e/∂s|, which conserves energy; on the way out it
is a function of the place e with |∂s/∂e|, and the returning light is read at each place's own direction. What leaves is
in object space and propagates on from the entrance pupil (probe_path.py; docs/conventions.md, "Real lenses").

A plane tilted by a takes s to -s - 2a cosθ, to first order in a, and lies a·y0 farther at the spot.
"""

from __future__ import annotations

import math

import torch

from tapetum.optics.fourier import phasor
from tapetum.simulate.foreshortening import foreshortening, turned
from tapetum.simulate.probe_path import ProbePath
from tapetum.simulate.pupil_fits import PupilFits, edge_weights, on_grid, on_tilt_grid, open_share
from tapetum.simulate.pupils import Entering, Leaving
from tapetum.simulate.spot_window import RimLight

__all__ = ["TracedGazes", "TracedPupil"]

_NO_TILT = 1e-11
# The root of zero has no finite gradient.
_DARK = 1e-30
# Samples beyond a place that its interpolation reads.
_MARGIN = 2


class TracedPupil:
    """The pupils of a traced lens, of the light that enters and of the light that leaves.

    Parameters
    ----------
    fits
        The lens's pupils.
    samples
        Columns and rows of the entering pupil, of the returning field, which is interpolated, and of the leaving pupil.
    path
        From the lens to the probe's pixels.
    wavelength
        In metres.
    tilt
        a of the plane, in radians.
    straight
        Whether the plane is a mirror across the optical axis: what returns is then symmetric across the tilt, as is
        what enters.
    phase
        Added to what leaves, in radians.
    accepted
        Largest angle, in radians, under which light still reaches the picture, for `corrected` fits made for it.
    length, step
        N of `Leaving`, and λ/(N Δ): the returning field is computed in steps of it, in place of `samples`.
    dtype
        Of the fields.
    """

    fixed = False

    def __init__(
        self,
        fits: PupilFits,
        samples: tuple[int, int, int],
        path: ProbePath,
        *,
        wavelength: float,
        tilt: tuple[float, float] = (0.0, 0.0),
        straight: bool = False,
        phase: float = 0.0,
        accepted: float | None = None,
        length: int | None = None,
        step: float = 0.0,
        dtype: torch.dtype = torch.complex64,
    ) -> None:
        self.length, self.step = length, step
        self.fits, self.path, self.accepted, self.straight = fits, path, accepted, straight
        # Even, so that columns on one side of the middle mirror those on the other.
        self.samples = samples[0] + samples[0] % 2, samples[1], samples[2]
        self.k, self.tilt, self.phase, self.dtype = 2 * math.pi / wavelength, tilt, phase, dtype
        self.real = dtype.to_real()
        # A rim's light does not return to that rim where but a part of the pupil is read.
        landing = abs(fits.defocus) * fits.aperture[0]
        self.rim = None if fits.part is not None else RimLight(self.k * fits.bend, landing)

    def meets(self, farthest: float) -> float:
        """Distance of an order's direction from the pupil's within which it returns, as `PupilFits` says."""
        return self.fits.meets(farthest)

    def returns(self, sines: torch.Tensor) -> torch.Tensor:
        """Whether anything returns from tilts [B, 2]: beyond the last node the polynomials are invalid."""
        return _tilt_and_azimuth(sines)[0] <= self.fits.nodes.steepest * (1 + 1e-9)

    def foreshortens(self, sines: torch.Tensor) -> torch.Tensor:
        """Which tilts [B, 2] are drawn foreshortened: all, by their rays."""
        return torch.ones(len(sines), dtype=torch.bool, device=sines.device)

    def gazes(self, sines: torch.Tensor, own: bool, roll: torch.Tensor | None = None) -> TracedGazes:
        """Itself under tilts [B, 2], turned about its axis by `roll` [B] in radians from x to y."""
        return TracedGazes(self, sines, own, roll)


class TracedGazes:
    """A traced lens under a batch of tilts. A mirror's frame has columns across the tilt and rows along it.

    The lens is round: a roll only turns the tilt against what the sensor holds. What leaves the lens is in the probe's
    frame. `tilt` [B, T] are the tilts as `TiltNodes.terms`, `centre` [B] how far along them from y0 the spot's samples
    have their middle.
    """

    def __init__(self, pupil: TracedPupil, sines: torch.Tensor, own: bool, roll: torch.Tensor | None) -> None:
        fits = pupil.fits
        self._pupil, self._sines, self._own = pupil, sines, own
        size, self._seen = _tilt_and_azimuth(sines)
        self._toward = self._seen if roll is None else turned(self._seen, -roll)
        self._returns = pupil.returns(sines).to(torch.float64)
        self._size = size.clamp_max(fits.nodes.steepest)
        self.tilt = fits.nodes.terms(self._size)
        middle, radius = self.tilt @ fits.middle, self.tilt @ fits.radius
        self._chief = chief = middle / radius
        tx, ty = self._toward.unbind(-1)
        plane = torch.tensor(pupil.tilt, dtype=torch.float64, device=sines.device)
        # A plane tilted away is farther at the spot by this.
        self._nearer = -(self._toward @ plane) * middle
        self._shift = self._nearer * chief / torch.sqrt(1 - chief**2)
        # The spot's samples lie about this place, along the tilt from y0.
        self.centre = torch.zeros_like(middle) if fits.part is None else self.tilt @ fits.part.centre
        # Where the chief ray meets the plane.
        self.place = (middle - self._shift + self.centre)[:, None] * self._toward
        if own:
            self.axes = torch.eye(2, dtype=torch.float64, device=sines.device).expand(len(sines), 2, 2)
        else:
            self.axes = torch.stack([torch.stack([ty, -tx], -1), torch.stack([tx, ty], -1)], -2)
        # Of the tilt in the frame.
        self._x, self._y = (self.axes @ self._toward[..., None])[..., 0].unbind(-1)
        self.turn = torch.sqrt(1 - chief**2)[:, None] * (self.axes @ plane)
        self.middle = torch.stack([chief * self._x, chief * self._y], -1)
        self.bend = middle.new_tensor([fits.bend])
        # C turns light at the samples' middle, on each way by this.
        self._bent = (fits.bend * self.centre)[:, None]

    def entering(self) -> Entering:
        """The light on its way in."""
        one, inside = self._pupil, None
        if self._own:
            toward = torch.stack([self._x, self._y], -1)
            columns, rows, path, values, _, inside = on_grid(
                one.fits.entering, self.tilt, toward, one.samples[0], one.real
            )
        else:
            columns, rows, path, values = on_tilt_grid(one.fits.entering, self.tilt, one.samples[0], one.real)
        share = torch.sqrt(values[:, 0].clamp_min(_DARK))
        mirrored = not self._own
        share = share * edge_weights(open_share(values[:, 1:], inside, mirrored=mirrored), mirrored=mirrored)
        cell = (columns[:, 1] - columns[:, 0]) * (rows[:, 1] - rows[:, 0])
        # A tilted pupil receives less light.
        dimmed = cell * self._returns * (1 - self._size**2) ** 0.25
        strength = share * dimmed[:, None, None].to(one.real)
        if one.tilt != (0.0, 0.0):
            across, down = columns[:, None, :], rows[:, :, None]
            along = self._x[:, None, None] * across + self._y[:, None, None] * down
            path = path + self._taken(across**2 + down**2, along)
        if one.fits.part is not None:
            path = path + (rows * self.centre[:, None])[:, :, None]
            rows = rows + self._bent
        return Entering(columns, rows, strength, path, (not self._own, False))

    def leaving(self) -> Leaving:
        """The pupil on the way out, on columns and rows of the probe's picture."""
        one, fits = self._pupil, self._pupil.fits
        rotation, _ = foreshortening(self._sines)
        toward = (rotation.mT @ self._seen[..., None])[..., 0]
        x, y, path, even, odd, inside = on_grid(fits.leaving, self.tilt, toward, one.samples[2], one.real)
        out = torch.sqrt(even[:, 1].clamp_min(_DARK))
        if odd.shape[1] > 1:
            out = out * edge_weights(open_share(even[:, 3:], inside)) * self._accept(even[:, 2], odd[:, 1])
        else:
            out = out * edge_weights(open_share(even[:, 2:], inside))
        along, across = even[:, 0], odd[:, 0]
        if one.tilt != (0.0, 0.0):
            path = path + self._taken(along**2 + across**2, along)
        if fits.part is not None:
            # What is sampled about another place has its phases.
            more = (self._bent[:, 0] + 2 * self.turn[:, 1]) * self.centre
            path = path + along.double() * self.centre[:, None, None] + more[:, None, None]
        wave = out * phasor(one.k * path + one.phase, one.dtype)
        mirrored = one.straight and not self._own
        if mirrored:
            columns, read_x = self._half_line(across.abs(), inside)
            rows, read_y = self._line(along, inside)
        else:
            tx, ty = self._x[:, None, None].to(one.real), self._y[:, None, None].to(one.real)
            columns, read_x = self._line(along * tx - across * ty, inside)
            rows, read_y = self._line(along * ty + across * tx, inside)
        if fits.part is not None:
            rows = rows + self._bent
        return Leaving(columns, rows, wave, x, y, (read_x, read_y), mirrored, one.length)

    def to_probe(
        self,
        field: torch.Tensor,
        x: torch.Tensor,
        y: torch.Tensor,
        centres: torch.Tensor | None,
        *,
        squared: bool = False,
    ) -> torch.Tensor:
        """Field on the probe's pixels [B, H, W], or its square."""
        return self._pupil.path.carry(field, x, y, self._sines, centres, squared=squared)

    def _accept(self, along: torch.Tensor, across: torch.Tensor) -> torch.Tensor:
        """Fades out light under angles outside the picture."""
        if self._pupil.accepted is None:
            return torch.ones_like(along)
        fade = (torch.hypot(along, across) / self._pupil.accepted - 2) / 2
        return torch.cos(fade.clamp(0, 1) * (math.pi / 2)) ** 2

    def _line(self, places: torch.Tensor, inside: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Equal steps over the places inside and a margin, [B, m], and where between them, from 0, each place lies."""
        low = torch.where(inside, places, math.inf).amin((1, 2)).double()
        wide = torch.where(inside, places, -math.inf).amax((1, 2)) - low
        return self._steps(places, low, wide, self._pupil.samples[1])

    def _half_line(self, places: torch.Tensor, inside: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As `_line` for places read by their distance from the middle."""
        wide = torch.where(inside, places, 0.0).amax((1, 2)).double()
        return self._steps(places, torch.zeros_like(wide), wide, (self._pupil.samples[1] + 1) // 2)

    def _steps(
        self, places: torch.Tensor, low: torch.Tensor, wide: torch.Tensor, count: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """As `_line`, from `low` on for `wide`, each [B]: in `count` steps, or in the pupil's own where it has one."""
        step = (wide / (count - 1))[:, None]
        if self._pupil.length is not None:
            step = torch.full_like(step, self._pupil.step)
            count = math.ceil(float(wide.detach().max()) / self._pupil.step) + 1
        number = torch.arange(-_MARGIN, count + _MARGIN, dtype=torch.float64, device=places.device)
        line = low[:, None] + step * number
        scale, offset = ((1 / step)[..., None].to(places), (line[:, :1] / step)[..., None].to(places))
        return line, places * scale - offset

    def _taken(self, square: torch.Tensor, along: torch.Tensor) -> torch.Tensor:
        """Path difference of a plane nearer by this much at the spot, about the place where the chief ray meets it."""
        height = torch.sqrt((1 - square).clamp_min(_DARK))
        return -self._nearer[:, None, None] * height - self._shift[:, None, None] * along


def _tilt_and_azimuth(sines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Sizes [B] and unit vectors [B, 2] of tilts [B, 2]; zero counts as along y, with a finite gradient."""
    size = torch.sqrt((sines**2).sum(-1).clamp_min(_NO_TILT**2))
    along_y = torch.zeros_like(sines)
    along_y[:, 1] = 1
    return size, torch.where((size > 2 * _NO_TILT)[:, None], sines / size[:, None], along_y)
