"""The sensor plane Arr(x, y): photosites, microlenses, colour filters, or any mask from a file.

A periodic plane is a grating. Its Fourier coefficients c_m, Arr(u) = Σ c_m exp(2πi m·u/P), are the amplitudes of the
diffraction orders of directions m λ/P (docs/conventions.md, "The sensor plane"); a mask from a file is sampled within
the spot. Both forms of an array are here, so that one can check the other; so the file has more than 400 lines.

Microlenses whose offset from their photosites grows towards the field's edge make the coefficients depend on the place
w on the sensor. Over the spot they are constant: with the photosites' coefficients s and the lenses' l, c_m(w) = Σ
s_(m-b) l_b exp(2πi shift b·w/p), a series that an order carries with it.

A cell is one pitch square: a photosite in its middle, its surround, and a microlens over both. With a Bayer filter each
cell, photosite and surround alike, is dimmed by its own colour, and the period P is two pitches. Rows and columns begin
at the sensor's upper left corner, so that a photosite's centre lies on the optical axis for odd counts of pixels, a
corner of four for even ones. The orders are those of an infinite array; `sensor_edge` treats its end.
"""

# SciPy and NumPy type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import fresnel

from tapetum.bench import TargetSensor
from tapetum.errors import InputError
from tapetum.optics.photosites import SHAPES, Photosite, Round, Square, covered
from tapetum.simulate.surfaces import Order, PlaceSeries, Reflectance

__all__ = ["Reflectance", "orders_of", "reflectance_at", "second_derivative", "widened"]

Complex = npt.NDArray[np.complex128]
Real = npt.NDArray[np.float64]

# Samples a pitch of a cell without a closed form: amplitudes of orders are within 2e-5 of those at 2048
# (tests/simulate/test_sensor_plane.py).
_FINE, _FINEST = 512, 1024
# Power below which an order is left out, over the largest one's.
_FAINT = 1e-8
_MOST_ORDERS = 20_000
_MOST_SHIFTED = 2000
# Fourier coefficients of a microlens to either side that represent a shift: amplitudes are within 1e-3 of the shifted
# cell's (tests/simulate/test_tolerances.py).
_HARMONICS = 24
# Second derivative from seven equally spaced values, exact to the sixth order (Fornberg, Math. Comp. 51, 699 (1988)).
_SECOND_DERIVATIVE = (1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90)


def orders_of(sensor: TargetSensor, wavelength: float, widest: float) -> tuple[Order, ...]:
    """Diffraction orders of a sensor's photosites and microlenses, from the axis outwards.

    Parameters
    ----------
    sensor
        Its `array` and `microlens` are a grating; without them it is a mirror with one order.
    wavelength
        In metres.
    widest
        Largest direction wanted, as a slope. The rays of orders within (r_out + r)/z + 2 tanθ return to the aperture,
        r_out being the returning light's radius at the lens; orders beyond it still diffract into it, a few 1e-3 of the
        peak where many overlap. Take a third more, or twice the first term.

    Returns
    -------
    tuple of Order
        Amplitudes of the reflected field: sqrt(reflectance) times the cell's Fourier coefficient, phases with respect
        to the optical axis. Orders below 1e-8 of the strongest one's power are left out, for thousands of them add up
        where a pitch is many rings wide.

    Raises
    ------
    InputError
        For a sensor with a mask, which has no orders, and for more than 20 000 of them (2000 where microlenses are
        shifted).

    Notes
    -----
    Scalar diffraction at one plane: a photosite of side w = p sqrt(fill) has c_m = fill sinc(m_x w/p) sinc(m_y w/p), a
    round one of radius a has c_m = (a/p) J1(2π a m/p)/m (Goodman, Introduction to Fourier Optics, chapters 2 and 4);
    other shapes are in `tapetum.optics.photosites`. A microlens is a thin lens passed twice, exp(-ik ρ²/f_m) inside its
    diameter; outside it the phase of its rim continues.
    """
    if sensor.mask is not None:
        what, remedy = "has no diffraction orders", "sample it, or describe the sensor by an array"
        raise InputError(what, where="target.sensor.mask", remedy=remedy)
    if sensor.reflectance == 0:
        return ()
    cell = _cell_of(sensor, wavelength)
    if cell is None:
        return (Order(amplitude=math.sqrt(sensor.reflectance)),)
    shift = 0.0 if sensor.microlens is None else sensor.microlens.shift
    step = wavelength / cell.period
    most = int(widest / step * (1 + 1e-12))
    if math.pi * most**2 > _MOST_ORDERS:
        raise InputError(
            f"a pitch of {cell.pitch * 1e6:.4g} um sends {math.pi * most**2:.0f} orders through the aperture",
            where="target.sensor.array.pitch",
            remedy="stop the target's aperture down, or take a finer pitch",
        )
    m = np.arange(-most, most + 1)
    table = cell.coefficients(m, m)
    strongest = np.abs(table).max()
    found = [
        (column**2 + row**2, int(row), int(column), complex(table[row + most, column + most]))
        for row in m
        for column in m
        if math.hypot(column, row) * step <= widest * (1 + 1e-12)
        # A shift may make an order strong elsewhere that is faint on the axis.
        and (shift != 0 or abs(table[row + most, column + most]) ** 2 > _FAINT * strongest**2)
    ]
    if shift != 0:
        return _shifted_orders(cell, sorted(found, key=lambda o: o[:3]), shift, sensor.decentre, strongest)
    return tuple(
        Order((column * step, row * step), amplitude)
        for _, row, column, amplitude in sorted(found, key=lambda o: o[:3])
    )


def reflectance_at(
    sensor: TargetSensor, wavelength: float, window: tuple[float, float, float, float] | None = None
) -> Reflectance:
    """The sensor plane's complex reflectance as a function of place.

    Parameters
    ----------
    sensor
        What it is made of.
    wavelength
        In metres.
    window
        Left, right, upper and lower edge in metres from the axis, beyond which nothing is reflected; default: none.

    Returns
    -------
    Callable
        (x [..., n], y [..., m]) in metres from the optical axis to complex amplitudes [..., m, n]. Columns and rows
        must be equally spaced.

    Raises
    ------
    InputError
        For a file that is missing, is no array of numbers with two dimensions, or reflects more than all light, and for
        shifted microlenses.

    Notes
    -----
    Arr has edges between the samples. A sample is the second difference of the twice integrated reflectance: a mean
    over a hat two steps wide, sharpened so that a frequency f is right to (2π f dx)⁶/560, while frequencies beyond the
    samples' limit fall as 1/f². Files are interpolated bilinearly and reflect nothing outside.
    """
    amplitude = math.sqrt(sensor.reflectance)
    if sensor.mask is not None:
        plane = _Sampled(sensor.mask.amplitudes(sensor.reflectance) * amplitude, sensor.mask.pitch)
        bounds = _bounds(window)
        across, down = sensor.decentre
        moved = bounds[0] + across, bounds[1] + across, bounds[2] + down, bounds[3] + down
        return lambda x, y: plane(x + across, y + down, moved)
    if sensor.microlens is not None and sensor.microlens.shift != 0:
        what = "a plane of shifted microlenses has no period and is not sampled"
        raise InputError(what, where="target.sensor.microlens.shift", remedy="use its orders")
    cell = _cell_of(sensor, wavelength)
    bounds = _bounds(window)
    if cell is None:
        return lambda x, y: amplitude * (_held(y, *bounds[2:]) @ _held(x, *bounds[:2]).mT).to(torch.complex128)
    periodic = _Periodic(cell)
    return lambda x, y: periodic(x, y, bounds)


# Left, right, upper and lower end of the reflecting area, in metres.
_Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class _Cell:
    """One period of an array, its middle photosite's centre at the origin."""

    pitch: float
    site: Photosite
    surround: complex
    lens: tuple[float, float] | None
    wavelength: float
    tiles: Complex
    corner: tuple[float, float]
    reflectance: float

    @property
    def period(self) -> float:
        return self.pitch * len(self.tiles)

    def coefficients(self, columns: npt.NDArray[np.int64], rows: npt.NDArray[np.int64]) -> Complex:
        """c_m for the orders named, [rows, columns]."""
        count = len(self.tiles)
        plain = self.transform(columns / count, rows / count)
        place = np.arange(count) + 0.5
        # Photosites' centres from the axis, in periods: removing whole turns here is exact.
        across = np.exp(-2j * np.pi * np.outer(columns, (place + self.corner[0] / self.pitch) / count % 1.0))
        down = np.exp(-2j * np.pi * np.outer(rows, (place + self.corner[1] / self.pitch) / count % 1.0))
        return math.sqrt(self.reflectance) * plain * (down @ self.tiles @ across.T) / count**2

    def transform(self, across: Real, down: Real) -> Complex:
        """1/p² ∫ exp(-2πi ν·x/p) over one photosite and its surround, ν in orders of a single pitch."""
        if self.lens is not None:
            edges, values = self.fine()
            return _of_steps(edges / self.pitch, down) @ values @ _of_steps(edges / self.pitch, across).T
        all_of_it = np.outer(np.sinc(down), np.sinc(across))
        return (1 - self.surround) * self.site.transform(across, down) + self.surround * all_of_it

    def steps(self) -> tuple[Real, Complex]:
        """Edges over one pitch and values between them, [rows, columns]: exact for square photosites without a lens."""
        if self.lens is not None or self.site.breaks is None:
            return self.fine()
        edges = self.pitch * np.array([-0.5, *self.site.breaks, 0.5])
        values = np.full((3, 3), self.surround, np.complex128)
        values[1, 1] = 1.0
        return edges, values

    def fine(self, count: int | None = None) -> tuple[Real, Complex]:
        """Means over small squares, edges weighted by the covered area."""
        p = self.pitch
        if count is None:
            turns = 0.0 if self.lens is None else p**2 / (self.wavelength * self.lens[0])
            count = min(max(_FINE, 1 << math.ceil(math.log2(32 * max(turns, 1)))), _FINEST)
        edges = np.linspace(-p / 2, p / 2, count + 1)
        site = covered(edges / p, self.site)
        values = self.surround + (1 - self.surround) * site
        if self.lens is not None:
            focal, radius = self.lens
            bend = 2 * math.pi / (self.wavelength * focal)
            line = _chirp_means(edges, bend)
            disc = Round(math.pi * (radius / p) ** 2)
            cover, rim = covered(edges / p, disc), cmath.exp(-1j * bend * radius**2)
            values = values * (cover * np.outer(line, line) + (1 - cover) * rim)
        return edges, values.astype(np.complex128)


def _cell_of(sensor: TargetSensor, wavelength: float) -> _Cell | None:
    array, lens = sensor.array, sensor.microlens
    if array is None and lens is None:
        return None
    pitch = sensor.pitch if array is None or array.pitch is None else array.pitch
    fill = 1.0 if array is None else array.fill
    bayer = None if array is None else array.bayer
    tiles = np.ones((1, 1)) if bayer is None else np.sqrt(np.array(bayer, np.float64).reshape(2, 2))
    columns, rows = sensor.pixels
    return _Cell(
        pitch=pitch,
        site=Square(fill) if array is None else SHAPES[array.shape](fill),
        surround=1.0 if array is None else cmath.rect(math.sqrt(array.surround), array.phase),
        lens=None if lens is None else (lens.focal_length, lens.fill * pitch / 2),
        wavelength=wavelength,
        tiles=tiles.astype(np.complex128),
        corner=(-columns * sensor.pitch / 2 - sensor.decentre[0], -rows * sensor.pitch / 2 - sensor.decentre[1]),
        reflectance=sensor.reflectance,
    )


def _shifted_orders(
    cell: _Cell,
    found: list[tuple[Any, int, int, complex]],
    shift: float,
    decentre: tuple[float, float],
    strongest: float,
) -> tuple[Order, ...]:
    """Orders whose amplitudes follow the place of the spot, without those that are faint everywhere."""
    if len(found) > _MOST_SHIFTED:
        raise InputError(
            f"{len(found)} orders are too many to follow over the field",
            where="target.sensor.microlens.shift",
            remedy="leave it out, stop the target's aperture down, or take a finer pitch",
        )
    assert cell.lens is not None
    sites = replace(cell, lens=None)
    b = np.arange(-_HARMONICS, _HARMONICS + 1).astype(np.float64)
    # The lenses alone, over photosites that fill the plane.
    lenses = replace(cell, surround=1.0).transform(b, b)
    # The lenses' places count from the sensor's middle, the spot's from the lens's axis.
    turn = 2 * np.pi * shift / cell.pitch
    to_axis = np.outer(np.exp(1j * turn * b * decentre[1]), np.exp(1j * turn * b * decentre[0]))
    count, step = len(cell.tiles), cell.wavelength / cell.period
    place = np.arange(count) + 0.5
    orders: list[Order] = []
    for _, row, column, amplitude in found:
        down = np.exp(-2j * np.pi * (row * (place + cell.corner[1] / cell.pitch) / count % 1.0))
        across = np.exp(-2j * np.pi * (column * (place + cell.corner[0] / cell.pitch) / count % 1.0))
        tiles = math.sqrt(cell.reflectance) * (down @ cell.tiles @ across) / count**2
        series = tiles * to_axis * lenses * sites.transform(column / count - b, row / count - b)
        if np.abs(series).sum() ** 2 > _FAINT * strongest**2:
            orders.append(Order((column * step, row * step), amplitude, PlaceSeries(series, turn)))
    return tuple(orders)


def _of_steps(edges: Real, orders: Real) -> Complex:
    """∫ exp(-2πi ν x) between neighbouring edges, [orders, intervals]."""
    width, middle = np.diff(edges), (edges[1:] + edges[:-1]) / 2
    integrals = width * np.sinc(np.outer(orders, width)) * np.exp(-2j * np.pi * np.outer(orders, middle))
    return integrals.astype(np.complex128)


def _chirp_means(edges: Real, bend: float) -> Complex:
    """Means of exp(-i bend x²) between neighbouring edges: Fresnel integrals."""
    scale = math.sqrt(2 * bend / math.pi)
    sine, cosine = fresnel(edges * scale)
    means = np.diff(cosine) / np.diff(edges * scale) - 1j * (np.diff(sine) / np.diff(edges * scale))
    return means.astype(np.complex128)


class _Periodic:
    """An infinite array, as a function of place."""

    def __init__(self, cell: _Cell) -> None:
        edges, values = cell.steps()
        count = len(cell.tiles)
        self._period = cell.period
        # From the period's upper left corner on.
        starts = edges[:-1] - edges[0]
        self._low = torch.from_numpy(np.concatenate([starts + i * cell.pitch for i in range(count)]))
        self._wide = torch.from_numpy(np.tile(np.diff(edges), count))
        self._values = torch.from_numpy(np.kron(cell.tiles, values) * math.sqrt(cell.reflectance))
        self._corner = cell.corner

    def __call__(self, x: torch.Tensor, y: torch.Tensor, bounds: _Bounds) -> torch.Tensor:
        across = self._seen(x.double() - self._corner[0], *(one - self._corner[0] for one in bounds[:2]))
        down = self._seen(y.double() - self._corner[1], *(one - self._corner[1] for one in bounds[2:]))
        return _woven(down, self._values.to(x.device), across)

    def _seen(self, u: torch.Tensor, low: float, high: float) -> torch.Tensor:
        """Weight of each step in every sample between two places, [..., n, steps]."""
        padded, step = widened(u)
        p, start, h = self._period, self._low.to(u.device), self._wide.to(u.device)
        # Beyond the ends the integral continues linearly.
        at = padded.clamp(low, high)
        within = torch.remainder(at, p)[..., None]
        # A step integrated once is a ramp up to its width h, twice a parabola and a line. Its mean, h/p, is added only
        # at the end: the rest is periodic, so nothing cancels far from the origin.
        end = p - start - h
        ramp = (within - start).clamp_min(0).minimum(h)
        parabola = 0.5 * ramp**2 + h * (within - start - h).clamp_min(0)
        middle = (h**2 / 2 + h * end - h * p / 2) / p
        twice = parabola - h * within**2 / (2 * p) - middle * within
        twice = twice + (ramp - h * within / p - middle) * (padded - at)[..., None]
        return second_derivative(twice, step) + h / p * _held(u, low, high)


class _Sampled:
    """A mask from a file, interpolated bilinearly, centred on the axis; zero a pitch beyond its outer samples."""

    def __init__(self, values: Complex, pitch: float) -> None:
        self._values = torch.from_numpy(values)
        self._pitch = pitch

    def __call__(self, x: torch.Tensor, y: torch.Tensor, bounds: _Bounds) -> torch.Tensor:
        rows, columns = self._values.shape
        across, some_columns = self._seen(x.double(), columns, *bounds[:2])
        down, some_rows = self._seen(y.double(), rows, *bounds[2:])
        return _woven(down, self._values[some_rows, some_columns].to(x.device), across)

    def _seen(self, u: torch.Tensor, count: int, low: float, high: float) -> tuple[torch.Tensor, slice]:
        """Weight of each of the file's columns in every sample, [..., n, columns], and which columns these are."""
        padded, step = widened(u)
        h, middle = self._pitch, (count - 1) / 2
        first = math.floor(float(padded.detach().min()) / h + middle)
        last = math.ceil(float(padded.detach().max()) / h + middle)
        some = slice(min(max(first, 0), count), min(max(last + 1, 0), count))
        places = (torch.arange(some.start, some.stop, dtype=u.dtype, device=u.device) - middle) * h
        at = padded.clamp(low, high)
        apart = (at[..., None] - places) / h
        # Linear interpolation is a hat about each column; integrated twice it is cubic, and a line far out, written as
        # such against cancellation.
        near = apart.clamp(-2, 2)
        left, top, right = (near + 1).clamp_min(0), near.clamp_min(0), (near - 1).clamp_min(0)
        twice = h**2 * ((left**3 - 2 * top**3 + right**3) / 6 + (apart - near).clamp_min(0))
        # Beyond the ends the integral continues linearly.
        twice = twice + h * (left**2 - 2 * top**2 + right**2) / 2 * (padded - at)[..., None]
        return second_derivative(twice, step), some


def _bounds(window: tuple[float, float, float, float] | None) -> _Bounds:
    return (-math.inf, math.inf, -math.inf, math.inf) if window is None else window


def _held(u: torch.Tensor, low: float, high: float) -> torch.Tensor:
    """Share of every sample that lies between two places, [..., n, 1]."""
    if math.isinf(low) and math.isinf(high):
        return torch.ones_like(u.double())[..., None]
    padded, step = widened(u.double())
    at = padded.clamp(low, high)
    return second_derivative(((at - low) ** 2 / 2 + (at - low) * (padded - at))[..., None], step)


def widened(u: torch.Tensor) -> tuple[torch.Tensor, float]:
    """Equally spaced places, extended on both sides for the second derivative, and their spacing."""
    if u.shape[-1] < 2:
        raise InputError("needs two columns and rows or more", where="reflectance", remedy="give places in equal steps")
    step = float((u[..., -1] - u[..., 0]).detach().flatten()[0]) / (u.shape[-1] - 1)
    more = len(_SECOND_DERIVATIVE) // 2
    places = torch.arange(-more, u.shape[-1] + more, dtype=u.dtype, device=u.device)
    return u[..., :1] + places * step, step


def second_derivative(values: torch.Tensor, step: float) -> torch.Tensor:
    """Along the last but one axis, by differences."""
    count = values.shape[-2] - len(_SECOND_DERIVATIVE) + 1
    total = values[..., :count, :] * _SECOND_DERIVATIVE[0]
    for i, weight in enumerate(_SECOND_DERIVATIVE[1:], 1):
        total = total + values[..., i : i + count, :] * weight
    return total / step**2


def _woven(down: torch.Tensor, values: torch.Tensor, across: torch.Tensor) -> torch.Tensor:
    return (down.to(values.dtype) @ values) @ across.to(values.dtype).mT
