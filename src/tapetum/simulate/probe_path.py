"""From the target's pupil to the probe's pixels: to the far field, or over the distance and through a round aperture.

The paper's last step (equation 6) propagates over d, through the probe's lens, and over its focal length. In the focal
plane the distance matters only through what the aperture cuts off: a beam that fits needs one transform, any other
needs two. All passes end here. In those of a thin lens all gazes share columns and rows; in those of a traced lens each
gaze has its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch

from tapetum.optics.fourier import BandLimitedFourier, FoldedKernel, chebyshev_lift, folded, paired, phasor
from tapetum.optics.grid import Grid
from tapetum.optics.sampling import DoublePassGeometry, aperture_samples
from tapetum.simulate.aperture_crossing import ApertureCrossing
from tapetum.simulate.foreshortening import cosines, foreshortening

__all__ = ["Band", "ProbeAperture", "ProbePath", "missed_by_chirps"]

# Rows and columns of a part of the pupil, and its fields in pairs.
Band = tuple[slice, slice, torch.Tensor]

# Samples of the probe's aperture behind a traced lens. The largest phase step between two of them, in radians, for an
# error of 4e-5 of the peak, where light meets pixels that hold some, and for one of 8e-4 between any two places; errors
# grow by the seventh power. The step that keeps copies of a picture at one edge from the other. Samples added for what
# a rim diffracts, and the error's share of the accuracy asked for.
_LIT, _ANY, _COPIES = (1.0, 4e-5), (4.0, 8e-4), 5.5
_POWER, _DIFFRACTED, _OF_APERTURE = 7, 24, 0.05
# Accuracies below this are beyond rounding.
_FINEST = 1e-9
# Error of a picture over the phase of the longest path that Fresnel's chirps miss; how far waves go beside rays, √(λd).
_OF_LONGEST, _ZONES = 0.4, 1.5


@dataclass(frozen=True)
class ProbeAperture:
    """The probe's round aperture: its distance (a tensor carries gradients) and radius in metres, and its samples."""

    distance: torch.Tensor | float
    radius: float
    columns: int
    rows: int

    @classmethod
    def behind_thin(cls, geometry: DoublePassGeometry, distance: torch.Tensor | float, radius: float) -> ProbeAperture:
        """The aperture with the samples that a thin lens's scene needs."""
        away = float(torch.as_tensor(distance).detach())
        return cls(distance, radius, *aperture_samples(geometry, away, radius))

    @classmethod
    def behind_traced(
        cls, distance: float, radius: float, wavelength: float, window: float, *, reach: float, accuracy: float
    ) -> ProbeAperture:
        """The aperture behind a traced lens whose pupil is `reach` in half width, for errors well within `accuracy`.

        The picture's half diagonal is `window`, in radians. Light from places of the pupil to places of the aperture
        goes under up to `seen`, and the pixels that hold it lie within as much.
        """
        seen, accuracy = (radius + reach) / distance, max(accuracy, _FINEST)
        lit, anywhere = (step * (_OF_APERTURE * accuracy / error) ** (1 / _POWER) for step, error in (_LIT, _ANY))
        angles = max((seen + min(window, seen)) / lit, (seen + window) / anywhere, (seen + 2 * window) / _COPIES)
        count = _DIFFRACTED + math.ceil(4 * math.pi / wavelength * radius * angles)
        return cls(distance, radius, count, count)


def missed_by_chirps(
    distance: float, radius: float, *, reach: float, angle: float, sine: float, wavelength: float
) -> float:
    """Error of pictures, over the peak, as Fresnel's chirps miss exact ways from the pupil to the probe's aperture.

    `distance` and `radius` are the aperture's, `reach` the pupil's half width, in metres; `angle` is the largest one of
    the light that leaves it, `sine` that of the tilt.

    Light from x to the aperture, w beside it, takes a way that is longer than the chirps' by w²x sinθ/2d² + w⁴/8d³.
    Rays through the aperture go so far aside as their angle makes them, on either side of a focus, and the waves about
    them some Fresnel zones √(λd) more. A path that all light shares changes no picture, so paths from 0 to a largest
    one count for half of it. Pictures of thin lenses err by up to 0.30 of its phase beyond half of what their sampling
    states, near the cut-off apart, against sums over exact distances in 350 scenes. To add the paths of rays to the
    pupil's phase makes them worse: much of what crosses the aperture beside a ray was diffracted by the pupil's rim.
    """
    zone, spread = math.sqrt(wavelength * distance), angle * distance / reach
    whence = min(reach, (radius + zone) / max(abs(spread - 1), 1e-9))
    aside = min(whence * spread + _ZONES * zone, reach + radius)
    longest = sine * reach * aside**2 / (2 * distance**2) + aside**4 / (16 * distance**3)
    return _OF_LONGEST * 2 * math.pi / wavelength * longest


class ProbePath:
    """Carries pupil fields to the probe's focal plane, on the pixels of `output`.

    `x` and `y` are the pupil's columns and rows in metres; for pupils with their own, two ends that enclose all of
    them. `wavelength` and `probe_focal_length` (metres) may be tensors that carry gradients. Without an `aperture` all
    light reaches the probe's sensor.
    """

    def __init__(
        self,
        output: Grid,
        x: torch.Tensor,
        y: torch.Tensor,
        *,
        wavelength: torch.Tensor | float,
        probe_focal_length: torch.Tensor | float,
        aperture: ProbeAperture | None = None,
        dtype: torch.dtype = torch.complex64,
        device: torch.device | str = "cpu",
    ) -> None:
        self.dtype, self.device, self.aperture = dtype, torch.device(device), aperture
        self.shape = output.rows, output.columns
        self._x, self._y = x, y
        k = 2 * math.pi / wavelength
        self._to_pixels = k / probe_focal_length
        pixels = output.x(device=device), output.y(device=device)
        # All constants of the path, multiplied in once.
        self.constant = 1 / (1j * wavelength * probe_focal_length)
        # Phase added to the pupil, in radians per m²: the Fresnel chirp of a finite distance.
        self.chirp = torch.zeros((), dtype=torch.float64, device=device)
        self._seen, self._kappa = pixels, self._to_pixels
        if aperture is not None:
            way = torch.as_tensor(aperture.distance, dtype=torch.float64, device=device)
            self._kappa = k / way
            self.chirp = self._kappa / 2
            self._crossing = ApertureCrossing(
                output,
                aperture.radius,
                (aperture.columns, aperture.rows),
                bend=self.chirp,
                to_pixels=self._to_pixels,
                dtype=dtype,
                device=self.device,
            )
            self._seen = self._crossing.x, self._crossing.y
            self.constant = self.constant / (1j * wavelength * way)
        self._first = BandLimitedFourier(x, y, *self._seen, self._kappa, dtype)

    def gather(self, bands: Iterable[Band], triangle: torch.Tensor | None) -> torch.Tensor:
        """The shared pupil's field at the first transform's nodes, [B, V', U'].

        `bands` are slices of the upper half of the pupil's rows and of its columns, with their fields in pairs, [B, 2,
        rows, columns], from `pairs`. `triangle` [B, 2, 2], where given, is T of `foreshortening`, which foreshortens
        the picture.
        """
        # M = 1 - (1 - cosθ) ŝŝᵀ mixes x and y, which two matrix products cannot. Its QR factors can: the rotation acts
        # on the (round) pupil, and a triangular T costs one phase between the two products.
        first, t = self._first, triangle
        kernel = None if t is None else first.down.scaled(t[:, 1, 1])
        total: torch.Tensor | None = None
        for rows, columns, halves in bands:
            part = first.down.partial(halves, rows, kernel)
            if total is None and halves.shape[-1] == len(self._x):
                total = part
                continue
            if total is None:
                total = part.new_zeros(*part.shape[:-1], len(self._x))
            total[..., columns] += part
        assert total is not None
        down = first.down.unfolded(total)
        if t is None:
            return first.across(folded(down.mT)).mT
        return first.across(folded((down * self._mix(t, self._x)).mT), first.across.scaled(t[:, 0, 0])).mT

    def pairs(
        self,
        upper: torch.Tensor,
        lower: torch.Tensor,
        rows: slice,
        columns: slice,
        centres: torch.Tensor | None,
        shortening: torch.Tensor | None,
    ) -> Band:
        """Some rows and columns [B, Y', X'] of the pupil's upper half with their partners -y, as `gather` takes them.

        `centres` [B, 2] move the picture, in metres, as seen under its `shortening` [B, 2, 2].
        """
        if centres is not None and self.aperture is None:
            seen, x, y = _seen_at(centres, shortening), self._x[columns], self._y[rows]
            upper, lower = upper * self._ramp(seen, x, y), lower * self._ramp(seen, x, -y)
        return rows, columns, paired(upper, lower)

    def gather_unturned(self, pupil: torch.Tensor, tilts: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
        """As `gather`, of all rows of a pupil whose coordinates are not turned by the rotation R: behind a mask."""
        rotation, t = foreshortening(tilts)
        if centres is not None and self.aperture is None:
            pupil = pupil * self._ramp(_seen_at(centres, rotation @ t), self._x, self._y)
        # M unchanged: x (m00 qx + m01 qy) + y (m10 qx + m11 qy). Three of its four phases fit into the products. The
        # one of y and qx changes slowly, by the square of the tilt: a few Chebyshev nodes in qx suffice.
        m = self._kappa * (rotation @ t)
        qx, qy = self._first.ux, self._first.uy
        turn = float(m[:, 1, 0].detach().abs().max() * self._y.detach().abs().max() * (qx.max() - qx.min()) / 2)
        nodes, lift = chebyshev_lift(qx, turn, self.dtype)
        column = self._kernel(-m[:, 0, 0, None] * self._x, qx)
        mix = self._kernel(-m[:, 0, 1, None] * qy, self._x)
        total: torch.Tensor | None = None
        for node, share in zip(nodes, lift.T, strict=True):
            along = m[:, 1, 1, None] * qy + m[:, 1, 0, None] * node
            part = ((self._kernel(-along, self._y) @ pupil * mix) @ column) * share.to(self.dtype)
            total = part if total is None else total + part
        assert total is not None
        return total

    def to_image(self, gathered: torch.Tensor, centres: torch.Tensor | None, *, squared: bool = False) -> torch.Tensor:
        """From the first transform's nodes, all rows gathered, to the field on the pixels, or its square: [B, H, W]."""
        return self._lifted(gathered, centres, squared=squared)

    def carry(
        self,
        pupil: torch.Tensor,
        x: torch.Tensor,
        y: torch.Tensor,
        sines: torch.Tensor,
        centres: torch.Tensor | None,
        *,
        squared: bool = False,
    ) -> torch.Tensor:
        """Field on the pixels, or its square, [B, H, W], of pupils [B, n, n] with their own columns and rows [B, n].

        `pupil` is the field that leaves per unit area, tilt removed; x and y are in coordinates turned by the rotation
        R of `foreshortening`.
        """
        rotation, t = foreshortening(sines)
        middle_x, middle_y = (x[:, :1] + x[:, -1:]) / 2, (y[:, :1] + y[:, -1:]) / 2
        step = (x[:, 1] - x[:, 0]) * (y[:, 1] - y[:, 0])
        # A tilted pupil's light spreads over a foreshortened picture.
        strength = step * torch.sqrt(cosines(sines)) * self.constant
        pupil = pupil * strength[:, None, None].to(self.dtype)
        if self.aperture is not None:
            # Fresnel chirp of the distance: for the probe the pupil is foreshortened along the tilt. That its
            # places lie farther away there must not be added to this part alone: of straight light all parts cancel.
            tilt = (rotation.mT @ sines[..., None])[..., 0]
            along = tilt[:, 0, None, None] * x[:, None, :] + tilt[:, 1, None, None] * y[:, :, None]
            square = x[:, None, :] ** 2 + y[:, :, None] ** 2 - along**2
            pupil = pupil * phasor(self.chirp * square, self.dtype)
        elif centres is not None:
            pupil = pupil * self._ramp(_seen_at(centres, t), x, y)
        # Each gaze has its own step; its columns and rows lie in pairs about its middle.
        down, across = (
            FoldedKernel(_counted(one.shape[-1], one), nodes, self._kappa, self.dtype)
            for one, nodes in ((y, self._first.uy), (x, self._first.ux))
        )
        gathered = down(folded(pupil), down.scaled(t[:, 1, 1] * (y[:, 1] - y[:, 0])))
        gathered = gathered * self._mix(t, x - middle_x)
        gathered = across(folded(gathered.mT), across.scaled(t[:, 0, 0] * (x[:, 1] - x[:, 0]))).mT
        if squared and self.aperture is None:
            return self._first.lift_squared(gathered)
        # A pupil off its middle adds a linear phase to the picture: apply it after the sum over nodes.
        sideways = -self._kappa * t[:, 0, 0, None] * middle_x
        upwards = -self._kappa * (t[:, 0, 1, None] * middle_x + t[:, 1, 1, None] * middle_y)
        return self._lifted(gathered, centres, sideways, upwards, squared=squared)

    def _mix(self, t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """The phase between the two products, of x t01 qy: [B, V', X] for columns x [X] or [B, X]."""
        rows = -self._kappa * t[:, 0, 1, None] * self._first.uy
        if self.dtype == torch.complex64 and not t.requires_grad:
            # A few radians: their rounding is far below that of the products.
            rows, x = rows.float(), x.float()
        return self._kernel(rows, x)

    def _kernel(self, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """exp(i row·column) [B, rows, columns], of rows [B, rows] in radians a metre and columns [(B,) columns]."""
        return phasor(rows[:, :, None] * columns[..., None, :], self.dtype)

    def _lifted(
        self,
        gathered: torch.Tensor,
        centres: torch.Tensor | None,
        sideways: torch.Tensor | None = None,
        upwards: torch.Tensor | None = None,
        *,
        squared: bool = False,
    ) -> torch.Tensor:
        """From the first transform's nodes to the field on the pixels, or its square.

        `sideways` and `upwards` [B, 1] are phases along its columns and its rows, in radians a metre.
        """
        if squared and self.aperture is None:
            return self._first.lift_squared(gathered)
        if self.aperture is not None and centres is not None:
            # The beam returns to the probe's middle, under an angle.
            shift = self._to_pixels * centres.to(self.device, torch.float64)
            sideways = shift[:, :1] if sideways is None else sideways + shift[:, :1]
            upwards = shift[:, 1:] if upwards is None else upwards + shift[:, 1:]
        wide, high = self._seen
        across = None if sideways is None else phasor(sideways * wide, self.dtype)
        down = None if upwards is None else phasor(upwards * high, self.dtype)
        if self.aperture is None:
            return self._first.lift(gathered, down, across)
        return self._crossing(self._first, gathered, down, across, squared=squared)

    def _ramp(self, centres: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """Moves the picture by centres [B, 2], as the pupil sees them, for columns and rows [n] or [B, n]."""
        shift = self._to_pixels * centres.to(self.device, torch.float64)
        column, row = phasor(shift[:, :1] * x, self.dtype), phasor(shift[:, 1:] * y, self.dtype)
        return column[:, None, :] * row[:, :, None]


def _counted(count: int, like: torch.Tensor) -> torch.Tensor:
    """Places of equally spaced samples about their middle, in steps."""
    return torch.arange(count, dtype=torch.float64, device=like.device) - (count - 1) / 2


def _seen_at(centres: torch.Tensor, matrix: torch.Tensor | None) -> torch.Tensor:
    """Places [B, 2] of the picture as a pupil sees them whose foreshortening is a matrix [B, 2, 2]."""
    return centres if matrix is None else (matrix @ centres.to(matrix)[..., None])[..., 0]
