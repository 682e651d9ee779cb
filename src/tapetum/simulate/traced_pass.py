"""The double pass of a ray-traced lens before a plane mirror, grating or mask: `SampledPass` by the lens's fits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from tapetum.optics.fourier import fast_beats_products, phasor
from tapetum.optics.propagate import fast_length
from tapetum.simulate.order_paths import PLACES, OrderPaths
from tapetum.simulate.probe_path import ProbePath
from tapetum.simulate.pupil_fits import PupilFits
from tapetum.simulate.pupils import Gazes
from tapetum.simulate.sampled_pass import SampledPass
from tapetum.simulate.spot_window import SpotWindow
from tapetum.simulate.surfaces import Mask, Surface
from tapetum.simulate.traced_pupil import TracedGazes, TracedPupil

__all__ = ["TracedGrids", "TracedPass"]

# Gazes computed together, and memory for them in bytes: of a sample of the pupils, of the probe's aperture, and of a
# mask's.
_AT_ONCE, AT_ONCE_BYTES, _SAMPLE, _CROSSING_SAMPLE, _MASK_SAMPLE = 32, 192 << 20, 96, 32, 48
# The same on a GPU, which few gazes do not fill: at most, share of its free memory, and bytes of a pixel.
_AT_ONCE_GPU, _SHARE_GPU, _PIXEL_GPU = 2048, 0.25, 32
# Orders with paths of their own whose ramps are added at once: each takes `PLACES` times the memory.
_ORDERS = 8


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


class TracedPass(SampledPass[TracedPupil]):
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
    orders
        The paths of the plane's orders where they are not those of a mirror's light.
    mask
        What the plane reflects, in place of its orders.
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
        orders: OrderPaths | None = None,
        mask: Mask | None = None,
        dtype: torch.dtype = torch.complex64,
        device: torch.device | str = "cpu",
    ) -> None:
        self.fits, self.grids, self.surface, self.path = fits.to(torch.device(device)), grids, surface, path
        self.accepted, self.orders, self.wavelength = accepted, orders, wavelength
        self._order_paths = orders and orders.to(torch.device(device))
        samples = grids.pupil, grids.returning, grids.leaving or grids.pupil
        needed = _SAMPLE * (sum(side**2 for side in samples) + grids.sensor**2)
        if path.aperture is not None:
            needed += _CROSSING_SAMPLE * path.aperture.columns * path.aperture.rows
        if mask is not None:
            needed += _MASK_SAMPLE * grids.sensor**2
        window = SpotWindow(grids.sensor, grids.half_width, grids.flat)
        straight = mask is None and surface.tilt == (0.0, 0.0)
        straight = straight and all(order.direction == (0.0, 0.0) for order in surface.orders)
        # Directions that fast transforms give are as close as those wanted, or closer.
        sine = self.fits.aperture[0] if self.fits.part is None else min(self.fits.aperture[0], self.fits.part.sine)
        length = fast_length(max(grids.sensor, math.ceil(wavelength * grids.returning / (2 * sine * window.step))))
        fast = _is_faster(length, grids, straight)
        pupil = TracedPupil(
            self.fits,
            samples,
            path,
            wavelength=wavelength,
            tilt=surface.tilt,
            straight=straight,
            phase=surface.phase,
            accepted=accepted,
            length=length if fast else None,
            step=wavelength / (length * window.step),
            dtype=dtype,
        )
        super().__init__(
            pupil,
            window,
            surface if mask is None else mask,
            wavelength=wavelength,
            at_once=_at_once(needed, path, torch.device(device)),
            dtype=dtype,
            device=device,
        )

    def entering_power(self, sines: torch.Tensor) -> torch.Tensor:
        """Power [B] that 1 W/m² sends into the lens at tilts [B, 2], in watts."""
        light = self.pupil.gazes(sines.to(self.device, torch.float64), self._own).entering()
        cell = (light.columns[:, 1] - light.columns[:, 0]) * (light.rows[:, 1] - light.rows[:, 0])
        return (light.strength**2).sum((1, 2)) / cell * 2 ** sum(light.mirrored)

    def _turned(self, at: Gazes, directions: torch.Tensor, amplitudes: torch.Tensor) -> torch.Tensor:
        if self._order_paths is None:
            return super()._turned(at, directions, amplitudes)
        assert isinstance(at, TracedGazes)
        centre, half = self._order_paths.spot(at.tilt)
        grid = torch.linspace(-1, 1, PLACES, dtype=torch.float64, device=self.device)
        columns, rows = (centre[:, i, None] + half[:, i, None] * grid for i in (0, 1))
        places = torch.stack(
            [columns[:, None, :].expand(-1, PLACES, -1), rows[:, :, None].expand(-1, -1, PLACES)], -1
        ).flatten(1, 2)
        across = _hats((self._v - centre[:, :1]) / half[:, :1]).to(self.dtype)
        down = _hats((self._v + at.centre[:, None] - centre[:, 1:]) / half[:, 1:]).to(self.dtype)
        total = torch.zeros(1, 1, 1, dtype=self.dtype, device=self.device)
        for i in range(0, directions.shape[1], _ORDERS):
            some, strength = directions[:, i : i + _ORDERS], amplitudes[:, i : i + _ORDERS]
            turn = self._k * some[..., None] * self._v
            # A mirror's light has its paths where it leaves.
            path = torch.where((some == 0).all(-1, keepdim=True), 0.0, self._order_paths.at(at.tilt, places, some))
            more = phasor(self._k * path, self.dtype).reshape(*path.shape[:2], PLACES, PLACES)
            more = more * strength[..., None, None].to(self.dtype)
            right = phasor(turn[:, :, 0], self.dtype)[:, :, None] * across[:, None]
            lower = phasor(turn[:, :, 1], self.dtype)[:, :, None] * (more.mT @ down[:, None])
            total = total + lower.flatten(1, 2).mT @ right.flatten(1, 2)
        return total


def _hats(u: torch.Tensor) -> torch.Tensor:
    """Weights [B, PLACES, n] of equally spaced places in -1 … 1 for those between, at u [B, n]; beyond, the nearest."""
    at = (u.clamp(-1, 1) + 1) * ((PLACES - 1) / 2)
    number = torch.arange(PLACES, dtype=u.dtype, device=u.device)
    return (1 - (at[:, None] - number[:, None]).abs()).clamp_min(0)


def _at_once(needed: int, path: ProbePath, device: torch.device) -> int:
    """Gazes computed together, whose samples need so many bytes each."""
    if device.type != "cuda":
        return max(1, min(_AT_ONCE, AT_ONCE_BYTES // needed))
    free, _ = torch.cuda.mem_get_info(device)
    rows, columns = path.shape
    return max(1, min(_AT_ONCE_GPU, int(_SHARE_GPU * free / (needed + _PIXEL_GPU * rows * columns))))


def _is_faster(length: int, grids: TracedGrids, straight: bool) -> bool:
    """Whether fast transforms bring the spot to the returning directions sooner than matrix products do."""
    spot, back = grids.sensor, grids.returning
    products = 2 * back * spot**2 + back**2 * spot
    lines = spot / 2 + back
    if not straight:
        products, lines = 4 * (back * spot**2 + back**2 * spot), spot + back
    return fast_beats_products(length, lines, products)
