"""A field on a plane tilted against the one it is given on: exact, for any tilt, without interpolation.

Stock, Worku and Gross, "Efficient field propagation between tilted planes", J. Opt. Soc. Am. A 34, 1849 (2017): for
each frequency along the axis of the tilt, a direct sum over the frequencies across it.

Signs. A tilt by `angle` a about x puts the points of the tilted plane at (x', y' cos a, d + y' sin a): its +y' side
lies farther along the light. A wave exp(iky sin θ), of direction (0, sin θ, cos θ), has there the phase k y' sin(θ +
a), constant on the plane turned by a = -θ, whose normal is the wave's direction. A tilt about y is the same with x and
y exchanged: points at (x' cos a, y', d + x' sin a), and exp(ikx sin θ) is constant at a = -θ.

Directions are sines (s_x, s_y), the transverse components of the unit vector; spatial frequencies are s/λ.

One file of more than 400 lines, because the near and the far field share these signs and one choice of band.
"""

# torch types these functions in part only.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from tapetum.errors import InputError, one_of
from tapetum.optics.fourier import phasor
from tapetum.optics.grid import Grid
from tapetum.optics.propagate import checked_distance, checked_field, fast_length

__all__ = ["TiltedPlane", "far_field_on_tilted", "tilt_directions"]

# Samples a side of the padded spectrum beyond which a request is refused.
MAX_SIDE = 8192
# Kernels up to this size, in bytes, are kept; larger ones are recomputed at each use, in pieces of this size.
KEPT_BYTES = 2**29
# Least cosine to either plane's normal in a default band: steeper rays need a huge padding.
GRAZING = 0.1


@dataclass(frozen=True)
class _Band:
    """The band around the carrier, in cycles per metre, and its rays' slopes."""

    x: float  # half-width
    y: tuple[float, float]
    slopes_x: tuple[float, float]
    slopes_y: tuple[float, float]
    least_cosine: float  # of a wave in the band to either plane's normal
    mapped: float  # greatest frequency on the tilted plane, from its carrier


class TiltedPlane:
    """The linear, differentiable operator from a field on a plane to the same light's field on a tilted plane.

    Its kernels are computed once, with the instance.

    Parameters
    ----------
    grid
        Where the field is sampled.
    wavelength
        In metres.
    angle
        Tilt in radians, between -π/2 and π/2; its sign is this module's.
    axis
        "x" or "y": the line that the plane is turned about.
    output
        Output grid in the tilted plane's own coordinates; by default the same numbers as `grid`. A beam through the
        axis gets longer by 1/cos(angle).
    carrier
        Direction (s_x, s_y) of a wave removed from the field before sampling: the field times exp(ik(s_x x + s_y y)) is
        the light. The same wave, seen from the tilted plane (`output_carrier`), is also left out of the result, so a
        collimated beam at 1 degree needs no finer samples than one at 0. None leaves the carriers in, both at zero.
    distance
        Of the axis of the tilt from the field's plane, in metres. The factor exp(ikc·distance), c the carrier's cosine
        (1 for None), is left out.
    band
        Half-width of the band of spatial frequencies around the carrier, in fractions of the grid's Nyquist frequency.
        By default each side is as wide, up to 1, as the output's pitch holds, without waves steeper than 84 degrees to
        either plane's normal.
    leak
        Fraction of a field's power that may lie outside the band, where it is dropped; a field with more is refused.
    dtype
        complex128 or complex64 (the phases of its kernels are formed in float64).
    device
        Of kernels and fields.

    Raises
    ------
    InputError
        For an angle of 90 degrees or more, a carrier that does not cross both planes forwards, a band that evanesces or
        that the output would alias, and a padded grid above 8192 samples a side.

    Notes
    -----
    With the spectrum Û of the field around the carrier's frequency c, frequencies g from there, and its image c' on the
    tilted plane,

        U'(x', y') = ∫∫ Û(g_x, g_y) exp(i2π [g_x x' + (g_y cos a + δf_z sin a) y' + δf_z d]) dg_y dg_x
        δf_z = f_z(c + g) - f_z(c) = -(g·(2c + g)) / (f_z(c + g) + f_z(c))

    where the last form avoids cancellation. The padding, by the slopes of all rays in the band, keeps copies of the
    light from the neighbouring period off the output.
    """

    def __init__(
        self,
        grid: Grid,
        wavelength: float,
        angle: float,
        axis: str = "x",
        output: Grid | None = None,
        *,
        carrier: tuple[float, float] | None = None,
        distance: float = 0.0,
        band: float | None = None,
        leak: float = 1e-5,
        dtype: torch.dtype = torch.complex128,
        device: torch.device | str = "cpu",
    ) -> None:
        _checked(wavelength, angle, axis)
        if min(grid.shape) < 2:
            raise InputError(f"needs two samples a side for a spectrum, is {grid}", where="grid")
        if not 0 <= leak <= 1:
            raise InputError(f"must be a fraction, is {leak}", where="leak")
        distance = float(checked_distance(distance, torch.device("cpu")))
        self.grid, self.output, self.leak = grid, grid if output is None else output, leak
        self.wavelength, self.angle, self.axis, self.dtype = wavelength, angle, axis, dtype
        self.carrier = (0.0, 0.0) if carrier is None else carrier
        self.output_carrier = (0.0, 0.0) if carrier is None else _turned(self.carrier, angle, axis)
        # The code below tilts about x; for y, x and y are exchanged on the way in and out.
        source, target = (g if axis == "x" else _exchanged(g) for g in (grid, self.output))
        (cx, cy), (_, ty) = ((s if axis == "x" else s[::-1]) for s in (self.carrier, self.output_carrier))
        c, t = (cx / wavelength, cy / wavelength), ty / wavelength
        self._band = _band(source, target, wavelength, angle, c, t, band)
        self._shape = source.shape
        self._samples = _padding(source, target, angle, distance, self._band)
        gy, gx = (torch.fft.fftfreq(n, source.pitch, dtype=torch.float64, device=device) for n in self._samples)
        self._rows = ((gy > self._band.y[0]) & (gy < self._band.y[1])).nonzero()[:, 0]
        self._columns = (gx.abs() < self._band.x).nonzero()[:, 0]
        gy, gx = gy[self._rows], gx[self._columns]
        # The FFT counts from the first sample.
        start = phasor(-2 * math.pi * (gy[:, None] * float(source.y()[0]) + gx[None, :] * float(source.x()[0])))
        axial = math.sqrt(wavelength**-2 - c[0] ** 2 - c[1] ** 2)
        transverse = (c[0] + gx[None, :]) ** 2 + (c[1] + gy[:, None]) ** 2
        change = -(gx[None, :] * (2 * c[0] + gx[None, :]) + gy[:, None] * (2 * c[1] + gy[:, None]))
        change = change / ((wavelength**-2 - transverse).sqrt() + axial)
        weight = 1 / (self._samples[0] * self._samples[1])
        self._start = (start * phasor(2 * math.pi * distance * change) * weight).to(dtype)
        # The frequency along y' from the output's carrier; without carriers it includes the whole axial one.
        left = c[1] * math.cos(angle) + axial * math.sin(angle) - t
        self._across = gy[:, None] * math.cos(angle) + change * math.sin(angle) + left
        self._y = target.y(device=device)
        self._along = phasor(2 * math.pi * gx[:, None] * target.x(device=device)[None, :]).to(dtype)
        count = len(gx) * len(gy) * target.rows
        self._step = max(1, int(len(gx) * KEPT_BYTES / (count * dtype.itemsize)))
        self._kept = self._kernel(slice(None)) if self._step >= len(gx) else None

    def __call__(self, field: torch.Tensor) -> torch.Tensor:
        """From [..., rows, columns] of `grid` to [..., rows, columns] of `output`.

        Raises
        ------
        InputError
            For a field that does not fit, is not finite, or has more than `leak` of its power outside the band.
        """
        field = self._swapped(checked_field(field, self.grid).to(self.dtype))
        spectrum = torch.fft.fft2(field, s=self._samples)
        inside = spectrum[..., self._rows[:, None], self._columns]
        self._refuse_leak(spectrum.detach(), inside.detach())
        inside = inside * self._start
        parts = [
            torch.einsum("xvf,...fx->...vx", self._kernel_of(piece), inside[..., piece]) for piece in self._pieces()
        ]
        return self._swapped(torch.cat(parts, -1) @ self._along)

    def adjoint(self, field: torch.Tensor) -> torch.Tensor:
        """Conjugate transpose, [..., rows, columns] of `output` to those of `grid`: <T a, b> = <a, T* b>.

        It is the inverse only up to the obliquity factor; the exact inverse is the operator of the opposite angle.
        """
        field = self._swapped(checked_field(field, self.output).to(self.dtype)) @ self._along.mH
        parts = [
            torch.einsum("xvf,...vx->...fx", self._kernel_of(piece).conj(), field[..., piece])
            for piece in self._pieces()
        ]
        inside = torch.cat(parts, -1) * self._start.conj()
        spectrum = inside.new_zeros((*inside.shape[:-2], *self._samples))
        spectrum[..., self._rows[:, None], self._columns] = inside
        rows, columns = self._shape
        return self._swapped(torch.fft.ifft2(spectrum, norm="forward")[..., :rows, :columns])

    def _kernel(self, piece: slice) -> torch.Tensor:
        """exp(i2π f_y' y'), shape [g_x, y', g_y]."""
        return phasor(2 * math.pi * self._across.T[piece, None, :] * self._y[None, :, None]).to(self.dtype)

    def _kernel_of(self, piece: slice) -> torch.Tensor:
        return self._kernel(piece) if self._kept is None else self._kept[piece]

    def _pieces(self) -> list[slice]:
        return [slice(first, first + self._step) for first in range(0, len(self._columns), self._step)]

    def _swapped(self, field: torch.Tensor) -> torch.Tensor:
        return field if self.axis == "x" else field.mT

    def _refuse_leak(self, spectrum: torch.Tensor, inside: torch.Tensor) -> None:
        whole, kept = (part.abs().square().sum((-2, -1)) for part in (spectrum, inside))
        lost = float(((whole - kept) / whole.clamp_min(torch.finfo(whole.dtype).tiny)).max())
        if lost > self.leak:
            along, low, high = (f * 2 * self.grid.pitch for f in (self._band.x, -self._band.y[0], self._band.y[1]))
            raise InputError(
                f"has {lost:.2g} of its power outside the band that both planes can hold ({low:.3g} below and "
                f"{high:.3g} above the carrier across the axis, {along:.3g} along it, in Nyquist frequencies of its "
                f"grid); {self.leak:.2g} is allowed",
                where="field",
                remedy="sample field and output more finely, or take the carrier out of the field",
            )


def tilt_directions(
    sx: torch.Tensor, sy: torch.Tensor, angle: float, axis: str = "x"
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Directions on the untilted plane of the waves at (sx, sy) on a tilted one, and the amplitudes' Jacobian.

    Parameters
    ----------
    sx, sy
        Direction sines on the tilted plane, of shapes that broadcast.
    angle, axis
        The tilt, with this module's sign.

    Returns
    -------
    tuple of torch.Tensor
        Sines along x and along y on the untilted plane, and the factor cos/cos' from its spectrum to that on the tilted
        plane.

    Raises
    ------
    InputError
        For directions that do not cross both planes forwards.

    Notes
    -----
    For a tilt about x: s_y = s_y' cos a - s_z' sin a, s_z = s_y' sin a + s_z' cos a, s_x = s_x'. At fixed s_x one has
    ds_y/ds_y' = s_z/s_z', hence U'^(s') = U^(s) s_z/s_z'. Both planes then have the same power that crosses them, ∫
    |U^|² s_z d²s (`tapetum.optics.propagate.flux`), but not the same ∫ |U|² of the field.
    """
    _checked(1.0, angle, axis)
    along, across = (sx.double(), sy.double()) if axis == "x" else (sy.double(), sx.double())
    squared = 1 - along**2 - across**2
    sz = squared.clamp_min(0).sqrt()
    back = across * math.cos(angle) - sz * math.sin(angle)
    untilted = across * math.sin(angle) + sz * math.cos(angle)
    if bool((squared <= 0).any()) or bool((untilted <= 0).any()):
        raise InputError(
            "some do not cross both planes forwards", where="directions", remedy="ask for a smaller range of directions"
        )
    along = along.expand(back.shape)
    return *((along, back) if axis == "x" else (back, along)), untilted / sz


def far_field_on_tilted(
    field: torch.Tensor,
    grid: Grid,
    wavelength: float,
    angle: float,
    sx: torch.Tensor,
    sy: torch.Tensor,
    axis: str = "x",
    *,
    carrier: tuple[float, float] | None = None,
) -> torch.Tensor:
    """Spectrum on the tilted plane, ∫ U' exp(-ik s'·x') d²x', straight from the field on the untilted plane.

    Parameters
    ----------
    field
        Complex field on `grid`, shape [..., rows, columns].
    grid, wavelength, angle, axis, carrier
        As for `TiltedPlane`, the axis of the tilt lying in the field's plane.
    sx, sy
        Direction sines on the tilted plane, shapes [U] and [V], counted from its `output_carrier` where a carrier is
        given. On the sensor of a camera with the focal length f they are pixel places over f.

    Returns
    -------
    torch.Tensor
        [..., V, U], complex128: the field's spectrum in the directions that the tilt maps to (`tilt_directions`), times
        the Jacobian that keeps the flux, by the Fourier integral without interpolation.

    Raises
    ------
    InputError
        For a field that does not fit, directions that do not cross both planes forwards, or that lie beyond the grid's
        Nyquist frequency, where its spectrum repeats.
    """
    _checked(wavelength, angle, axis)
    field = checked_field(field, grid).to(torch.complex128)
    c = (0.0, 0.0) if carrier is None else carrier
    t = (0.0, 0.0) if carrier is None else _turned(c, angle, axis)
    from_x, from_y, jacobian = tilt_directions(sx[None, :] + t[0], sy[:, None] + t[1], angle, axis)
    from_x, from_y = from_x - c[0], from_y - c[1]
    most = float(torch.maximum(from_x.abs(), from_y.abs()).max())
    if most > wavelength / (2 * grid.pitch):
        raise InputError(
            f"reach {most:.4g} from the carrier, where a pitch of {grid.pitch:.4g} m holds "
            f"{wavelength / (2 * grid.pitch):.4g}",
            where="directions",
            remedy="sample the field more finely, take its carrier out or ask for a smaller range",
        )
    k = 2 * math.pi / wavelength
    # Along the tilt's axis the map is the identity, so one transform serves all; across it, each column differs.
    if axis == "y":
        field, grid = field.mT, _exchanged(grid)
        from_x, from_y = from_y.mT, from_x.mT
    first = phasor(-k * grid.x(device=field.device)[:, None] * from_x[:1, :])
    columns, y = field @ first, grid.y(device=field.device)
    out = torch.stack(
        [
            columns[..., u][..., None, :] @ phasor(-k * y[:, None] * from_y[None, :, u])
            for u in range(columns.shape[-1])
        ],
        -1,
    )[..., 0, :, :]
    return (out if axis == "x" else out.mT) * jacobian * grid.pitch**2


def _exchanged(grid: Grid) -> Grid:
    """The grid with x and y exchanged."""
    return Grid(grid.columns, grid.rows, grid.pitch, (grid.centre[1], grid.centre[0]))


def _checked(wavelength: float, angle: float, axis: str) -> None:
    one_of(axis, ("x", "y"), "axis")
    if not (math.isfinite(wavelength) and wavelength > 0):
        raise InputError(f"must be positive and finite, is {wavelength}", where="wavelength")
    if not abs(angle) < math.pi / 2:
        raise InputError(f"must lie between -90 and 90 degrees, is {math.degrees(angle):.6g}", where="angle")


def _turned(carrier: tuple[float, float], angle: float, axis: str) -> tuple[float, float]:
    """Sines of the carrier seen from the tilted plane."""
    squared = 1 - carrier[0] ** 2 - carrier[1] ** 2
    along, across = carrier if axis == "x" else (carrier[1], carrier[0])
    if not squared > 0 or math.sqrt(squared) * math.cos(angle) - across * math.sin(angle) <= 0:
        raise InputError(f"{carrier} does not cross both planes forwards", where="carrier")
    across = across * math.cos(angle) + math.sqrt(squared) * math.sin(angle)
    return (along, across) if axis == "x" else (across, along)


def _band(
    source: Grid,
    target: Grid,
    wavelength: float,
    angle: float,
    carrier: tuple[float, float],
    target_carrier: float,
    wanted: float | None,
) -> _Band:
    """The widest band, or the wanted one, that crosses both planes forwards and that the output can hold."""

    def box(along: float, low: float, high: float) -> _Band:
        ranges = [
            (f - below / (2 * source.pitch), f + above / (2 * source.pitch))
            for f, below, above in zip(carrier, (along, low), (along, high), strict=True)
        ]
        ends_x, ends_y = ((*ends, min(max(0.0, ends[0]), ends[1])) for ends in ranges)
        slopes_x: list[float] = []
        slopes_y: list[float] = []
        least, mapped = math.inf, 0.0
        for fx in ends_x:
            for fy in ends_y:
                axial = math.sqrt(max(wavelength**-2 - fx**2 - fy**2, 0.0))
                least = min(least, wavelength * axial, wavelength * (axial * math.cos(angle) - fy * math.sin(angle)))
                across = fy * math.cos(angle) + axial * math.sin(angle) - target_carrier
                mapped = max(mapped, abs(across) * (target.rows > 1), abs(fx - carrier[0]) * (target.columns > 1))
                slopes_x.append(fx / max(axial, 1e-12 / wavelength))
                slopes_y.append(fy / max(axial, 1e-12 / wavelength))
        wide = (along / (2 * source.pitch), (-low / (2 * source.pitch), high / (2 * source.pitch)))
        return _Band(*wide, (min(slopes_x), max(slopes_x)), (min(slopes_y), max(slopes_y)), least, mapped)

    nyquist = 1 / (2 * target.pitch) * (1 + 1e-12)
    if wanted is not None:
        band = box(wanted, wanted, wanted)
        if not 0 < wanted <= 1 or band.least_cosine <= 0:
            raise InputError(f"{wanted} holds waves that do not cross both planes forwards", where="band")
        if band.mapped > nyquist:
            remedy = f"give the output a pitch of {1 / (2 * band.mapped):.4g} m or name a carrier"
            raise InputError(f"{target.pitch:.4g} m cannot hold the band {wanted}", where="output.pitch", remedy=remedy)
        return band
    least = box(0.0, 0.0, 0.0)
    if least.mapped > nyquist:
        raise InputError(
            f"{target.pitch:.4g} m cannot hold light at {math.degrees(angle):.4g} degrees to the output's normal",
            where="output.pitch",
            remedy=f"take the carrier out with carrier=(s_x, s_y), or use less than {1 / (2 * least.mapped):.4g} m",
        )
    parts = (0.0, 0.0, 0.0)
    # Shrink all sides together first, then each by itself.
    for sides in ((1, 1, 1), (0, 1, 0), (0, 0, 1), (1, 0, 0)):
        low, high, trial = 0.0, 1.0, 1.0
        for _ in range(40):
            grown = tuple(part + (1 - part) * trial * side for part, side in zip(parts, sides, strict=True))
            whole = box(*grown)
            fits = whole.mapped <= nyquist and whole.least_cosine >= min(GRAZING, least.least_cosine)
            low, high = (trial, high) if fits else (low, trial)
            trial = (low + high) / 2
        parts = tuple(part + (1 - part) * low * side for part, side in zip(parts, sides, strict=True))
    return box(*parts)


def _padding(source: Grid, target: Grid, angle: float, distance: float, band: _Band) -> tuple[int, int]:
    """Rows and columns of the padded field whose period keeps every copy of the light off the output."""

    def ends(coordinates: torch.Tensor) -> tuple[float, float]:
        return float(coordinates[0]), float(coordinates[-1])

    spans = [0.0, 0.0]
    for point in ends(target.y()):
        z = distance + point * math.sin(angle)
        for slope in band.slopes_y:
            spans[0] = max(spans[0], *(abs(point * math.cos(angle) - y - z * slope) for y in ends(source.y())))
        for slope in band.slopes_x:
            spans[1] = max(spans[1], *(abs(u - x - z * slope) for x in ends(source.x()) for u in ends(target.x())))
    needed = [max(count, math.ceil(span / source.pitch) + 1) for span, count in zip(spans, source.shape, strict=True)]
    if max(needed) > MAX_SIDE:
        raise InputError(
            f"{max(needed)} samples of {source.pitch:.4g} m are needed to hold the light on the tilted plane, more "
            f"than {MAX_SIDE}",
            where="output",
            remedy="use a smaller output, a coarser grid or a narrower band",
        )
    return fast_length(needed[0]), fast_length(needed[1])
