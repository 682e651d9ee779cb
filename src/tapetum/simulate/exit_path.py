"""From the entrance pupil of a traced lens to the probe's pixels: to the far field, or through the probe's aperture.

A pupil here has columns and rows of its own for every gaze; `probe_path` serves the pupils that all gazes share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from tapetum.optics.fourier import BandLimitedFourier, phasor
from tapetum.optics.grid import Grid
from tapetum.optics.pupil import disc_quadrature
from tapetum.simulate.foreshortening import foreshortening

__all__ = ["ExitPath", "ProbeAperture", "missed_path"]


@dataclass(frozen=True)
class ProbeAperture:
    """The probe's round aperture: how far away, its radius, in metres, and the samples over it."""

    distance: float
    radius: float
    samples: int


def missed_path(aperture: ProbeAperture, reach: float, angle: float, sine: float, wavelength: float) -> float:
    """The most, in metres, that Fresnel's chirps miss of the way from the pupil to the probe's aperture.

    Parameters
    ----------
    aperture
        The probe's; light that spreads less than it does counts as far as it spreads.
    reach, angle
        Half width of the pupil and the largest angle of what leaves it.
    sine
        Of the tilt.
    wavelength
        In metres.
    """
    d = aperture.distance
    wide = reach + min(aperture.radius, reach + angle * d + math.sqrt(wavelength * d))
    return sine * reach * wide**2 / (2 * d**2) + wide**4 / (8 * d**3)


class ExitPath:
    """Carries pupil fields to the probe's focal plane.

    Parameters
    ----------
    output
        Pixels of the probe's sensor.
    wavelength, probe_focal_length
        In metres.
    reach
        Half width of the widest pupil, in metres.
    aperture
        What the light goes through; all of it reaches the probe's sensor when left out.
    dtype, device
        Of the fields.
    """

    def __init__(
        self,
        output: Grid,
        *,
        wavelength: float,
        probe_focal_length: float,
        reach: float,
        aperture: ProbeAperture | None = None,
        dtype: torch.dtype = torch.complex64,
        device: torch.device | str = "cpu",
    ) -> None:
        self.dtype, self.device, self.aperture = dtype, torch.device(device), aperture
        self._k = 2 * math.pi / wavelength
        self._to_pixels = self._k / probe_focal_length
        self._constant = 1 / (1j * wavelength * probe_focal_length)
        edges = torch.tensor([-reach, reach], dtype=torch.float64, device=device)
        x, y = output.x(device=device), output.y(device=device)
        self._pixels, self.shape = (x, y), (output.rows, output.columns)
        if aperture is None:
            self._kappa = self._to_pixels
            # What a pupil of this width makes of the picture is known from few of its places.
            self._first = BandLimitedFourier(edges, edges, x, y, self._kappa, dtype)
            return
        disc = disc_quadrature(aperture.radius, aperture.samples, aperture.samples)
        self._far_x, self._far_y = disc.x.to(device), disc.y.to(device)
        self._kappa = self._k / aperture.distance
        bend = self._kappa / 2 * disc.rho_squared().to(device)
        self._passed = (disc.weights.to(device) * phasor(bend)).to(dtype)
        self._constant = self._constant / (1j * wavelength * aperture.distance)
        self._first = BandLimitedFourier(edges, edges, self._far_x, self._far_y, self._kappa, dtype)
        self._second = BandLimitedFourier(self._far_x, self._far_y, x, y, self._to_pixels, dtype)

    def __call__(
        self,
        pupil: torch.Tensor,
        x: torch.Tensor,
        y: torch.Tensor,
        sines: torch.Tensor,
        centres: torch.Tensor | None,
    ) -> torch.Tensor:
        """Field on the pixels, [B, H, W].

        Parameters
        ----------
        pupil
            [B, n, n] field that leaves, tilt removed, per unit area.
        x, y
            [B, n] columns and rows of the pupil, in coordinates turned by the rotation R of `foreshortening`.
        sines, centres
            Those of the pass.
        """
        # M = R T foreshortens the picture: R is in the pupil's coordinates, the triangular T costs one phase between
        # the two products.
        _, t = foreshortening(sines)
        middle_x, middle_y = (x[:, :1] + x[:, -1:]) / 2, (y[:, :1] + y[:, -1:]) / 2
        step = (x[:, 1] - x[:, 0]) * (y[:, 1] - y[:, 0])
        # What a tilted pupil sends spreads over a foreshortened picture.
        cosine = torch.sqrt(1 - (sines**2).sum(-1))
        pupil = pupil * (step * torch.sqrt(cosine) * self._constant)[:, None, None].to(self.dtype)
        if self.aperture is not None:
            pupil = pupil * self._shortened(x, y, sines)
        elif centres is not None:
            pupil = pupil * self._ramp(centres, x, y)
        ux, uy, kappa = self._first.ux, self._first.uy, self._kappa
        # A pupil off its middle only turns the phase of the picture: taken out of what is summed at the nodes.
        dx, dy = x - middle_x, y - middle_y
        columns = phasor(-kappa * t[:, 0, 0, None, None] * dx[:, :, None] * ux).to(self.dtype)
        mix = phasor(-kappa * t[:, 1, 0, None, None] * dy[:, :, None] * ux).to(self.dtype)
        rows = phasor(-kappa * t[:, 1, 1, None, None] * uy[:, None] * dy[:, None, :]).to(self.dtype)
        first = self._first.lift(rows @ ((pupil @ columns) * mix))
        wide, high = self._pixels if self.aperture is None else (self._far_x, self._far_y)
        across = phasor(-kappa * (t[:, 0, 0, None] * middle_x + t[:, 1, 0, None] * middle_y) * wide)
        down = phasor(-kappa * t[:, 1, 1, None] * middle_y * high)
        first = first * (down[:, :, None] * across[:, None, :]).to(self.dtype)
        if self.aperture is None:
            return first
        passed = first * self._passed
        if centres is not None:
            # The beam comes back to the probe's middle, under an angle.
            far = self._far_x[None], self._far_y[None]
            passed = passed * self._ramp(centres, *far)
        return self._second(passed)

    def _shortened(self, x: torch.Tensor, y: torch.Tensor, sines: torch.Tensor) -> torch.Tensor:
        """Fresnel's chirp of the distance: seen from the probe the pupil is shortened along the tilt."""
        rotation, _ = foreshortening(sines)
        tilt = (rotation.mT @ sines[..., None])[..., 0]
        along = tilt[:, 0, None, None] * x[:, None, :] + tilt[:, 1, None, None] * y[:, :, None]
        square = x[:, None, :] ** 2 + y[:, :, None] ** 2 - along**2
        return phasor(self._kappa / 2 * square).to(self.dtype)

    def _ramp(self, centres: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        shift = self._to_pixels * centres
        column = phasor(shift[:, 0, None, None] * x[:, None, :])
        return (phasor(shift[:, 1, None, None] * y[:, :, None]) * column).to(self.dtype)
