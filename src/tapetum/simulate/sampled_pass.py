"""The double pass by sampling: into the spot, off any plane, back to the pupil, and on to the probe's pixels.

One engine for thin and traced lenses, each a `Pupil`; `RoundPass` is the fast path of thin lenses before mirrors and
gratings. With s the directions of the pupil's samples as seen from the spot, and v the place in the spot,

    G(v)  = 1/(iλ) ∫ A(s) exp(ikΨ(s)) exp(ik s·v) d²s                          the spot, about u0
    U3(s) = 1/(iλ) ∫ R(u0 + v) G(v) exp(ik vᵀCv) exp(ik (s + 2t)·v) d²v        what returns to the pupil
    U4(s) = A(s) exp(ikΨ(s)) U3(s)                                             and leaves the lens

Only departures from a point image are sampled: C is the curvature of a sphere about the pupil's middle, t a direction
that the pupil leaves out of s. A mirror takes s to -s, an order of direction τ to -s - τ; a mask is sampled itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch

from tapetum.optics.fourier import fast_sums, folded, phasor, real_times
from tapetum.optics.splines import read_between, undamped
from tapetum.simulate.pupils import Gazes, Leaving, Pupil
from tapetum.simulate.spot_window import SpotWindow
from tapetum.simulate.surfaces import Mask, Surface

__all__ = ["SampledPass"]

Lens = TypeVar("Lens", bound=Pupil)

# Samples a block of the kernels, and orders whose ramps are added at once.
_BLOCK, _ORDERS = 16, 64


class SampledPass(Generic[Lens]):
    """The retro-reflection of a lens off one plane, for any number of gazes.

    Kernels are computed once, and so is the spot where it is the same for all gazes.

    Parameters
    ----------
    pupil
        The lens, and the way from it to the probe's pixels.
    window
        The sensor's samples about the spot.
    plane
        What reflects.
    wavelength
        In metres.
    at_once
        Gazes computed together.
    dtype, device
        Of the fields.
    """

    def __init__(
        self,
        pupil: Lens,
        window: SpotWindow,
        plane: Surface | Mask,
        *,
        wavelength: float,
        at_once: int,
        dtype: torch.dtype = torch.complex64,
        device: torch.device | str = "cpu",
    ) -> None:
        self.pupil, self.plane, self.dtype, self.device = pupil, plane, dtype, torch.device(device)
        self._k, self._at_once = 2 * math.pi / wavelength, at_once
        # A mirror's samples may lie along the tilt, a mask's are its own columns and rows.
        self._own = isinstance(plane, Mask)
        self._v = window.places(self.device)
        self._meets = pupil.meets(window.flat)
        # One quarter of the window, which the others mirror.
        half = self._v[len(self._v) // 2 :]
        distance = torch.hypot(half[None, :], half[:, None])
        # A mask does not send the light of a rim back to that rim.
        seen = window.fade(distance) if self._own or pupil.rim is None else window.fade_with_rim(distance, pupil.rim)
        # What is computed once is computed in double precision.
        precise = torch.complex128 if pupil.fixed else dtype
        seen = (seen * (window.step / (1j * wavelength)) ** 2).to(precise)
        self._window = _unfolded(_unfolded(seen, -1, len(self._v)), -2, len(self._v))
        self._spot: torch.Tensor | None = None
        self._kernels: _Kernels | _Fast | None = None
        if pupil.fixed:
            at = pupil.gazes(torch.zeros(1, 2, dtype=torch.float64, device=self.device), self._own)
            self._spot = self._entered(at, precise).to(dtype)
            self._kernels = self._back(at.leaving())

    def __call__(
        self, sines: torch.Tensor, centres: torch.Tensor | None = None, roll: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Irradiance [B, H, W] on the probe's pixels, in W/m² for 1 W/m² at the target; arguments as for `field`."""
        return self._images(sines, centres, roll, squared=True)

    def field(
        self, sines: torch.Tensor, centres: torch.Tensor | None = None, roll: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Complex amplitude on the probe's pixels for 1 W/m² at the target, [B, H, W], in W^½/m.

        `sines` [B, 2] are those of the tilt along x and y; `centres` [B, 2] place the RR's own centre on the probe's
        sensor, in metres, by default in the middle. `roll` [B] turns the target about its optical axis, in radians
        from x to y, for pupils that take one (`Pupil.gazes`).
        """
        return self._images(sines, centres, roll, squared=False)

    def exit_pupil(self, sines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Field that leaves the lens, tilt removed, [B, m, n], at columns x [B or 1, n] and rows y [B or 1, m].

        As the pupil passes it on: per unit area, or times its samples' weights and all constants (`ThinPupil`).
        """
        return self._left(self.pupil.gazes(sines.to(self.device, torch.float64), self._own))

    def _images(
        self, sines: torch.Tensor, centres: torch.Tensor | None, roll: torch.Tensor | None, *, squared: bool
    ) -> torch.Tensor:
        sines = sines.to(self.device, torch.float64)
        if centres is not None:
            centres = centres.to(self.device, torch.float64)
        if roll is not None:
            roll = roll.to(self.device, torch.float64)
        # Most gazes of a phone return nothing: they are not computed.
        lit = self.pupil.returns(sines).nonzero()[:, 0]
        dtype = self.dtype.to_real() if squared else self.dtype
        images = torch.zeros(len(sines), *self.pupil.path.shape, dtype=dtype, device=self.device)
        apart = self.pupil.foreshortens(sines)[lit]
        # Two groups, so that an image is the same whichever gazes are drawn with it.
        for group in (lit[apart], lit[~apart]):
            for i in range(0, len(group), self._at_once):
                some = group[i : i + self._at_once]
                at = self.pupil.gazes(sines[some], self._own, None if roll is None else roll[some])
                moved = None if centres is None else centres[some]
                images[some] = at.to_probe(*self._left(at), moved, squared=squared)
        return images

    def _left(self, at: Gazes) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        leaving = at.leaving()
        spot = self._entered(at, self.dtype, leaving.mirrored) if self._spot is None else self._spot
        kernels = self._kernels or self._back(leaving)
        back = kernels(self._reflected(spot, at, leaving.mirrored))
        if leaving.read_at is not None:
            back = read_between(back, *leaving.read_at)
        return back * leaving.wave, leaving.x, leaving.y

    def _entered(self, at: Gazes, dtype: torch.dtype, halved: bool = False) -> torch.Tensor:
        """The spot's light [B or 1, n, n] times both ways' curvature and the window; `halved`: columns from 0 on."""
        light, v, bend = at.entering(), self._v, at.bend[:, None]
        strength = light.strength.to(dtype if light.strength.is_complex() else dtype.to_real())
        wave = strength * phasor(self._k * light.path, dtype)
        # Light that is mirrored is so in the spot too, and other light has its waves in pairs there.
        half = v[len(v) // 2 :]
        on_columns, on_rows = (half if mirrored else v for mirrored in light.mirrored)
        spot = self._spread(light.rows, wave, half, light.mirrored[1])
        spot = spot * phasor(self._k * on_rows**2 * bend, dtype)[..., None]
        spot = self._spread(light.columns, spot.mT, half, light.mirrored[0]).mT
        spot = spot * phasor(self._k * on_columns**2 * bend, dtype)[:, None, :]
        if light.mirrored[1]:
            spot = _unfolded(spot, -2, len(v))
        if light.mirrored[0] and not halved:
            spot = _unfolded(spot, -1, len(v))
        return spot * self._window[:, -spot.shape[-1] :]

    def _spread(self, places: torch.Tensor, wave: torch.Tensor, half: torch.Tensor, mirrored: bool) -> torch.Tensor:
        """Waves [B, m, x] of places [B, m] at all v, [B, n, x]; those that are `mirrored` at `half`, from 0 on."""
        kernel = self._kernel(half, places, wave.dtype)
        if mirrored:
            return real_times(2 * kernel.real, wave)
        even, odd = real_times(torch.stack([kernel.real, kernel.imag], 1), wave[:, None]).unbind(1)
        upper, lower = torch.add(even, odd, alpha=1j), torch.sub(even, odd, alpha=1j)
        return torch.cat([lower.flip(1)[:, : len(self._v) - len(half)], upper], 1)

    def _back(self, leaving: Leaving) -> _Kernels | _Fast:
        """From the plane to the directions in which the returning light is wanted."""
        if leaving.length is not None:
            return self._fast(leaving, leaving.length)
        v, real = self._v, self.dtype.to_real()
        half = v[: (len(v) + 1) // 2]

        def weights(places: torch.Tensor, v: torch.Tensor, in_middle: float, beside: float) -> torch.Tensor:
            weight = torch.where(v == 0, in_middle, beside)
            return (weight * self._undamped(places, v) if leaving.read_at else weight[None]).to(real)

        def pairs(places: torch.Tensor) -> torch.Tensor:
            kernel = self._kernel(half, places, self.dtype).mT
            # A sample in the middle is its own partner.
            both = torch.stack([kernel.real, kernel.imag], 1)
            return both * weights(places, half, 0.5, 1.0)[:, None, None]

        down = pairs(leaving.rows)
        if leaving.mirrored:
            v = v[len(v) // 2 :]
            # Both sides; the middle column is but one.
            both = weights(leaving.columns, v, 1.0, 2.0)
            right = (both[..., None] * self._kernel(v, leaving.columns, self.dtype).real).mT
        else:
            right = pairs(leaving.columns)
        return _Kernels(down, right)

    def _undamped(self, places: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        """What light at v is multiplied with before it is read between equally spaced directions [B, n], [B, v]."""
        return undamped(self._k * (places[:, 1:2] - places[:, :1]) * v)

    def _fast(self, leaving: Leaving, length: int) -> _Fast:
        # k s_m v_j of s_m = s_0 + m λ/(NΔ), v_j = (j - (n - 1)/2) Δ: a ramp of s_0, the transform's own mj/N, and the
        # phase of the samples' middle.
        def parts(places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            number = torch.arange(places.shape[-1], dtype=torch.float64, device=self.device)
            phase = -math.pi * (len(self._v) - 1) / length * number
            ramp = phasor(self._k * places[:, :1] * self._v, self.dtype)
            return ramp * self._undamped(places, self._v).to(ramp.real), phasor(phase[None], self.dtype)

        return _Fast(length, len(self._v), parts(leaving.columns), parts(leaving.rows))

    def _reflected(self, spot: torch.Tensor, at: Gazes, half: bool) -> torch.Tensor:
        """The spot's light off the plane: times a mask, or phases that change slowly for each order of a surface."""
        if isinstance(self.plane, Mask):
            places = at.place[:, :, None] + self._v
            spot = spot * self._ramps(2 * at.turn[:, None], torch.ones_like(at.turn[:, :1]))
            return spot * self.plane.reflectance(places[:, 0], places[:, 1]).to(self.dtype)
        amplitudes, directions = self._orders(at)
        if half:
            # The ramps of a mirror that returns half a spot are 1.
            return spot * amplitudes.sum(-1)[:, None, None].to(self.dtype)
        total = torch.zeros(1, 1, 1, dtype=self.dtype, device=self.device)
        for i in range(0, amplitudes.shape[-1], _ORDERS):
            total = total + self._turned(at, directions[:, i : i + _ORDERS], amplitudes[:, i : i + _ORDERS])
        return spot * total

    def _turned(self, at: Gazes, directions: torch.Tensor, amplitudes: torch.Tensor) -> torch.Tensor:
        """What orders turn the spot's light by [B, n, n], of directions [B, M, 2] and amplitudes [B, M]."""
        return self._ramps(directions, amplitudes)

    def _orders(self, at: Gazes) -> tuple[torch.Tensor, torch.Tensor]:
        """Amplitudes [B, M] of a surface's orders, and directions [B, M, 2] against which they return; at the spot."""
        assert isinstance(self.plane, Surface)
        given: dict[str, Any] = {"dtype": torch.float64, "device": self.device}
        tau = torch.tensor([order.direction for order in self.plane.orders], **given).reshape(-1, 2)
        tau = tau - 2 * torch.tensor(self.plane.tilt, **given)
        directions = tau @ at.axes.mT + 2 * at.turn[:, None]
        amplitudes = phasor(self._k * (at.place @ tau.mT))
        if own := [order.at(at.place) for order in self.plane.orders]:
            precise: dict[str, Any] = {"dtype": torch.complex128, "device": self.device}
            amplitudes = amplitudes * torch.stack(
                [torch.as_tensor(a, **precise).expand(len(amplitudes)) for a in own], -1
            )
        if math.isfinite(self._meets):
            # Light that misses the pupil altogether would only return as an alias.
            apart = torch.hypot(*(directions + 2 * at.middle[:, None]).unbind(-1))
            meets = apart < self._meets
            some = meets.any(0)
            directions = torch.where(meets[..., None], directions, 0.0)[:, some]
            amplitudes = (amplitudes * meets)[:, some]
        return amplitudes, directions

    def _ramps(self, directions: torch.Tensor, amplitudes: torch.Tensor) -> torch.Tensor:
        """Sums [B, n, n] of amplitudes [B, M] times exp(ik direction·v), of directions [B, M, 2]."""
        turn = self._k * directions[..., None] * self._v
        columns, rows = phasor(turn[:, :, 0], self.dtype), phasor(turn[:, :, 1], self.dtype)
        if amplitudes.shape[-1] == 1:
            return (rows * amplitudes[..., None].to(self.dtype)).mT * columns
        return (rows * amplitudes[..., None].to(self.dtype)).mT @ columns

    def _kernel(self, v: torch.Tensor, columns: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
        """exp(ik v·column), [B or 1, v, columns], for equally spaced v."""
        # Products of few phasors: of each block's first v, and of the steps within a block.
        coarse, fine = v[::_BLOCK], v[:_BLOCK] - v[0]
        first = phasor(self._k * coarse[:, None] * columns[:, None, :], dtype)
        steps = phasor(self._k * fine[:, None] * columns[:, None, :], dtype)
        return (first[:, :, None] * steps[:, None]).flatten(1, 2)[:, : len(v)]


def _unfolded(half: torch.Tensor, dim: int, count: int) -> torch.Tensor:
    """The whole of `count` samples of a mirrored half, from the middle outwards."""
    other = half.flip(dim).narrow(dim, 0, count - half.shape[dim])
    return torch.cat([other, half], dim)


@dataclass(frozen=True)
class _Kernels:
    """Real kernels of both products: of pairs of rows, and of pairs of columns or of the columns from 0 on.

    `down` [B, 2, y, n/2] are cosines and sines, `right` [B, 2, x, n/2] too or cosines [B, x, n/2].
    """

    down: torch.Tensor
    right: torch.Tensor

    def __call__(self, spot: torch.Tensor) -> torch.Tensor:
        """From the plane [B, n, n or n/2] to the directions [B, y, x]."""
        back = _gathered(self.down, spot).mT
        back = real_times(self.right, back) if self.right.dim() == 3 else _gathered(self.right, back)
        return back.mT


@dataclass(frozen=True)
class _Fast:
    """The same products as fast transforms of `length` samples, where directions are steps of them.

    `columns` and `rows` are ramps of the spot's `count` samples [B, n], and factors of the directions [B, x] and [B,
    y].
    """

    length: int
    count: int
    columns: tuple[torch.Tensor, torch.Tensor]
    rows: tuple[torch.Tensor, torch.Tensor]

    def __call__(self, spot: torch.Tensor) -> torch.Tensor:
        """From the plane [B, n, n or n/2] to the directions [B, y, x]."""
        (ramp, factor), (across, factors) = self.rows, self.columns
        back = fast_sums(spot, self.length, factor.shape[-1], -2, 1, before=ramp, after=factor)
        if back.shape[-1] < self.count:
            back = _unfolded(back, -1, self.count)
        return fast_sums(back, self.length, factors.shape[-1], -1, 1, before=across, after=factors)


def _gathered(kernel: torch.Tensor, field: torch.Tensor) -> torch.Tensor:
    """From samples [B, n, x] to directions [B, y, x] by cosines and sines [B, 2, y, n/2] of pairs."""
    even, odd = real_times(kernel, folded(field)).unbind(1)
    return torch.add(even, odd, alpha=1j)
