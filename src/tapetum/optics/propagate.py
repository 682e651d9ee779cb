"""Scalar free-space propagation of sampled complex fields: the Fresnel integral and the exact angular spectrum.

`exp(+ikz)` travels towards +z and is left out of every result: a plane wave along the axis keeps its value 1 over any
distance. Phases are formed in float64, with k_z - k = -(k_x² + k_y²)/(k_z + k), which avoids cancellation. Neither
method interpolates, and both refuse grids on which the result would be aliased.
"""

# SciPy and torch type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from scipy.fft import next_fast_len

from tapetum.errors import InputError
from tapetum.optics.fourier import MatrixFourier, phasor
from tapetum.optics.grid import Grid

__all__ = ["angular_spectrum", "checked_distance", "checked_field", "fast_length", "flux", "fresnel", "suitable_method"]

# Samples a side of the padded spectrum beyond which a request is refused, to bound the memory.
MAX_SIDE = 8192
# Width of the smooth end of the band, in Fresnel zone radii sqrt(λz), measured on a Gaussian beam against its exact
# form (tests/optics/test_propagate.py).
TAPER = 8.0
# Neglected phase, in radians, up to which the Fresnel integral is recommended.
PARAXIAL_PHASE = 1e-2


def fresnel(
    field: torch.Tensor,
    source: Grid,
    wavelength: float,
    distance: float | torch.Tensor,
    output: Grid,
    *,
    dtype: torch.dtype = torch.complex128,
) -> torch.Tensor:
    """Fresnel integral from `source` to `output`, as a matrix Fourier transform between two quadratic phases.

    Parameters
    ----------
    field
        Complex field, [..., rows, columns] of `source`.
    source, output
        Input and output grids: any pitch, size and centre.
    wavelength
        In metres.
    distance
        In metres, of either sign; a 0-d tensor carries gradients.
    dtype
        complex64 or complex128, of the result; phases are formed in float64 either way.

    Returns
    -------
    torch.Tensor
        [..., rows, columns] of `output`, without the carrier exp(ikz).

    Raises
    ------
    InputError
        For a field that does not fit `source` or is not finite, for a zero distance, and where the kernel
        exp(ik(x-u)²/2z) turns by more than half a period between source samples. Beyond that the copies of the output,
        λz/pitch apart, may reach `output`.

    Notes
    -----
    U2(u) = 1/(iλz) ∫ U1(x) exp(ik|x-u|²/2z) d²x (Goodman, Introduction to Fourier Optics, 3rd ed., equation 4-14). A
    field within the band ±1/(2 pitch) sends light to |u-x| <= λz/(2 pitch) only, and its copies beyond that: the
    criterion |u-x| <= λz/(2 pitch) is Voelz and Roggemann's, Appl. Opt. 48, 6132 (2009).
    """
    field = checked_field(field, source).to(dtype)
    z, gap = checked_distance(distance, field.device), _farthest(source, output)
    _positive(wavelength, "wavelength")
    length = abs(float(z.detach()))
    if length == 0:
        raise InputError("is zero, where the integral has no limit", where="distance", remedy="use angular_spectrum")
    critical = 2 * max(gap) * source.pitch / wavelength
    if length < critical * (1 - 1e-12):
        raise InputError(
            f"{source.pitch:.4g} m is too coarse: over {length:.4g} m the Fresnel kernel needs "
            f"{wavelength * length / (2 * max(gap)):.4g} m or copies of the output overlap",
            where="source.pitch",
            remedy=f"use a finer source, a smaller output, a distance of {critical:.4g} m at least or angular_spectrum",
        )
    k = 2 * math.pi / wavelength
    x, y, u, v = (a.to(field.device) for a in (source.x(), source.y(), output.x(), output.y()))
    transform = MatrixFourier(x, y, u, v, k / z, dtype)
    before = _outer(phasor(k / (2 * z) * y**2), phasor(k / (2 * z) * x**2)).to(dtype)
    after = _outer(phasor(k / (2 * z) * v**2), phasor(k / (2 * z) * u**2)).to(dtype)
    scale = (-1j * source.pitch**2 / (wavelength * z)).to(dtype)
    return scale * after * transform(field * before)


def angular_spectrum(
    field: torch.Tensor,
    source: Grid,
    wavelength: float,
    distance: float | torch.Tensor,
    output: Grid | None = None,
    *,
    dtype: torch.dtype = torch.complex128,
) -> torch.Tensor:
    """Exact scalar propagation: the spectrum of plane waves, each with its own phase, summed on `output`.

    Parameters
    ----------
    field, source, wavelength, distance, dtype
        As for `fresnel`.
    output
        Output grid; the source's own by default, which is the fastest.

    Returns
    -------
    torch.Tensor
        [..., rows, columns] of `output`, without the carrier exp(ikz).

    Raises
    ------
    InputError
        For a field that does not fit `source` or is not finite, and where padding against wrapped light takes more than
        8192 samples a side.

    Notes
    -----
    A plane wave of the frequency f shifts by z f/f_z, so light that starts on `source` and ends on `output` has a known
    band, and a padded width of twice their greatest separation holds it without aliasing (Matsushima and Shimobaba,
    Opt. Express 17, 19662 (2009)). Their band ends abruptly; here it falls off over 8 sqrt(λz) of shift beyond what is
    needed, which avoids ripple. A sampled band narrower than that is kept whole.

    Waves at grazing angles reach arbitrarily far, so no padding holds them: of light from structures as fine as a
    wavelength, on pitches below 0.7 of one, expect 1e-3 of the peak.

    Evanescent waves decay with |z|. Forwards that is physics; backwards it makes the result the adjoint of forward
    propagation instead of amplified rounding errors.
    """
    field = checked_field(field, source).to(dtype)
    z, target = checked_distance(distance, field.device), source if output is None else output
    _positive(wavelength, "wavelength")
    shift = abs(float(z.detach()))
    plan_x, plan_y = _padding(source, wavelength, shift, target)
    fx, fy = (
        torch.fft.fftfreq(n, source.pitch, dtype=torch.float64, device=field.device) for n in (plan_x[0], plan_y[0])
    )
    ky, kx = 2 * math.pi * fy[:, None], 2 * math.pi * fx[None, :]
    k, transverse = 2 * math.pi / wavelength, kx**2 + ky**2
    kz = (k**2 - transverse).abs().sqrt()
    propagating = transverse <= k**2
    relative = torch.where(propagating, -transverse / (kz + k), -k)
    transfer = phasor(relative * z) * torch.where(propagating, 1.0, torch.exp(-kz * z.abs()))
    safe = kz.clamp_min(1e-12 * k)
    band = _band_end(shift * kx.abs() / safe, *plan_x[1:]) * _band_end(shift * ky.abs() / safe, *plan_y[1:])
    spectrum = torch.fft.fft2(field, s=(plan_y[0], plan_x[0])) * (transfer * band).to(dtype)
    if output is None:
        return torch.fft.ifft2(spectrum)[..., : source.rows, : source.columns]
    # The FFT counts from the source's first sample; frequencies without light are skipped.
    keep_y, keep_x = ((band.amax(dim) > 0).nonzero()[:, 0] for dim in (1, 0))
    u, v = ((a - b[0]).to(field.device) for a, b in ((output.x(), source.x()), (output.y(), source.y())))
    transform = MatrixFourier(fx[keep_x], fy[keep_y], u, v, -2 * math.pi, dtype)
    return transform(spectrum[..., keep_y[:, None], keep_x]) / (plan_x[0] * plan_y[0])


def suitable_method(
    source: Grid, wavelength: float, distance: float, output: Grid | None = None
) -> Literal["fresnel", "angular_spectrum"]:
    """The method that suits these grids, `output` being by default the source's own.

    Returns
    -------
    str
        "fresnel" where the Fresnel kernel is sampled (Voelz and Roggemann, Appl. Opt. 48, 6132 (2009)) and the phase
        that it neglects, π D⁴/(4λz³) for the greatest separation D of two samples, is below 0.01 rad (Goodman, 3rd ed.,
        equation 4-18: sufficient, by far not necessary); else "angular_spectrum".
    """
    z, gap = abs(float(distance)), _farthest(source, source if output is None else output)
    sampled = z > 0 and 2 * max(gap) * source.pitch <= wavelength * z
    paraxial = sampled and math.pi * math.hypot(*gap) ** 4 <= PARAXIAL_PHASE * 4 * wavelength * z**3
    return "fresnel" if paraxial else "angular_spectrum"


def flux(
    field: torch.Tensor, grid: Grid, wavelength: float, carrier: tuple[float, float] | None = None
) -> torch.Tensor:
    """Power that crosses the field's plane, ∫ |U^(f)|² cos d²f, in W for a field whose |U|² is in W/m².

    The cosine is of each plane wave's angle to the normal. A tilt of the plane conserves this power, but not ∫ |U|².

    Raises
    ------
    InputError
        For a field that does not fit or is not finite.
    """
    field = checked_field(field, grid).to(torch.complex128)
    # Padded to twice the size: |U^|² is as wide as the field's autocorrelation, twice the window.
    shape = tuple(fast_length(2 * n) for n in grid.shape)
    c = (0.0, 0.0) if carrier is None else carrier
    sy, sx = (wavelength * torch.fft.fftfreq(n, grid.pitch, dtype=torch.float64, device=field.device) for n in shape)
    cosine = (1 - (sx[None, :] + c[0]) ** 2 - (sy[:, None] + c[1]) ** 2).clamp_min(0).sqrt()
    density = torch.fft.fft2(field, s=shape).abs().square() * cosine
    return density.sum((-2, -1)) * grid.pitch**2 / (shape[0] * shape[1])


def checked_field(field: torch.Tensor, grid: Grid) -> torch.Tensor:
    """The field itself; InputError when it does not fit the grid or holds a value that is not finite."""
    if field.ndim < 2 or tuple(field.shape[-2:]) != grid.shape:
        raise InputError(f"has the shape {list(field.shape)}, its grid {list(grid.shape)}", where="field")
    if not bool(torch.isfinite(field.detach()).all()):
        raise InputError("holds values that are not finite", where="field", remedy="look where they come from")
    return field


def checked_distance(distance: float | torch.Tensor, device: torch.device) -> torch.Tensor:
    """The distance as a 0-d float64 tensor that keeps its gradient; InputError when it is not one finite number."""
    z = torch.as_tensor(distance, dtype=torch.float64, device=device)
    if z.ndim or not math.isfinite(float(z.detach())):
        raise InputError(f"must be one finite number, is {distance}", where="distance")
    return z


def fast_length(length: int) -> int:
    """The smallest number of samples, `length` at least, with no prime factor above 5: quick to transform."""
    found: Any = next_fast_len(length, real=True)
    return int(found)


def _positive(value: float, where: str) -> None:
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"must be positive and finite, is {value}", where=where)


def _outer(rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    return rows[:, None] * columns[None, :]


def _farthest(source: Grid, output: Grid) -> tuple[float, float]:
    """Greatest separation of a source sample from an output sample, in metres, along x and along y."""
    across = (source.columns - 1) * source.pitch + (output.columns - 1) * output.pitch
    down = (source.rows - 1) * source.pitch + (output.rows - 1) * output.pitch
    return (
        across / 2 + abs(source.centre[0] - output.centre[0]),
        down / 2 + abs(source.centre[1] - output.centre[1]),
    )


def _padding(source: Grid, wavelength: float, z: float, output: Grid) -> list[tuple[int, float, float]]:
    """Padded samples along x and y, with the shifts in metres between which the band falls from one to zero."""
    nyquist = 1 / (2 * source.pitch)
    axial_squared = wavelength**-2 - 2 * nyquist**2
    # Largest shift within the sampled band; unbounded with grazing waves.
    most = z * nyquist / math.sqrt(axial_squared) if axial_squared > 0 else (math.inf if z > 0 else 0.0)
    plans: list[tuple[int, float, float]] = []
    for gap, count in zip(_farthest(source, output), (source.columns, source.rows), strict=True):
        cut = 2 * (gap + TAPER * math.sqrt(wavelength * z))
        whole = gap + most
        samples = max(count, math.ceil(min(cut, whole) / source.pitch) + 1)
        if samples > MAX_SIDE:
            raise InputError(
                f"{samples} samples of {source.pitch:.4g} m are needed to hold the light over {z:.4g} m, "
                f"more than {MAX_SIDE}",
                where="source",
                remedy="use fresnel, a coarser source, a smaller output or a shorter distance",
            )
        samples = fast_length(samples)
        start, end = gap, samples * source.pitch / 2
        plans.append((samples, math.inf, math.inf) if whole <= samples * source.pitch else (samples, start, end))
    return plans


def _band_end(shift: torch.Tensor, start: float, end: float) -> torch.Tensor:
    """One up to the shift `start`, zero from `end` on, and smooth between."""
    if math.isinf(start):
        return torch.ones((), dtype=shift.dtype, device=shift.device).expand(shift.shape)
    part = ((shift - start) / (end - start)).clamp(0, 1)
    # Four continuous derivatives at both ends: a steeper end causes longer ripple.
    return 1 - part**5 * (126 - 420 * part + 540 * part**2 - 315 * part**3 + 70 * part**4)
