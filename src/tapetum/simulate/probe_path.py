"""From the target's lens to the probe's pixels: straight to the far field, or over the distance and through a round
aperture.

The paper's last step (equation 6) is a propagation over d, the probe's lens, and one over its focal length. In the
probe's focal plane the distance shows only by what the aperture cuts off: a beam that fits needs one transform, one
that does not needs two.
"""

from __future__ import annotations

import torch

from tapetum.optics.fourier import BandLimitedFourier, phasor
from tapetum.optics.grid import Grid
from tapetum.optics.pupil import disc_quadrature
from tapetum.optics.sampling import DoublePassGeometry, RoundPlan, aperture_samples
from tapetum.simulate.foreshortening import foreshortening

__all__ = ["ProbePath"]


class ProbePath:
    """Carries pupil fields to the probe's focal plane.

    Parameters
    ----------
    geometry, plan, output
        As for `RoundPass`.
    x, y
        The pupil's columns and rows, in metres.
    wavelength, probe_focal_length
        As tensors.
    distance, probe_radius
        From the target to the probe and the radius of its aperture, in metres; None for the far field.
    dtype, device
        Of the fields.
    """

    def __init__(
        self,
        geometry: DoublePassGeometry,
        plan: RoundPlan,
        output: Grid,
        x: torch.Tensor,
        y: torch.Tensor,
        *,
        wavelength: torch.Tensor,
        probe_focal_length: torch.Tensor,
        distance: torch.Tensor | float | None = None,
        probe_radius: float | None = None,
        dtype: torch.dtype = torch.complex64,
        device: torch.device | str = "cpu",
    ) -> None:
        self._x, self._y, self.dtype = x, y, dtype
        self._k = 2 * torch.pi / wavelength
        self._to_pixels = self._k / probe_focal_length
        qx, qy = output.x(device=device), output.y(device=device)
        # Every constant of the way, to be multiplied in once.
        self.constant = 1 / (1j * wavelength * probe_focal_length)
        # What the way adds to the pupil's phase, in radians per m²: the Fresnel chirp of a finite distance.
        self.chirp = torch.zeros((), dtype=torch.float64, device=device)
        self._aperture: torch.Tensor | None = None
        if distance is None or probe_radius is None:
            self._kappa = self._to_pixels
            self._first = BandLimitedFourier(x, y, qx, qy, self._kappa, dtype)
            return
        way = torch.as_tensor(distance, dtype=torch.float64, device=device)
        columns, rows = aperture_samples(geometry, float(way.detach()), probe_radius)
        disc = disc_quadrature(probe_radius, columns, rows)
        self._far_x, self._far_y = disc.x.to(device), disc.y.to(device)
        self._kappa = self._k / way
        self.chirp = self._kappa / 2
        self._first = BandLimitedFourier(x, y, self._far_x, self._far_y, self._kappa, dtype)
        bend = self.chirp * disc.rho_squared().to(device)
        self._aperture = (disc.weights.to(device) * phasor(bend)).to(dtype)
        self._second = BandLimitedFourier(self._far_x, self._far_y, qx, qy, self._to_pixels, dtype)
        self.constant = self.constant / (1j * wavelength * way)

    def gather(
        self, pupil: torch.Tensor, rows: slice, tilts: torch.Tensor | None, centres: torch.Tensor | None
    ) -> torch.Tensor:
        """What rows of the pupil [B, rows, columns] add to the field at the first transform's nodes.

        `tilts` [B, 2] foreshorten the picture where they are given; `centres` [B, 2] move it, in metres.
        """
        if centres is not None and self._aperture is None:
            pupil = pupil * self._ramp(centres, self._x, self._y[rows])
        if tilts is None:
            return self._first.at_nodes(pupil, rows.start)
        # M = 1 - (1 - cosθ) ŝŝᵀ mixes x and y, which two matrix products cannot. Its QR factors can: the rotation goes
        # to the (round) pupil, see `twisted`, and a triangular T costs one phase between the two products.
        _, t = foreshortening(tilts)
        qx, qy, y = self._first.ux, self._first.uy, self._y[rows]
        # x t00 qx + y (t10 qx + t11 qy): columns first, for qx stands beside both x and y.
        mix = phasor(-self._kappa * t[:, 1, 0, None, None] * y[None, :, None] * qx[None, None, :])
        row = phasor(-self._kappa * t[:, 1, 1, None, None] * qy[None, :, None] * y[None, None, :])
        return row.to(self.dtype) @ (self._first.across(pupil, t[:, 0, 0]) * mix.to(self.dtype))

    def to_image(self, gathered: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
        """From the first transform's nodes, all rows gathered, to the field on the pixels: [B, H, W]."""
        first = self._first.lift(gathered)
        if self._aperture is None:
            return first
        passed = first * self._aperture
        if centres is not None:
            # The beam comes back to the probe's middle, under an angle.
            passed = passed * self._ramp(centres, self._far_x, self._far_y)
        return self._second(passed)

    def _ramp(self, centres: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        shift = self._to_pixels * centres
        column = phasor(shift[:, 0, None, None] * x[None, None, :]).to(self.dtype)
        return column * phasor(shift[:, 1, None, None] * y[None, :, None]).to(self.dtype)
