"""The laser's spot in a frame, fitted with the streak that it draws while the shutter is open.

A round Gaussian fitted to a streak is some hundredths of a pixel off, and leaves so much of it that its residual no
longer shows what else moves the spot: the wall behind it, a ghost, noise. A Gaussian along a short line leaves just
that, so the ratio of its height to its residual says how well the place is known, for slow and fast spots alike. What
neighbouring pixels leave alike is no noise but edges under the spot, which draw it to one side in every frame.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d

__all__ = ["HALF", "Streaks", "patch_of", "sharpened", "unsaturated"]

Array = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]

HALF = 12
"""px, half side of the patches: the streak of a spot that crosses a field of 1000 px in a second has 10 px in 10 ms."""
_REACH = 3.0  # the fit sees this many of the spot's own sigma about the streak
_STEPS, _MORE = 8, 4
_MOVED = 3.0  # px, farther from where the round fit found it the spot is another one
_SIGMA = (0.5, 4.0)  # px
_LONGEST = 16.0  # px
_NODES, _WEIGHTS = ((part / 2).astype(np.float32)[:, None] for part in np.polynomial.legendre.leggauss(7))
_Y, _X = (axis.ravel().astype(np.float32) for axis in np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1])


def patch_of(image: npt.NDArray[np.generic], x: float, y: float) -> Single:
    """Return the patch of an image about a place (px), [2 HALF + 1, 2 HALF + 1]; what lies outside is NaN."""
    side = 2 * HALF + 1
    left, top = round(x) - HALF, round(y) - HALF
    patch = np.full((side, side), np.nan, np.float32)
    rows, columns = (slice(max(0, at), min(size, at + side)) for at, size in zip((top, left), image.shape, strict=True))
    if rows.start < rows.stop and columns.start < columns.stop:
        patch[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = image[rows, columns]
    return patch


def unsaturated(patches: Single, full_scale: Array) -> Single:
    """Return patches [N, S, S] with NaN for pixels that are saturated, at [N] digital numbers."""
    return np.where(patches < 0.998 * full_scale[:, None, None], patches, np.float32(np.nan)).astype(np.float32)


@dataclass(frozen=True)
class Streaks:
    """Fits of a streak to the spots of N patches.

    Attributes
    ----------
    places
        [N, 2] px of the image; where a fit does not hold, the given ones.
    noise, shared
        The residual's RMS [N] over the spot's height, and that of the residual's means over 3 x 3 pixels [N], NaN where
        there are none.
    holds
        [N], whether the fit holds.
    state
        [N, 5]: places from the middle of the patch (px), the logarithm of the spot's sigma (px), and how far the streak
        goes along x and y (px).
    heights
        [N] digital numbers.
    """

    places: Array
    noise: Array
    shared: Array
    holds: npt.NDArray[np.bool_]
    state: Single
    heights: Array

    @property
    def near(self) -> Array:
        """Places [N, 2] from the middle of the patch, in pixels."""
        return self.state[:, :2].astype(np.float64)

    def away(self) -> Single:
        """Return distances [N, P] of a patch's pixels from the streaks, in sigmas, in patches moved onto the spots."""
        away = np.sqrt(_from_line(_centred(self.state))) / np.exp(self.state[:, 2:3])
        return away.astype(np.float32)

    @property
    def excess(self) -> Array:
        """How much more [N] the variance of the means over nine pixels is than white noise leaves, over the squared
        height: negative by chance, and 0 where saturation leaves no nine pixels side by side."""
        return np.where(np.isfinite(self.shared), self.shared**2 - (self.noise / 3) ** 2, 0.0)

    def bells(self) -> Single:
        """Return the spots' light [N, P] without what is behind it, in digital numbers."""
        return _streaks(self.state) * self.heights[:, None].astype(np.float32)

    def pulls(self, usable: npt.NDArray[np.bool_]) -> Single:
        """Return how far a digital number more in each pixel moves the places along x and y, [N, 2, P] px; 0 for pixels
        that are not usable [N, P]."""
        weight = (usable & (_from_line(self.state) <= (_REACH * np.exp(self.state[:, 2:3])) ** 2)).astype(np.float32)
        rows = _rows(self.state, self.heights[:, None].astype(np.float32)) * weight[:, None]
        return np.linalg.solve(_normal(rows), rows.astype(np.float64))[:, :2].astype(np.float32)

    def of(self, frames: npt.NDArray[np.int64]) -> Streaks:
        """Return the fits to some of the patches."""
        return Streaks(**{field.name: getattr(self, field.name)[frames] for field in fields(self)})


def sharpened(
    patches: Single, places: Array, sigmas: Array, full_scale: Array, begin: Streaks | None = None
) -> Streaks:
    """Fit a streak to each spot of a batch.

    Parameters
    ----------
    patches
        [N, S, S] about the pixels nearest to the places, in digital numbers, as `patch_of` cuts them; NaN pixels are
        left out.
    places, sigmas
        [N, 2] and [N] px of round fits.
    full_scale
        [N] digital numbers of saturation.
    begin
        Earlier fits of the same spots, to go on from.
    """
    near = places - np.rint(places)
    data = patches.reshape(len(patches), -1)
    usable = np.isfinite(data)
    data = np.where(usable, data, 0).astype(np.float32)
    state, steps = _begin(data, usable, near, sigmas), _STEPS
    if begin is not None:
        state, steps = np.where(begin.holds[:, None], begin.state, state), _MORE
    linear, left, weight = _linear(data, usable, state)
    for _ in range(steps):
        _step(state, linear, left, weight)
        linear, left, weight = _linear(data, usable, state)
    count = weight.sum(axis=1)
    rms = np.sqrt((left**2).sum(axis=1) / np.maximum(count - 9, 3))
    found = state[:, :2].astype(np.float64)
    inside = (state[:, 2] > np.log(_SIGMA[0])) & (state[:, 2] < np.log(_SIGMA[1])) & (count > 18)
    holds = np.isfinite(found).all(axis=1) & (np.abs(found - near).max(axis=1) < _MOVED) & (linear[:, 0] > 0) & inside
    height = np.maximum(linear[:, 0], 1e-6)
    noise = np.maximum(rms, 1e-3 * full_scale / 255) / height
    means, whole = (_of_nine(one.reshape(-1, 2 * HALF + 1, 2 * HALF + 1)) for one in (left, weight))
    whole = whole > 1 - 1e-3
    count = np.where(whole.any(axis=(1, 2)), whole.sum(axis=(1, 2)), np.nan)
    shared = np.sqrt((np.where(whole, means, 0) ** 2).sum(axis=(1, 2)) / count) / height
    at = np.rint(places) + np.where(holds[:, None], found, near)
    return Streaks(at, noise.astype(np.float64), shared, holds, state, height.astype(np.float64))


def _of_nine(pictures: Single) -> Single:
    """Return the means over 3 x 3 pixels of pictures [N, S, S]."""
    across = uniform_filter1d(pictures, 3, axis=2, mode="constant")
    return uniform_filter1d(across, 3, axis=1, mode="constant").astype(np.float32)


def _begin(data: Single, usable: npt.NDArray[np.bool_], near: Array, sigmas: Array) -> Single:
    """Return first states [N, 5]: x, y, log sigma, and the streak's x and y, from the light's second moments."""
    dx, dy = _X - near[:, :1], _Y - near[:, 1:]
    close = usable & (dx**2 + dy**2 <= (_REACH * np.clip(sigmas, *_SIGMA)[:, None] + 1) ** 2)
    base = np.array([np.median(one[there]) if there.any() else 0.0 for one, there in zip(data, usable, strict=True)])
    above = np.where(close, data - base[:, None], 0)
    light = np.maximum(above - 0.15 * above.max(axis=1, keepdims=True), 0)
    light /= np.maximum(light.sum(axis=1, keepdims=True), 1e-9)
    xx, xy, yy = ((light * one).sum(axis=1) for one in (dx * dx, dx * dy, dy * dy))
    longer = np.hypot((xx - yy) / 2, xy)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    # A line of length L has the variance L^2 / 12 along itself.
    length = np.clip(np.sqrt(12 * np.maximum(2 * longer, 0.02)), 0, 0.8 * _LONGEST)
    thin = np.sqrt(np.clip((xx + yy) / 2 - longer, 0.8, 6.0))
    streak = length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.column_stack([near, np.log(np.clip(thin, *_SIGMA)), streak]).astype(np.float32)


def _lines(state: Single) -> tuple[Single, Single, Single, Single]:
    """Return, for every node of the streaks, distances along x and along y [N, K, S] (px), and the bells along both,
    whose products are the node's bell."""
    x, y, size, along, across = (one[:, None, None] for one in state.T)
    middle = np.arange(-HALF, HALF + 1, dtype=np.float32)
    dx, dy = middle - x - _NODES * along, middle - y - _NODES * across
    half = (-0.5 * np.exp(-2 * size)).astype(np.float32)
    bell_x, bell_y = (np.exp(half * one * one).astype(np.float32) for one in (dx, dy))
    return dx, dy, bell_x, bell_y


def _product(across: npt.NDArray[np.floating], down: npt.NDArray[np.floating]) -> Single:
    """Return sums over nodes [N, P] of the products of what stands along x and along y, [N, K, S] each."""
    return (down.swapaxes(1, 2) @ across).reshape(len(down), -1).astype(np.float32, copy=False)


def _streaks(state: Single) -> Single:
    """Return the streaks [N, P]."""
    _, _, bell_x, bell_y = _lines(state)
    return _product(_WEIGHTS * bell_x, bell_y)


def _slopes(state: Single) -> list[Single]:
    """Return the streaks' derivatives [N, P] by the five numbers of the state."""
    dx, dy, bell_x, bell_y = _lines(state)
    bell_x *= _WEIGHTS * np.exp(-2 * state[:, 2, None, None])
    slope_x, slope_y = dx * bell_x, dy * bell_y
    size = _product(dx * slope_x, bell_y) + _product(bell_x, dy * slope_y)
    by_x, by_y = _product(slope_x, bell_y), _product(bell_x, slope_y)
    return [by_x, by_y, size, _product(_NODES * slope_x, bell_y), _product(_NODES * bell_x, slope_y)]


def _centred(state: Single) -> Single:
    """Return states [N, 5] of spots in the middle of their patches."""
    return np.column_stack([np.zeros((len(state), 2), np.float32), state[:, 2:]])


def _from_line(state: Single) -> Single:
    """Return the squared distances [N, P] of the pixels from the streaks, in pixels."""
    along, across = (one[:, None] for one in state.T[3:])
    dx, dy = _X - state[:, :1], _Y - state[:, 1:2]
    part = np.clip((dx * along + dy * across) / np.maximum(along**2 + across**2, 1e-9), -0.5, 0.5)
    return (dx - part * along) ** 2 + (dy - part * across) ** 2


def _linear(data: Single, usable: npt.NDArray[np.bool_], state: Single) -> tuple[Single, Single, Single]:
    """Return the best height and background (level, slopes) [N, 4], what they leave, and the weights, [N, P] each."""
    weight = (usable & (_from_line(state) <= (_REACH * np.exp(state[:, 2:3])) ** 2)).astype(np.float32)
    flat = np.ones_like(data)
    basis = np.stack([_streaks(state), flat, _X * flat, _Y * flat], axis=1) * weight[:, None]
    normal = (basis @ basis.swapaxes(1, 2)).astype(np.float64) + 1e-6 * np.eye(4)
    shown = (basis @ data[..., None]).astype(np.float64)
    found = np.linalg.solve(normal, shown)[..., 0].astype(np.float32)
    left = (data - (found[:, None] @ basis)[:, 0]) * weight
    return found, left.astype(np.float32), weight


def _rows(state: Single, heights: Single) -> Single:
    """Return the derivatives [N, 9, P] of the pictures by the state, the height, and the background's level and
    slopes."""
    streaks = _streaks(state)
    flat = np.ones_like(streaks)
    return np.stack([*(heights * one for one in _slopes(state)), streaks, flat, _X * flat, _Y * flat], axis=1)


def _normal(rows: Single) -> Array:
    """Return the damped normal matrices [N, 9, 9] of derivatives [N, 9, P]."""
    normal = (rows @ rows.swapaxes(1, 2)).astype(np.float64)
    diagonal = np.einsum("kii->ki", normal)
    # A streak of no length has no direction.
    diagonal[:, 3:5] += 1.0
    diagonal += 1e-3 * diagonal + 1e-6
    return normal


def _step(state: Single, linear: Single, left: Single, weight: Single) -> None:
    """Move the states by one damped Gauss-Newton step of all nine numbers."""
    rows = _rows(state, linear[:, :1]) * weight[:, None]
    step = np.linalg.solve(_normal(rows), (rows @ left[..., None]).astype(np.float64))[:, :5, 0]
    state += np.clip(step, [-1, -1, -0.3, -2, -2], [1, 1, 0.3, 2, 2]).astype(np.float32)
    state[:, :2] = np.clip(state[:, :2], -HALF / 2, HALF / 2)
    state[:, 2] = np.clip(state[:, 2], *np.log(_SIGMA))
    state[:, 3:] = np.clip(state[:, 3:], -_LONGEST, _LONGEST)
