"""The double pass of a ray-traced lens before a plane mirror or grating, as waves.

    G(v)   = 1/(iλ) ∫ A(s) exp(ikΨ(s)) exp(ik s·v) d²s               the spot, about y0
    U3(s') = 1/(iλ) ∫ M(v) G(v) exp(ik vᵀCv) exp(ik s'·v) d²v        what returns to the exit pupil
    U3'(e) = A(e) exp(ikΨ(s(e))) U3(s(e))                            and leaves the entrance pupil

A flat mirror takes s to -s, an order of direction τ to -s - τ. A(s) is the share of the pupil that no rim covers times
the root of |∂e/∂s|, which conserves energy; A(e) likewise with |∂s/∂e|. The wave that leaves is in object space and
propagates on from the entrance pupil (probe_path.py; docs/conventions.md, "Real lenses").

A plane tilted by a takes s to -s - 2a cosθ, to first order in a, and lies a·y0 farther at the spot.
"""

# SciPy and NumPy type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import fresnel

from tapetum.optics.fourier import phasor
from tapetum.simulate.foreshortening import foreshortening
from tapetum.simulate.probe_path import ProbePath
from tapetum.simulate.pupil_fits import PupilFits, chebyshev, on_grid, on_tilt_grid, open_share
from tapetum.simulate.surfaces import Surface

__all__ = ["TracedGrids", "TracedPass", "tilt_and_azimuth"]

# Gazes computed together.
_AT_ONCE = 8
_NO_TILT = 1e-11
# Latest start of the fade, over the window's end, at which rim light still counts as centred.
_LATEST_FADE = 0.75
# Places at which the fade of the sensor's window is summed.
_FADE_SAMPLES = 2000
# The root of zero has no finite gradient.
_DARK = 1e-30


@dataclass(frozen=True)
class TracedGrids:
    """Samples of a traced pass.

    Parameters
    ----------
    pupil
        Columns and rows of the pupil.
    sensor
        Columns and rows about the spot.
    half_width, flat
        Of the sensor's window, and of its part before the light is faded out, in metres.
    returning
        Columns and rows of the returning field, which is interpolated.
    leaving
        Columns and rows of the pupil on the way out; those of `pupil` when 0.
    """

    pupil: int
    sensor: int
    half_width: float
    flat: float
    returning: int
    leaving: int = 0


class TracedPass:
    """The retro-reflection of a traced lens off one plane, for any number of gazes; kernels are computed once.

    Parameters
    ----------
    fits
        The lens's pupils.
    grids
        The sampling.
    surface
        The plane that the pupils were fitted for: its orders, its tilt, and its phase against other planes.
    path
        From the lens to the probe's pixels.
    wavelength
        In metres.
    accepted
        Largest angle, in radians, under which light still reaches the picture, for `corrected` fits made for it.
    dtype, device
        Of the fields.
    """

    def __init__(
        self,
        fits: PupilFits,
        grids: TracedGrids,
        surface: Surface,
        path: ProbePath,
        *,
        wavelength: float,
        accepted: float | None = None,
        dtype: torch.dtype = torch.complex64,
        device: torch.device | str = "cpu",
    ) -> None:
        self.dtype, self.device, self.accepted = dtype, torch.device(device), accepted
        self.fits, self.grids, self.surface, self.path = fits.to(self.device), grids, surface, path
        self._wavelength, self._k = wavelength, 2 * math.pi / wavelength
        self._real = torch.float32 if dtype == torch.complex64 else torch.float64
        n, step = grids.sensor, 2 * grids.half_width / grids.sensor
        self._v = (torch.arange(n, dtype=torch.float64, device=self.device) - (n - 1) / 2) * step
        self._square = self._v[None, :] ** 2 + self._v[:, None] ** 2
        at = chebyshev(self.fits.nodes.places, self.fits.nodes.count).to(self.device)
        radius = float((at @ self.fits.radius).min())
        self._window = (_window(self._square.sqrt(), grids, self._k / radius) * (step / (1j * wavelength)) ** 2).to(
            dtype
        )

    def field(self, sines: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
        """Complex amplitude on the probe's pixels for 1 W/m² at the target, [B, H, W], in W^½/m.

        `sines` [B, 2] are those of the tilt along x and y; `centres` [B, 2] place the RR's own centre on the probe's
        sensor, in metres, by default in the middle.
        """
        sines = sines.to(self.device, torch.float64)
        if centres is not None:
            centres = centres.to(self.device, torch.float64)
        # Most gazes of a phone return nothing: they are not computed.
        lit = self._returns(tilt_and_azimuth(sines)[0]).nonzero()[:, 0]
        parts: list[torch.Tensor] = []
        for i in range(0, len(lit), _AT_ONCE):
            some = lit[i : i + _AT_ONCE]
            pupil, x, y = self.exit_pupil(sines[some])
            parts.append(self.path.carry(pupil, x, y, sines[some], None if centres is None else centres[some]))
        found = torch.cat(parts) if parts else torch.zeros(0, *self.path.shape, dtype=self.dtype, device=self.device)
        if len(lit) == len(sines):
            return found
        dark = torch.zeros(len(sines), *self.path.shape, dtype=self.dtype, device=self.device)
        return dark.index_copy(0, lit, found)

    def exit_pupil(self, sines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Field that leaves the lens, tilt removed, [B, n, n], at columns x [B, n] and rows y [B, n].

        They lie in the entrance pupil, turned by the rotation of `foreshortening`, as `ProbePath` wants them.
        """
        k, fits, sines = self._k, self.fits, sines.to(self.device, torch.float64)
        size, toward = tilt_and_azimuth(sines)
        returns = self._returns(size).to(torch.float64)
        size = size.clamp_max(fits.nodes.steepest)
        tilt = fits.nodes.terms(size)
        middle, radius = tilt @ fits.middle, tilt @ fits.radius
        chief = middle / radius
        # A plane tilted away is farther at the spot by this.
        nearer = -self._along(self.surface.tilt, toward) * middle

        # The way in, across and along the tilt.
        across, along, psi, amplitude, cell = self._entering(tilt, size)
        square = across[:, None, :] ** 2 + along[:, :, None] ** 2
        psi = psi + self._taken(square, along[:, :, None], chief, nearer)
        wave = self._wave(amplitude * (cell * returns)[:, None, None], psi)

        v = self._v
        # A sphere about the exit pupil's middle, seen under the chief ray's angle.
        bend = k * v**2 / radius[:, None]
        rows, columns = phasor(bend * (1 - chief[:, None] ** 2), self.dtype), phasor(bend, self.dtype)
        spot = (self._kernel(v, along) * rows[..., None]) @ wave @ (self._kernel(v, across) * columns[..., None]).mT
        spot = spot * self._window
        spot = spot * self._reflectance(middle, chief, toward, nearer)

        # The way out, on columns and rows of the probe's picture.
        rotation, _ = foreshortening(sines)
        turned = (rotation.mT @ toward[..., None])[..., 0]
        x, y, even, odd, inside = on_grid(fits.leaving, tilt, turned, self.grids.leaving or self.grids.pupil)
        out = torch.sqrt(even[:, 2].clamp_min(_DARK))
        if odd.shape[1] > 1:
            out = out * open_share(even[:, 4:].to(self._real), inside) * self._accept(even[:, 3], odd[:, 1])
        else:
            out = out * open_share(even[:, 3:].to(self._real), inside)
        s_along, s_across = even[:, 1], odd[:, 0]
        psi = even[:, 0] + self._taken(s_along**2 + s_across**2, s_along, chief, nearer)

        # Seen from the pupil, then at each sample's own direction.
        columns, low_x, wide_x = self._line(s_across, inside)
        rows, low_y, wide_y = self._line(s_along, inside)
        # Defocus adds a phase by the square of s': remove it before the interpolation, restore it after.
        bend = k / 2 * fits.defocus
        down = self._kernel(rows, v[None]) * phasor(bend * (rows + chief[:, None]) ** 2, self.dtype)[..., None]
        right = self._kernel(columns, v[None]) * phasor(bend * columns**2, self.dtype)[..., None]
        back = down @ spot @ right.mT
        psi = psi - bend / k * ((s_along + chief[:, None, None]) ** 2 + s_across**2)
        at = torch.stack(
            [
                2 * (s_across - low_x[:, None, None]) / wide_x[:, None, None] - 1,
                2 * (s_along - low_y[:, None, None]) / wide_y[:, None, None] - 1,
            ],
            -1,
        )
        planes = torch.view_as_real(back).permute(0, 3, 1, 2)
        seen = torch.nn.functional.grid_sample(planes, at.to(self._real), "bicubic", "border", align_corners=True)
        return torch.complex(seen[:, 0], seen[:, 1]) * self._wave(out, psi + self.surface.phase / k), x, y

    def _returns(self, size: torch.Tensor) -> torch.Tensor:
        """Whether anything returns from tilts of these sizes [B]: beyond the last node the polynomials are invalid."""
        return size <= self.fits.nodes.steepest * (1 + 1e-9)

    def entering_power(self, sines: torch.Tensor) -> torch.Tensor:
        """Power [B] that 1 W/m² sends into the lens at tilts [B, 2], in watts."""
        size, _ = tilt_and_azimuth(sines.to(self.device, torch.float64))
        size = size.clamp_max(self.fits.nodes.steepest)
        _, _, _, amplitude, cell = self._entering(self.fits.nodes.terms(size), size)
        return (amplitude**2).sum((1, 2)) * cell

    def _entering(
        self, tilt: torch.Tensor, size: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Columns across and rows along the tilt, path and amplitude there, and the area of a sample."""
        across, along, values = on_tilt_grid(self.fits.entering, tilt, self.grids.pupil)
        share = torch.sqrt(values[:, 1].clamp_min(_DARK)) * open_share(values[:, 2:].to(self._real))
        cell = (across[:, 1] - across[:, 0]) * (along[:, 1] - along[:, 0])
        # A tilted pupil receives less light.
        return across, along, values[:, 0], share * ((1 - size**2) ** 0.25)[:, None, None], cell

    def _accept(self, along: torch.Tensor, across: torch.Tensor) -> torch.Tensor:
        """Fades out light under angles outside the picture."""
        if self.accepted is None:
            return torch.ones_like(along)
        fade = (torch.hypot(along, across) / self.accepted - 2) / 2
        return torch.cos(fade.clamp(0, 1) * (math.pi / 2)) ** 2

    def _wave(self, amplitude: torch.Tensor, psi: torch.Tensor) -> torch.Tensor:
        return amplitude.to(self._real) * phasor(self._k * psi, self.dtype)

    def _kernel(self, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """exp(ik row·column), [B, rows, columns]."""
        return phasor(self._k * rows[..., :, None] * columns[..., None, :], self.dtype)

    def _line(self, places: torch.Tensor, inside: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Equal steps over the places inside, [B, m], with their first one and the whole length."""
        far = torch.full_like(places, math.inf)
        low = torch.where(inside, places, far).amin((1, 2))
        wide = torch.where(inside, places, -far).amax((1, 2)) - low
        line = torch.linspace(0, 1, self.grids.returning, dtype=torch.float64, device=self.device)
        return low[:, None] + wide[:, None] * line, low, wide

    @staticmethod
    def _along(vector: tuple[float, float], toward: torch.Tensor) -> torch.Tensor:
        return vector[0] * toward[:, 0] + vector[1] * toward[:, 1]

    def _taken(
        self, square: torch.Tensor, along: torch.Tensor, chief: torch.Tensor, nearer: torch.Tensor
    ) -> torch.Tensor:
        """Path difference of a plane nearer by this much at the spot, about the place where the chief ray meets it."""
        if self.surface.tilt == (0.0, 0.0):
            return torch.zeros((), dtype=torch.float64, device=self.device)
        shift = nearer * chief / torch.sqrt(1 - chief**2)
        return -nearer[:, None, None] * torch.sqrt((1 - square).clamp_min(_DARK)) - shift[:, None, None] * along

    def _reflectance(
        self, middle: torch.Tensor, chief: torch.Tensor, toward: torch.Tensor, nearer: torch.Tensor
    ) -> torch.Tensor:
        """The orders' sum at y0 + v: phases that change slowly; the mask itself is never sampled."""
        total = torch.zeros(1, 1, 1, dtype=self.dtype, device=self.device)
        tilt = self.surface.tilt
        # Direction change by the plane's tilt, 2a cosθ along and across the gaze; the path holds its phase at y0.
        turn = 2 * torch.sqrt(1 - chief**2)
        tilted = turn * self._along(tilt, toward), turn * self._along((tilt[1], -tilt[0]), toward)
        # Where the chief ray meets the plane.
        spot = middle - nearer * chief / torch.sqrt(1 - chief**2)
        places = spot[:, None] * toward
        for order in self.surface.orders:
            tau = order.direction[0] - 2 * tilt[0], order.direction[1] - 2 * tilt[1]
            at_spot = self._along(tau, toward)
            along = (at_spot + tilted[0])[:, None]
            across = (self._along((tau[1], -tau[0]), toward) + tilted[1])[:, None]
            # Light that misses the pupil altogether would only return as an alias.
            meets = torch.hypot(along + 2 * chief[:, None], across) < 2.05 * self.fits.aperture[0]
            if not bool(meets.any()):
                continue
            across = torch.where(meets, across, torch.zeros_like(across))
            along = torch.where(meets, along, torch.zeros_like(along))
            phase = phasor(self._k * at_spot * spot) * order.at(places)
            amplitude = (phase[:, None] * meets).to(self.dtype)
            columns = phasor(self._k * across * self._v, self.dtype)
            rows = phasor(self._k * along * self._v, self.dtype)
            total = total + (amplitude * rows)[:, :, None] * columns[:, None, :]
        return total


def _window(distance: torch.Tensor, grids: TracedGrids, chirp: float) -> torch.Tensor:
    """Window that fades the light out at its end and adds back what the light beyond contributes to the rim's image.

    The pupil's edge spreads light over the sensor as 1/v, and the mirror returns it to its origin, at zero tilt the
    same edge: as 1/v² again. The light faded out or beyond the window would add ∫ (1 - W) exp(i chirp v²)/v² dv to the
    light at the edge. A bump on the fade adds exactly this; without it the picture's error falls only as one over the
    rings kept.
    """
    low, high = grids.flat, grids.half_width
    place = math.pi * ((distance - low) / (high - low)).clamp(0, 1)
    # Nothing at all beyond the end: cos² of a rounded right angle would leave numbers so small that the processor
    # multiplies them a hundred times slower than others.
    fade = torch.where(distance < high, torch.cos(place / 2) ** 2, 0.0)
    if low > _LATEST_FADE * high:
        return fade
    v = np.linspace(low, high, _FADE_SAMPLES + 2)[1:-1]
    turned = np.exp(1j * chirp * v**2) / v**2 * (v[1] - v[0])
    share = math.pi * (v - low) / (high - low)
    # ∫ exp(i chirp v²)/v² dv from the window's end on, by parts.
    sine, cosine = fresnel(high * math.sqrt(2 * chirp / math.pi))
    rest = 0.5 - cosine + 1j * (0.5 - sine)
    beyond = np.exp(1j * chirp * high**2) / high + 2j * chirp * math.sqrt(math.pi / (2 * chirp)) * rest
    bump = complex((np.sin(share / 2) ** 2 * turned).sum() + beyond) / complex((np.sin(share) ** 2 * turned).sum())
    return fade + bump * torch.where(distance < high, torch.sin(place) ** 2, 0.0)


def tilt_and_azimuth(sines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Sizes [B] and unit vectors [B, 2] of tilts [B, 2]; zero counts as along y, with a finite gradient."""
    size = torch.sqrt((sines**2).sum(-1).clamp_min(_NO_TILT**2))
    along_y = torch.zeros_like(sines)
    along_y[:, 1] = 1
    return size, torch.where((size > 2 * _NO_TILT)[:, None], sines / size[:, None], along_y)
