"""Small bright spots of an image, located to sub-pixel accuracy, with the odds that each is a laser.

Candidates are the points where the smoothed image curves down in every direction. Each is compared with a Gaussian by
linear least squares. The best are fitted with a Gaussian on a sloping background, without saturated pixels, and a
logistic regression on the fit's results gives the odds.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tapetum.errors import InputError

__all__ = ["Candidates", "find_candidates"]

SCALE = 1.0  # px, smoothing under which small blobs are looked for
HALVED_SCALES = (1.0, 1.8)  # px of the halved picture, for larger ones and flat saturated ones
WIDTHS = (0.9, 1.3, 1.9, 2.8)  # px, Gaussians that candidates are compared with
SCREEN = 6  # px, half side of the patch they are compared on
PATCH = 9  # px, half side of the patch they are fitted on
KEPT_EACH, KEPT, APART = 120, 12, 4.0
REACH = 3.0  # the fit sees this many of the spot's own sigma: a ghost some 10 px away stays outside
STEPS = 8

# Logistic regression of `features` on synthetic scenes, by tests/record/calibrate_spot.py: log of amplitude over
# residual, log sigma and its square, log of amplitude over the scene's range, height relative to the brightest pixel,
# strength over that of others.
WEIGHTS = np.array([2.72, 4.26, -4.07, 0.95, 9.19, 0.82])
BIAS = -17.6


@dataclass(frozen=True, eq=False)
class Candidates:
    """Possible lasers, most likely first: [K] each, as of a `spot.Spot`; `odds` is the log-odds of being the laser."""

    x: np.ndarray
    y: np.ndarray
    odds: np.ndarray
    peak: np.ndarray
    snr: np.ndarray
    sigma: np.ndarray

    def __len__(self) -> int:
        return len(self.x)

    @property
    def quality(self) -> np.ndarray:
        """Probability of being the laser, [K]."""
        return 1 / (1 + np.exp(-self.odds))


def _templates() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return basis [P, 6] (Gaussian, its slopes, a plane), pseudo-inverse [6, P] and mask [P] of each of WIDTHS."""
    y, x = (axis.ravel().astype(float) for axis in np.mgrid[-SCREEN : SCREEN + 1, -SCREEN : SCREEN + 1])
    r2 = x * x + y * y
    out = []
    for sigma in WIDTHS:
        mask = (r2 <= np.clip(3 * sigma, 3.5, SCREEN + 0.5) ** 2).astype(float)
        bell = np.exp(-r2 / (2 * sigma**2))
        basis = np.stack([bell, bell * x, bell * y, np.ones_like(x), x, y], axis=1) * mask[:, None]
        out.append(tuple(part.astype(np.float32) for part in (basis, np.linalg.pinv(basis), mask)))
    return out


TEMPLATES = _templates()
FIT_Y, FIT_X = (axis.ravel().astype(np.float32) for axis in np.mgrid[-PATCH : PATCH + 1, -PATCH : PATCH + 1])


def bumps(smooth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y ([K] int) of the points of a smoothed image that curve down most in every direction."""
    bend = cv2.Laplacian(smooth, cv2.CV_32F, scale=-1.0)
    highest = cv2.compare(bend, cv2.dilate(bend, np.ones((5, 5), np.uint8)), cv2.CMP_GE)
    upward = cv2.compare(bend, 0, cv2.CMP_GT)  # type: ignore[call-overload]
    y, x = np.divmod(np.flatnonzero(cv2.bitwise_and(highest, upward).view(bool)), smooth.shape[1])
    # Mirrored as in the Laplacian, because a spot may lie half outside the image.
    wide = cv2.copyMakeBorder(smooth, 1, 1, 1, 1, cv2.BORDER_REFLECT_101)
    up, row, down, left, column, right = y, y + 1, y + 2, x, x + 1, x + 2
    middle = 2 * wide[row, column]
    along = middle - wide[row, left] - wide[row, right]
    across = middle - wide[up, column] - wide[down, column]
    mixed = (wide[down, right] + wide[up, left] - wide[up, right] - wide[down, left]) / 4
    # The smallest curvature of all directions, which is about zero for edges and lines.
    least = (along + across) / 2 - np.hypot((along - across) / 2, mixed)
    best = np.argpartition(least, -KEPT_EACH)[-KEPT_EACH:] if len(least) > KEPT_EACH else np.arange(len(least))
    return x[best], y[best]


def blobs(field: np.ndarray, smooth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y ([K] int) of possible spots, small (in `smooth`) or larger (in a halved image)."""
    height, width = field.shape
    found = [bumps(smooth)]
    half = cv2.resize(field, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    for scale in HALVED_SCALES:
        x, y = bumps(cv2.GaussianBlur(half, (0, 0), scale))
        found.append((x * 2 + 1, y * 2 + 1))
    place = np.concatenate([y * width + x for x, y in found])
    y, x = np.divmod(np.unique(place), width)
    return x, y


def screen(field: np.ndarray, saturated: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the indices of the KEPT candidates most like a bright Gaussian, none closer than APART."""
    side = 2 * SCREEN + 1
    padded = cv2.copyMakeBorder(field, SCREEN, SCREEN, SCREEN, SCREEN, cv2.BORDER_REPLICATE)
    patches = np.lib.stride_tricks.sliding_window_view(padded, (side, side))[y, x].reshape(len(x), -1)
    patches = patches - patches.mean(axis=1, keepdims=True)
    score = np.full(len(x), -np.inf)
    for basis, inverse, mask in TEMPLATES:
        found = patches @ inverse.T
        left = ((patches * mask - found @ basis.T) ** 2).sum(axis=1) / (mask.sum() - basis.shape[1])
        height = np.maximum(found[:, 0], 0)
        score = np.maximum(score, height**1.5 / np.sqrt(left + 1))
    # A saturated spot is not Gaussian; only the fit, which ignores the flat part, can rate it.
    score = np.where(saturated[y, x], np.inf, score)
    kept: list[int] = []
    for index in np.argsort(-score, kind="stable"):
        apart = all((x[index] - x[other]) ** 2 + (y[index] - y[other]) ** 2 > APART**2 for other in kept)
        if apart:
            kept.append(int(index))
        if len(kept) == KEPT:
            break
    return np.array(kept, int)


def fit(field: np.ndarray, saturated: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a Gaussian on a sloping background to each candidate (damped Gauss–Newton, all at once).

    Returns [K, 4] amplitude, x and y in the picture and sigma, and [K] the rms of what the fit leaves.
    """
    side = 2 * PATCH + 1

    def patches(image: np.ndarray, border: int) -> np.ndarray:
        padded = cv2.copyMakeBorder(image, PATCH, PATCH, PATCH, PATCH, border, value=[0])
        return np.lib.stride_tricks.sliding_window_view(padded, (side, side))[y, x].reshape(len(x), -1)

    seen = patches(np.ones(field.shape, np.uint8), cv2.BORDER_CONSTANT) > 0
    flat = patches(saturated.astype(np.uint8), cv2.BORDER_CONSTANT) > 0
    usable = (seen & ~flat).astype(np.float32)
    data = patches(field, cv2.BORDER_REPLICATE)
    base = np.median(data[:, ::2], axis=1)
    # Around a saturated top the first guess must be wide enough to reach the flanks.
    core = np.hypot(FIT_X, FIT_Y) <= PATCH - 1
    guess = np.clip(0.8 * np.sqrt((flat & core).sum(axis=1) / np.pi), 1.5, 4.0)
    state = np.zeros((len(x), 7), np.float32)  # amplitude, dx, dy, log sigma, background, its slopes
    state[:, 0] = np.maximum(data.max(axis=1) - base, 1)
    state[:, 3], state[:, 4] = np.log(guess), base
    jacobian = np.empty((len(x), 7, len(FIT_X)), np.float32)
    left = weight = usable
    for _ in range(STEPS):
        sigma, dx, dy = np.exp(state[:, 3:4]), FIT_X - state[:, 1:2], FIT_Y - state[:, 2:3]
        r2 = dx * dx + dy * dy
        bell = np.exp(-r2 / (2 * sigma**2))
        weight = usable * (r2 <= np.clip(REACH * sigma, 3.5, PATCH) ** 2)
        left = data - state[:, :1] * bell - state[:, 4:5] - state[:, 5:6] * FIT_X - state[:, 6:] * FIT_Y
        left = left * weight
        bell = bell * weight
        hill = state[:, :1] * bell / sigma**2
        for row, part in enumerate((bell, hill * dx, hill * dy, hill * r2, weight, weight * FIT_X, weight * FIT_Y)):
            jacobian[:, row] = part
        normal = (jacobian @ jacobian.swapaxes(1, 2)).astype(np.float64)
        diagonal = np.einsum("kii->ki", normal)
        diagonal += 1e-3 * diagonal + 1e-6
        step = np.linalg.solve(normal, (jacobian @ left[..., None]).astype(np.float64))[..., 0]
        step[:, 1:4] = np.clip(step[:, 1:4], [-1, -1, -0.4], [1, 1, 0.4])
        state += step
        state[:, 0] = np.clip(state[:, 0], 1e-3, 1e5)
        state[:, 1:3] = np.clip(state[:, 1:3], -APART, APART)
        state[:, 3] = np.clip(state[:, 3], np.log(0.4), np.log(6.0))
    rms = np.sqrt((left**2).sum(axis=1) / np.maximum(weight.sum(axis=1) - 7, 3))
    found = np.stack([state[:, 0], x + state[:, 1], y + state[:, 2], np.exp(state[:, 3])], axis=1)
    return found, rms


def features(field: np.ndarray, smooth: np.ndarray, found: np.ndarray, rms: np.ndarray) -> np.ndarray:
    """Return the features [K, 6] that distinguish a laser from the scene, in the order of WEIGHTS."""
    height, width = field.shape
    x = np.clip(np.rint(found[:, 1]), 0, width - 1).astype(int)
    y = np.clip(np.rint(found[:, 2]), 0, height - 1).astype(int)
    low, middle, high = np.percentile(field[::8, ::8], [1, 50, 99])
    amplitude, sigma = np.maximum(found[:, 0], 1), found[:, 3]
    contrast = np.log(amplitude / np.sqrt(rms**2 + 1))
    # Strength relative to the third strongest other candidate, as a laser may have ghosts.
    strength = np.log(amplitude) + contrast - 4 * (np.log(sigma) - np.log(1.5)) ** 2
    ranked = np.sort(np.where(np.eye(len(found), dtype=bool), -np.inf, strength), axis=1)[:, ::-1]
    rival = np.maximum(ranked[:, 2], 0) if len(found) > 3 else np.zeros(len(found))
    over_range = np.log(np.clip(amplitude / max(high - low, 1), 0.01, 10))
    height = (smooth[y, x] - middle) / (smooth.max() - middle + 1)
    return np.stack([contrast, np.log(sigma), np.log(sigma) ** 2, over_range, height, strength - rival], axis=1)


def saturation(image: np.ndarray, full_scale: float | None) -> float:
    """Return the digital number at which an image saturates: the given one, its type's largest, of floats its own."""
    if full_scale is not None:
        return float(full_scale)
    whole = np.issubdtype(image.dtype, np.integer)
    return float(np.iinfo(image.dtype).max) if whole else max(float(image.max()), 1e-12)


def measured(
    image: np.ndarray, background: np.ndarray | None, full_scale: float | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return fits [K, 4], rms [K], features [K, 6], and the picture's digital numbers per internal one."""
    if image.ndim != 2 or min(image.shape) < 2 * SCREEN + 1:
        raise InputError(f"must be [H, W] of at least 13 x 13, is {list(image.shape)}", where="image")
    if background is not None and background.shape != image.shape:
        raise InputError(f"is {list(background.shape)}, the image {list(image.shape)}", where="background")
    unit = saturation(image, full_scale) / 255
    # Scaled to 255, because the weights belong to 8-bit images.
    field = image.astype(np.float32) / np.float32(unit)
    if not np.isfinite(field).all():
        raise InputError("holds NaN or infinite values", where="image", remedy="mask or fill them first")
    saturated = field >= 254.99
    if background is not None:
        field = field - background.astype(np.float32) / np.float32(unit)
    smooth = cv2.GaussianBlur(field, (0, 0), SCALE)
    x, y = blobs(field, smooth)
    if not len(x):
        return np.empty((0, 4)), np.empty(0), np.empty((0, 6)), unit
    kept = screen(field, saturated, x, y)
    found, rms = fit(field, saturated, x[kept], y[kept])
    # A spot centred outside the image cannot be measured.
    inside = ((found[:, 1:3] > -1) & (found[:, 1:3] < field.shape[::-1])).all(axis=1)
    found, rms = found[inside], rms[inside]
    return found, rms, features(field, smooth, found, rms), unit


def find_candidates(
    image: np.ndarray, background: np.ndarray | None = None, *, full_scale: float | None = None
) -> Candidates:
    """Return up to a dozen possible lasers in an image, most likely first; arguments and errors as `spot.find_spot`."""
    found, rms, described, unit = measured(image, background, full_scale)
    odds = described @ WEIGHTS + BIAS
    order = np.argsort(-odds)
    (height, x, y, sigma), rms = found[order].T, rms[order]
    snr = height / np.maximum(rms, 1e-3)
    return Candidates(x=x, y=y, odds=odds[order], peak=height * unit, snr=snr, sigma=sigma)
