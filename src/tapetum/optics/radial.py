"""Fields that depend only on the distance from one point: tabulated once, read anywhere.

Light that passes a round aperture twice, with a plane mirror between, returns as a round field about a point that the
tilt displaces (docs/conventions.md, "The round pass"). All gazes of a sweep read the same table.
"""

# SciPy and NumPy type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import fresnel, j0, zeta

from tapetum.optics.propagate import fast_length
from tapetum.optics.sampling import Fade

__all__ = ["FocusTables", "RadialTable", "disc_transform", "focus_tables", "returning_field", "spot_field"]

Complex = npt.NDArray[np.complex128]
Real = npt.NDArray[np.float64]

# Oversampling of the integrand, over its own band and the wanted reach.
_OVERSAMPLED = 4
# Samples of the transform for each of its Nyquist interval.
_PADDED = 4
# Degree of the end correction: as in optics/pupil.py higher degrees gain nothing.
_END_ORDER = 6
# Largest phase step between table entries, in radians: nearest neighbours err by 1 % at random, which averages out over
# tens of thousands of pupil samples, and cubic interpolation errs by 1e-8.
_TURN = 2 * math.pi / 512


@dataclass(frozen=True)
class RadialTable:
    """A round field on equally spaced distances from its middle.

    Parameters
    ----------
    values
        Complex amplitudes at 0, step, 2 step …, shape [M].
    step
        In metres.
    partials
        Derivatives of the values with respect to named parameters, each [M].
    """

    values: torch.Tensor
    step: float
    partials: dict[str, torch.Tensor]

    def nearest(self, steps: torch.Tensor) -> torch.Tensor:
        """The field at distances given in steps, any real shape, to the nearest entry. `steps` is overwritten."""
        places = steps.add_(0.5).to(torch.int32).clamp_(max=len(self.values) - 1)
        return self.values.index_select(0, places.flatten()).view(steps.shape)

    def smooth(self, steps: torch.Tensor, **moves: torch.Tensor) -> torch.Tensor:
        """The field by cubic interpolation, with gradients to `steps` and to the parameters of `partials`.

        `moves` are scalars worth zero, value minus its own detached value: they carry the gradient.
        """
        cubics = self._cubics
        last = len(self.values) - 3
        places = steps.detach().floor().int().clamp(0, last)
        t = (steps - places).clamp(0, 2)
        value = _at(cubics[""], places, t)
        for name, move in moves.items():
            # A long lens's derivatives cancel to a hundredth, so they need the same precision.
            value = value + _at(cubics[name], places, t.detach()) * move
        return value

    @cached_property
    def _cubics(self) -> dict[str, tuple[torch.Tensor, ...]]:
        """Coefficients of `_cubics_of` for the values, under no name, and for the partials."""
        return {name: _cubics_of(values) for name, values in {"": self.values, **self.partials}.items()}

    def to(self, device: torch.device, dtype: torch.dtype) -> RadialTable:
        """The table on another device, in another precision."""
        return RadialTable(
            self.values.to(device, dtype),
            self.step,
            {name: values.to(device, dtype) for name, values in self.partials.items()},
        )


@dataclass(frozen=True)
class FocusTables:
    """Returning light of planes at a range of distances: `tables` at Chebyshev `nodes` of the distance z, in metres.

    At the same angle ξ/2z the light times z changes smoothly with z, by no more than the pupil's change of focus.
    """

    nodes: tuple[float, ...]
    tables: tuple[RadialTable, ...]

    @property
    def only(self) -> RadialTable:
        """The table where there is only one."""
        return self.tables[0]

    def at(self, distances: torch.Tensor, z: torch.Tensor, moves: dict[str, torch.Tensor]) -> torch.Tensor:
        """The field ξ [B, rows, columns] metres from its middle, of planes at z [B]; differentiable."""
        total: torch.Tensor | None = None
        for i, (node, table) in enumerate(zip(self.nodes, self.tables, strict=True)):
            if len(self.nodes) == 1:
                return table.smooth(distances / table.step, **moves)
            share = node / z
            for j, other in enumerate(self.nodes):
                if j != i:
                    share = share * (z - other) / (node - other)
            steps = distances * (node / z / table.step)[:, None, None]
            part = table.smooth(steps, **moves) * share[:, None, None]
            total = part if total is None else total + part
        assert total is not None
        return total


def focus_tables(
    table: Callable[[float], RadialTable], z: float, reach: float, turning: float, error: float
) -> FocusTables:
    """Tables for planes from z/(1 + reach) to z/(1 - reach).

    Parameters
    ----------
    table
        Makes one for a distance.
    z
        In the middle, in metres.
    reach
        Largest change of 1/z, over 1/z.
    turning
        k r², in metres.
    error
        Of the field, over its largest value.

    Notes
    -----
    The phase changes by k r² δ/2z² for a plane farther by δ. With n nodes the error of exp(i turn t) on [-1, 1] is
    below 2 (turn/2)ⁿ/n!.
    """
    if reach == 0:
        return FocusTables((z,), (table(z),))
    low, high = z / (1 + reach), z / (1 - reach)
    turn = turning * (high - low) / 2 / (2 * low**2)
    count, left = 2, turn**2 / 4
    while left > error:
        count += 1
        left *= turn / (2 * count)
    nodes = [(low + high) / 2 + (high - low) / 2 * math.cos(math.pi * (i + 0.5) / count) for i in range(count)]
    return FocusTables(tuple(nodes), tuple(table(node) for node in nodes))


def disc_transform(
    radius: float, chirp: float, kappa: float, reach: float, *, spacing: float = math.inf, moments: bool = False
) -> Any:
    """∫ exp(i chirp ρ² - i kappa ξ x) d²x over a disc, for ξ from 0 to `reach`.

    Parameters
    ----------
    radius
        Of the disc, in metres.
    chirp, kappa
        In radians per square metre.
    reach
        Largest ξ, in metres.
    spacing
        Largest step of ξ, in metres; at most a quarter of the Nyquist interval.
    moments
        Whether to return the first and second derivatives with respect to ξ as well.

    Returns
    -------
    tuple
        values [M] complex128, the step of ξ in metres, and with `moments` both derivatives, each [M].

    Notes
    -----
    By the projection-slice theorem a round transform is the one-dimensional transform of the disc's projection, which
    is a Fresnel integral in closed form; it ends like a square root on both sides, for which the sum over equally
    spaced samples is corrected. One fast Fourier transform then gives all ξ, without Bessel functions. A Hankel
    transform by Gauss-Legendre quadrature agrees to 1e-7 (tests/optics/test_radial.py).
    """
    widest = max(reach, 2 * abs(chirp) * radius / kappa)
    count = 1 << max(10, math.ceil(math.log2(_OVERSAMPLED * 4 * kappa * radius * widest / math.pi)))
    step = 2 * radius / count
    x = np.arange(1, count) * step - radius
    slope = max(abs(chirp), 1e-12 / radius**2)
    half_chord = np.sqrt(np.maximum(radius**2 - x**2, 0.0))
    sine, cosine = fresnel(half_chord * math.sqrt(2 * slope / math.pi))
    projection = 2 * math.sqrt(math.pi / (2 * slope)) * (cosine + 1j * sine) * np.exp(1j * slope * x**2)
    if chirp < 0:
        projection = projection.conj()
    weights = np.full(count - 1, step)
    correction = _root_end_weights(_END_ORDER) * step
    weights[:_END_ORDER] += correction
    weights[-_END_ORDER:] += correction[::-1]
    length = fast_length(math.ceil(max(_PADDED * count, 2 * math.pi / (kappa * spacing * step))))
    places = (np.arange(1, count) - count // 2) % length
    xi_step = 2 * math.pi / (kappa * length * step)
    kept = math.ceil(reach / xi_step) + 2

    def transform(integrand: Complex) -> Complex:
        padded = np.zeros(length, np.complex128)
        padded[places] = integrand
        return _transformed(padded)[:kept]

    weighted = projection * weights
    values = transform(weighted)
    if not moments:
        return values, xi_step
    return values, xi_step, transform(weighted * (-1j * kappa * x)), transform(weighted * -((kappa * x) ** 2))


def returning_field(
    wavelength: float,
    radius: float,
    image_distance: float,
    vergence: float,
    reach: float,
    slopes: tuple[float, float],
    *,
    partials: bool = False,
) -> RadialTable:
    """The light that returns to the lens, chirp and displacement removed, before it passes the lens again.

    Parameters
    ----------
    wavelength, radius, image_distance
        λ, aperture radius r and sensor distance z, in metres.
    vergence
        Of the light behind the lens, 1/R - 1/f, in 1/m.
    reach
        Largest distance from its middle, in metres.
    slopes
        Of the field, in radians: light up to the first is kept whole, light beyond the second is left out.
    partials
        Whether to tabulate the derivatives with respect to `image_distance`, `vergence`, `radius` and `wavenumber`.

    Returns
    -------
    RadialTable
        F(ξ) = exp(-ikξ²/4z)/(2iλz) ∫ exp(ik(v + 1/2z)ρ²/2 - ikξx/2z) d²x over the disc, v the vergence: the field at
        the lens is exp(ik|ξ|²/2z + ...) F(|ξ|), ξ = x - 2z s (docs/conventions.md, "The round pass").
    """
    k, z = 2 * math.pi / wavelength, image_distance
    fade = Fade.of(slopes, wavelength, radius, image_distance, reach)
    kappa, beta = k / (2 * z), vergence + 1 / (2 * z)
    disc, step, *derivatives = disc_transform(
        radius, k * beta / 2, kappa, reach + fade.margin, spacing=fade.spacing, moments=partials
    )
    xi = np.arange(len(disc)) * step
    carrier = np.exp(-1j * k * xi**2 / (4 * z)) / (2j * wavelength * z)
    finest = max(1, math.ceil(k * fade.end * step / _TURN))
    filtered = _Lowpass(step, fade.flat / wavelength, fade.end / wavelength, len(disc), finest)
    count = math.ceil(reach / step * finest) + 4
    tables = {"": carrier * disc}
    if partials:
        first, second = derivatives
        # ρ² under the integral is -∇²/κ² outside it.
        around = np.concatenate([second[:1], first[1:] / xi[1:]])
        rho_squared = -(second + around) / kappa**2
        edge = np.exp(1j * k * beta * radius**2 / 2) * j0(kappa * xi * radius) * 2 * math.pi * radius
        by_beta = carrier * 0.5j * k * rho_squared
        by_scale = carrier * xi * first
        tables["vergence"] = by_beta
        tables["image_distance"] = (
            carrier * disc * (1j * k * xi**2 / (4 * z**2) - 1 / z) - by_scale / z - by_beta / (2 * z**2)
        )
        tables["radius"] = carrier * edge
        tables["wavenumber"] = carrier * disc * (-1j * xi**2 / (4 * z) + 1 / k) + (by_scale + by_beta * beta) / k
    made = {name: torch.from_numpy(filtered(values)[:count]) for name, values in tables.items()}
    values = made.pop("")
    return RadialTable(values, step / finest, made)


def spot_field(
    wavelength: float, radius: float, image_distance: float, vergence: float, reach: float
) -> tuple[Complex, float]:
    """The spot on the sensor, from its own centre: 1/(iλz) ∫ exp(ik(v + 1/z)ρ²/2 - ik x·ξ/z) d²x.

    Parameters as for `returning_field`, with `reach` on the sensor.

    Returns
    -------
    tuple
        Amplitudes [M] for an illumination of 1 W/m², in W^½/m, and their spacing in metres.
    """
    k, z = 2 * math.pi / wavelength, image_distance
    disc, step = disc_transform(radius, k * (vergence + 1 / z) / 2, k / z, reach)
    return disc / (1j * wavelength * z), step


def _cubics_of(values: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Coefficients of 1, t, t² and t³, [M - 2] each, of the cubics through four entries that begin one before each."""
    # The field is even: its entry at -1 is that at 1.
    before, at, after, then = torch.cat([values[1:2], values[:-3]]), values[:-2], values[1:-1], values[2:]
    return (
        at,
        after - at / 2 - before / 3 - then / 6,
        (before + after) / 2 - at,
        (at - after) / 2 + (then - before) / 6,
    )


def _at(cubics: tuple[torch.Tensor, ...], places: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """Values of the cubics of these places at t."""
    if not t.requires_grad:
        # More precise weights would only promote the result to complex128.
        t = t.to(cubics[0].real.dtype)
    chosen = places.flatten()
    constant, slope, square, cube = (one.index_select(0, chosen).view(t.shape) for one in cubics)
    return constant + t * (slope + t * (square + t * cube))


class _Lowpass:
    """Removes oscillations faster than wanted, and resamples `finer` times as densely. The field is even."""

    def __init__(self, step: float, low: float, high: float, count: int, finer: int) -> None:
        self._count, self._finer = count, finer
        self._length = fast_length(2 * count - 1)
        frequency = np.abs(np.fft.fftfreq(self._length, step))
        fall = np.clip((frequency - low) / (high - low), 0, 1)
        self._window: Real = np.cos(fall * math.pi / 2) ** 2

    def __call__(self, values: Complex) -> Complex:
        # Both halves, joined smoothly at their far ends.
        gap = self._length - (2 * self._count - 1)
        mirrored = np.concatenate([values, np.full(gap, values[-1]), values[:0:-1]])
        spectrum = _transformed(mirrored) * self._window
        fine = np.zeros(self._length * self._finer, np.complex128)
        half = self._length // 2
        fine[: half + 1] = spectrum[: half + 1]
        fine[len(fine) - (self._length - half - 1) :] = spectrum[half + 1 :]
        return _transformed(fine, inverse=True) * self._finer


def _transformed(values: Complex, *, inverse: bool = False) -> Complex:
    """Fast Fourier transform, by torch: of hundreds of thousands of values NumPy's takes twice as long, or more."""
    given, transforms = torch.from_numpy(values), cast(Any, torch.fft)
    return (transforms.ifft if inverse else transforms.fft)(given).numpy()


@cache
def _root_end_weights(order: int) -> Real:
    """Corrections c_1 … c_order to the weights of samples j of an integrand √t g(t) that begins at t = 0.

    Σ_j c_j j^{m+1/2} = -ζ(-m-1/2): the zeta-regularised error of the plain sum (Navot, J. Math. Phys. 40, 271 (1961)).
    """
    m = np.arange(order)
    j = np.arange(1, order + 1, dtype=np.float64)
    regular = np.array([-_zeta(-degree - 0.5) for degree in m])
    weights: Real = np.asarray(np.linalg.solve(j[None, :] ** (m[:, None] + 0.5), regular), np.float64)
    return weights


def _zeta(s: float) -> float:
    """Riemann's ζ at a negative argument, by its functional equation."""
    return 2**s * math.pi ** (s - 1) * math.sin(math.pi * s / 2) * math.gamma(1 - s) * float(zeta(1 - s, 1))
