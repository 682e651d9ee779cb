"""Draws lit and dark frames of scenes of all sorts, from which the detector's second stage learns.

More variety than the twelve kinds of drawn_scenes.py, which judge it: textures from procedural noise, heaps of shapes
of every size, walls in perspective, things in front that move, near things that a flash lights more than far ones, tape
and reflectors of any shape, glass, lamps, screens, writing; frames blurred by defocus and motion, sharpened,
interlaced, of any gain, with stuck pixels, rounded by JPEG. Nothing here is a photograph. What it should hold was
chosen after a look at what was missed and mistaken in real frames.

Over 400 lines, as each thing that passes for a camera is drawn by a function of its own.

What a pair cannot tell from a camera, whatever looks at it, is marked: round tape and tape of at most four pixels. And
so is how much of a camera the frame shows at all: one before an overexposed window is no camera to learn from.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import fft

__all__ = ["Varied", "varied"]

Array = np.ndarray
_MARGIN = 48


@dataclass(frozen=True)
class Varied:
    """A lit and a dark frame [H, W], uint8, and where cameras are.

    Parameters
    ----------
    places
        [N, 2] x and y of the cameras in the lit frame, in pixels.
    diameter, snr
        [N] their full widths in pixels, and their heights over the noise's standard deviation.
    seen
        [N] what a filter of the very shape of their light would answer in the frame as it was taken, over the noise.
    unresolved
        [M, 2] where tape is that looks like a camera.
    """

    lit: Array
    dark: Array
    places: Array
    diameter: Array
    snr: Array
    seen: Array
    unresolved: Array


@dataclass(frozen=True)
class Canvas:
    """A picture [H, W] that is painted, and the share of the probe's light that falls there."""

    picture: Array
    flash: Array


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def _texture(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    """Noise whose amplitude falls as frequency to a random power, along a random direction, of unit deviation.

    It repeats every 256 pixels, which takes a fraction of the time.
    """
    side = 256
    fy, fx = np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None]
    turn, squeeze = rng.uniform(0, math.pi), _log(rng, 1, 6) if rng.random() < 0.4 else 1.0
    along, across = fx * math.cos(turn) + fy * math.sin(turn), fy * math.cos(turn) - fx * math.sin(turn)
    size = (np.maximum(np.hypot(along * squeeze, across), 1 / side) ** -rng.uniform(0.3, 2.2)).astype(np.float32)
    spectrum = size * fft.rfft2(rng.standard_normal((side, side), np.float32))
    field = np.asarray(fft.irfft2(spectrum, (side, side)), np.float32)
    field = (field - field.mean()) / field.std()
    if rng.random() < 0.3:  # leaves and gravel: bright and dark flakes
        field = np.tanh(rng.uniform(1, 5) * (field + rng.uniform(-1.5, 1.5)), dtype=np.float32)
    return np.tile(field, (-(-shape[0] // side), -(-shape[1] // side)))[: shape[0], : shape[1]]


def _polygon(rng: np.random.Generator, at: Array, size: float) -> Array:
    kind, turn = rng.integers(4), rng.uniform(0, 2 * math.pi) if rng.random() < 0.5 else rng.normal(0, 0.05)
    squeeze = _log(rng, 0.15, 1)
    if kind == 0:  # quadrilateral, near to a rectangle
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) + rng.normal(0, 0.15, (4, 2)) * (rng.random() < 0.5)
    elif kind == 1:  # ellipse
        angle = np.linspace(0, 2 * math.pi, 24, endpoint=False)
        corners = np.stack([np.cos(angle), np.sin(angle)], 1)
    else:  # star-like, as leaves and rubbish are
        count = int(rng.integers(3, 12))
        angle = np.sort(rng.uniform(0, 2 * math.pi, count))
        corners = np.stack([np.cos(angle), np.sin(angle)], 1) * rng.uniform(0.4, 1.2, (count, 1))
    c, s = math.cos(turn), math.sin(turn)
    return at + size * (corners * (1, squeeze)) @ np.array([[c, s], [-s, c]])


def _round(corners: Array) -> bool:
    """Whether a polygon is so small, or so small and round, that it looks like a camera's return."""
    (_, sides, _) = cv2.minAreaRect(corners.astype(np.float32))
    long, short = max(sides), min(sides)
    return long <= 4 or (long < 1.4 * short and long < 14) or (long < 6 and long < 1.8 * short)


def _fill(picture: Array, corners: Array, level: float | Array) -> None:
    """Paint a polygon with a level or with a picture of them; edges are shared by pixels."""
    left, top = np.maximum(np.floor(corners.min(0)).astype(int) - 1, 0).tolist()
    right, low = np.minimum(np.ceil(corners.max(0)).astype(int) + 2, picture.shape[::-1]).tolist()
    if right <= left or low <= top:
        return
    mask = np.zeros((low - top, right - left), np.uint8)
    cv2.fillPoly(mask, [np.round((corners - (left, top)) * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
    part = picture[top:low, left:right]
    paint = level[top:low, left:right] if isinstance(level, np.ndarray) else level
    part += mask / np.float32(255) * (paint - part)


def _heap(rng: np.random.Generator, canvas: Canvas) -> None:
    """Shapes of every size upon each other, which gives the statistics of photographs (dead leaves).

    What lies nearer takes more of the probe's light: its share is painted in the same shapes.
    """
    picture = canvas.picture
    least, most = _log(rng, 1.5, 12), _log(rng, 15, 150)
    weave = _texture(rng, picture.shape) * _log(rng, 1, 25) if rng.random() < 0.6 else None
    wide = rng.uniform(10, 90)
    sizes = np.sort(1 / rng.uniform(1 / most, 1 / least, int(_log(rng, 20, 350))))[::-1]
    middle, uneven = rng.uniform(30, 150), _log(rng, 1, 8) if rng.random() < 0.4 else 0.0
    for size in sizes:
        level = float(np.clip(rng.normal(middle, wide), 0, 255 if rng.random() < 0.9 else 600))
        paint = level + weave if weave is not None and size > 8 else level
        corners = _polygon(rng, rng.uniform((0, 0), picture.shape[::-1]), size)
        _fill(picture, corners, paint)
        if uneven > 0:
            _fill(canvas.flash, corners, _log(rng, 1 / uneven, uneven))


def _walls(rng: np.random.Generator, canvas: Canvas) -> None:
    """Tiles, bricks, shelves or blinds, seen at a slant."""
    picture = canvas.picture
    side = max(picture.shape)
    flat = np.full((side, side), rng.uniform(20, 200), np.float32)
    w, h = _log(rng, 5, 90), _log(rng, 4, 60)
    gap, shift, level, spread = rng.uniform(0.8, 5), rng.uniform(0, 1), rng.uniform(10, 220), _log(rng, 1, 60)
    for row in range(int(side / h) + 1):
        for column in range(-1, int(side / w) + 1):
            left, top = w * (column + shift * (row % 2)), h * row
            corner = (round(16 * left), round(16 * top)), (round(16 * (left + w - gap)), round(16 * (top + h - gap)))
            cv2.rectangle(flat, *corner, float(np.clip(rng.normal(level, spread), 0, 400)), -1, cv2.LINE_AA, 4)
    box = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32)
    onto = np.float32(box + rng.normal(0, 0.2 * side, (4, 2)))
    slant = cv2.getPerspectiveTransform(box, onto)
    size = picture.shape[::-1]
    mask = cv2.warpPerspective(np.ones_like(flat), slant, size, flags=cv2.INTER_AREA)
    picture += mask * (cv2.warpPerspective(flat, slant, size, flags=cv2.INTER_AREA) - picture)


def _writing(rng: np.random.Generator, canvas: Canvas) -> None:
    picture = canvas.picture
    for _ in range(int(rng.integers(1, 25))):
        text = "".join(chr(int(n)) for n in rng.integers(33, 123, int(rng.integers(1, 14))))
        mask = np.zeros(picture.shape, np.uint8)
        at = tuple(int(n) for n in rng.uniform((-20, 0), picture.shape[::-1]))
        font, size, thick = int(rng.integers(8)), _log(rng, 0.2, 2), int(rng.integers(1, 5))
        cv2.putText(mask, text, at, font, size, 255.0, thick, cv2.LINE_AA)
        picture += mask / np.float32(255) * (rng.uniform(0, 255) - picture)


def _lines(rng: np.random.Generator, canvas: Canvas) -> None:
    """Wires, twigs, poles and bars."""
    picture = canvas.picture
    for _ in range(int(_log(rng, 1, 60))):
        ends = rng.uniform((-30, -30), picture.shape[::-1], (2, 2))
        if rng.random() < 0.5:
            ends[1] = ends[0] + rng.normal(0, 40, 2)
        a, b = (tuple(int(n) for n in 16 * end) for end in ends)
        cv2.line(picture, a, b, float(rng.uniform(0, 300)), int(_log(rng, 1, 8)), cv2.LINE_AA, 4)


def _dots(rng: np.random.Generator, canvas: Canvas) -> None:
    """Small bright or dark things: buttons, rivets, lights, sun on leaves."""
    picture = canvas.picture
    for _ in range(int(_log(rng, 1, 60))):
        size = _log(rng, 0.5, 5)
        level = rng.uniform(0, 255) if rng.random() < 0.8 else _log(rng, 255, 1500)
        _fill(picture, _polygon(rng, rng.uniform((0, 0), picture.shape[::-1]), size), level)


def _lamps(rng: np.random.Generator, canvas: Canvas) -> None:
    picture = canvas.picture
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]].astype(np.float32)
    for _ in range(int(rng.integers(1, 5))):
        at = rng.uniform((0, 0), picture.shape[::-1])
        _fill(picture, _polygon(rng, at, _log(rng, 2, 40)), _log(rng, 200, 1500))
        picture += _log(rng, 5, 150) / (1 + (np.hypot(x - at[0], y - at[1]) / _log(rng, 4, 60)) ** 2)


_PAINTERS: tuple[tuple[float, Callable[[np.random.Generator, Canvas], None]], ...] = (
    (0.75, _heap),
    (0.3, _walls),
    (0.25, _writing),
    (0.4, _lines),
    (0.4, _dots),
    (0.2, _lamps),
)


def _painted(rng: np.random.Generator, shape: tuple[int, int]) -> Canvas:
    picture = np.full(shape, _log(rng, 4, 180), np.float32)
    canvas = Canvas(picture + _log(rng, 0.5, 40) * _texture(rng, shape), np.ones(shape, np.float32))
    order = rng.permutation(len(_PAINTERS))
    for n in order:
        chance, paint = _PAINTERS[n]
        if rng.random() < chance:
            paint(rng, canvas)
    return canvas


def _bent(rng: np.random.Generator, picture: Array, size: float, cell: float, way: Array | None = None) -> Array:
    h, w = picture.shape
    grid = max(3, int(w / cell)), max(3, int(h / cell))
    bend = cv2.resize(rng.normal(0, size, (*grid[::-1], 2)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
    y, x = np.mgrid[:h, :w].astype(np.float32)
    if way is not None:
        x, y = (np.float32(row[0] * x + row[1] * y + row[2]) for row in way)
    return cv2.remap(picture, x + bend[..., 0], y + bend[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _movers(rng: np.random.Generator, lit: Array, dark: Array, gain: float) -> None:
    """People and things in front, which stand elsewhere in the dark frame, and are nearer to the probe's light."""
    shape = lit.shape
    far = _log(rng, 1, 40)
    for _ in range(int(rng.integers(1, 5))):
        at, size = rng.uniform((0, 0), shape[::-1]), _log(rng, 10, 150)
        inside = np.float32(_log(rng, 8, 250)) + _texture(rng, shape) * _log(rng, 1, 20)
        if rng.random() < 0.4:
            inside = _painted(rng, shape).picture
        parts = [(_polygon(rng, at + rng.normal(0, 0.7 * size, 2), size * rng.uniform(0.3, 1)), inside)]
        parts += [
            (_polygon(rng, at + rng.normal(0, 0.7 * size, 2), size * rng.uniform(0.1, 0.7)), inside)
            for _ in range(int(rng.integers(0, 5)))
        ]
        for _ in range(int(rng.integers(0, 14))):  # buttons, hands, glasses, shoes, folds
            small = _polygon(rng, at + rng.normal(0, 0.8 * size, 2), _log(rng, 0.7, 10))
            parts.append((small, float(rng.uniform(0, 300))))
        shift = rng.normal(0, far, 2) * (1, rng.choice([0.2, 1.0]))
        turn, near = rng.normal(0, 0.05), 1 + gain * rng.uniform(0, 1)
        c, s = math.cos(turn), math.sin(turn)
        for corners, paint in parts:
            own = rng.normal(0, 0.15 * far, 2) * (rng.random() < 0.5)
            there = at + shift + own + (corners - at) @ np.array([[c, s], [-s, c]])
            _fill(lit, corners, paint * near)
            if isinstance(paint, np.ndarray):
                paint = np.roll(paint, tuple(round(n) for n in (shift + own)[::-1]), (0, 1))
            _fill(dark, there, paint)


def _screens(rng: np.random.Generator, lit: Array, dark: Array) -> None:
    """Screens and mirrors: what they show changes."""
    corners = _polygon(rng, rng.uniform((0, 0), lit.shape[::-1]), _log(rng, 15, 120))
    for picture in (lit, dark):
        shown = _painted(rng, lit.shape).picture
        period = rng.uniform(2, 6)
        if rng.random() < 0.5:
            grid = np.sin(2 * math.pi * np.arange(lit.shape[1]) / period) > 0.5
            shown = shown * (1 - 0.3 * grid).astype(np.float32)
        _fill(picture, corners, shown)


def _twinkle(rng: np.random.Generator, lit: Array, dark: Array) -> None:
    """Sun on leaves and water, which shines elsewhere in each frame."""
    at, wide = rng.uniform((0, 0), lit.shape[::-1]), rng.uniform(20, 200)
    high = _log(rng, 5, 200)
    for _ in range(int(_log(rng, 10, 250))):
        corners = _polygon(rng, at + rng.normal(0, wide, 2), _log(rng, 0.5, 5))
        level = rng.uniform(0, 200)
        for picture in (lit, dark):
            _fill(picture, corners + rng.normal(0, 0.7, 2), float(level + high * rng.random() ** 2))


def _strays(rng: np.random.Generator, lit: Array, dark: Array) -> None:
    """Small bright things that went each its own way: buttons and badges of who walks by, insects, far headlights."""
    far = _log(rng, 2, 40)
    for _ in range(int(_log(rng, 1, 25))):
        at, level = rng.uniform((0, 0), lit.shape[::-1]), _log(rng, 40, 400)
        corners = _polygon(rng, at, _log(rng, 0.6, 5))
        _fill(lit, corners, level)
        _fill(dark, corners + rng.normal(0, far, 2), level * rng.uniform(0.8, 1.2))


def _tape(rng: np.random.Generator, added: Array) -> list[Array]:
    """Retro-reflective strips, patches, plates with letters and bike reflectors; returns the unresolved ones."""
    unresolved: list[Array] = []
    for _ in range(int(_log(rng, 1, 12))):
        at, size, level = rng.uniform((0, 0), added.shape[::-1]), _log(rng, 0.7, 30), _log(rng, 15, 700)
        corners = _polygon(rng, at, size)
        paint: float | Array = level
        if rng.random() < 0.4 and size > 4:  # honeycomb, wear, letters
            paint = np.maximum(level * (1 + rng.uniform(0.1, 0.6) * _texture(rng, added.shape)), 0).astype(np.float32)
            if rng.random() < 0.5:
                _writing(rng, Canvas(paint, paint))
        mask = np.zeros_like(added)
        _fill(mask, corners, paint)
        added += mask
        if _round(corners):
            unresolved.append(corners.mean(0))
    return unresolved


def _speculars(rng: np.random.Generator, added: Array) -> None:
    """The probe's light upon glass, chrome and varnish: streaks, curves and blots with soft rims."""
    for _ in range(int(_log(rng, 1, 15))):
        at, long, turn = rng.uniform((0, 0), added.shape[::-1]), _log(rng, 3, 60), rng.uniform(0, math.pi)
        bend = rng.normal(0, 0.6)
        t = np.linspace(-1, 1, 15)
        c, s = math.cos(turn), math.sin(turn)
        curve = at + long * np.stack([t * c - bend * t**2 * s, t * s + bend * t**2 * c], 1)
        mask = np.zeros_like(added)
        level, thick = _log(rng, 15, 500), int(_log(rng, 1, 6))
        cv2.polylines(mask, [np.round(16 * curve).astype(np.int32)], False, level, thick, cv2.LINE_AA, 4)
        added += cv2.GaussianBlur(mask, (0, 0), _log(rng, 0.5, 6))


def _stamp(rng: np.random.Generator, diameter: float, x: float, y: float) -> tuple[Array, int, int]:
    """A retro-reflection of unit height about x, y: Gaussian, disc, ring of a lens out of focus, or cut by a stop."""
    reach = math.ceil(1.5 * diameter + 4)
    left, top, over = int(x) - reach, int(y) - reach, 4
    at = (np.arange(over * (2 * reach + 1)) + 0.5) / over - 0.5
    across, down = at[None] + left - x, at[:, None] + top - y
    turn, squeeze = rng.uniform(0, math.pi), _log(rng, 1, 1.35)
    u, v = across * math.cos(turn) + down * math.sin(turn), (down * math.cos(turn) - across * math.sin(turn)) * squeeze
    radius = np.hypot(u, v) / (diameter / 2)
    kind = rng.choice(4, p=[0.5, 0.25, 0.1, 0.15])
    if kind == 0:
        light = np.exp(-2 * radius**2)
    elif kind == 1:
        light = np.clip((1 - radius) * rng.uniform(2, 8), 0, 1)
    elif kind == 2:
        light = np.exp(-((radius - 0.7) ** 2) / 0.05) + rng.uniform(0, 1) * np.exp(-8 * radius**2)
    else:  # a lens seen aslant: where two circles overlap
        cut = rng.uniform(0.2, 0.9) * diameter / 2
        light = ((radius < 1) & (np.hypot(u - cut, v) < diameter / 2)).astype(float)
    if rng.random() < 0.3:
        light = light + rng.uniform(0.01, 0.08) / (1 + (radius / rng.uniform(1, 3)) ** 2)
    if rng.random() < 0.15:  # spikes of a stop's blades, smear of a full sensor
        angle, count = np.arctan2(v, u), int(rng.choice([1, 2, 3, 4]))
        light = light + rng.uniform(0.05, 0.5) * np.abs(np.cos(count * angle)) ** rng.uniform(8, 40) / (1 + radius**2)
    light = light.reshape(2 * reach + 1, over, 2 * reach + 1, over).mean((1, 3))
    return (light / max(float(light.max()), 1e-6)).astype(np.float32), left, top


def _add(picture: Array, stamp: Array, left: int, top: int) -> None:
    h, w = stamp.shape
    y0, x0, y1, x1 = max(0, top), max(0, left), min(picture.shape[0], top + h), min(picture.shape[1], left + w)
    if y1 > y0 and x1 > x0:
        picture[y0:y1, x0:x1] += stamp[y0 - top : y1 - top, x0 - left : x1 - left]


def _smeared(rng: np.random.Generator) -> Array:
    """Kernel of a frame's own defocus and of the hand's motion while it is exposed."""
    side = 25
    kernel = np.zeros((side, side), np.float32)
    if rng.random() < 0.35:
        long, turn = _log(rng, 0.7, 7), rng.uniform(0, math.pi)
        way = 8 * long * np.array([math.cos(turn), math.sin(turn)])
        ends = [tuple(round(n) for n in 192 + sign * way) for sign in (-1, 1)]
        cv2.line(kernel, *ends, 1.0, 1, cv2.LINE_AA, 4)
    else:
        kernel[12, 12] = 1
    kernel = cv2.GaussianBlur(kernel, (0, 0), _log(rng, 0.35, 1.6))
    return kernel / kernel.sum()


def varied(seed: int, *, shape: tuple[int, int] = (288, 384), cameras: int | None = None) -> Varied:
    """Draw a lit and a dark frame of a scene of any sort.

    Parameters
    ----------
    seed
        Of everything in it.
    shape
        Rows and columns of the frames.
    cameras
        How many retro-reflections there are; default: none to six.
    """
    rng = np.random.default_rng([77, seed])
    wide = shape[0] + 2 * _MARGIN, shape[1] + 2 * _MARGIN
    canvas = _painted(rng, wide)
    dark = canvas.picture
    lit = dark.copy()
    if rng.random() < 0.35:
        dark = _bent(rng, dark, _log(rng, 0.3, 2.5), _log(rng, 20, 80))  # leaves in the wind, haze
    # The probe's light falls on what is near.
    gain = _log(rng, 0.01, 1.0) if rng.random() < 0.7 else 0.0
    uneven = cv2.GaussianBlur(_texture(rng, wide), (0, 0), _log(rng, 6, 40)) * (rng.random() < 0.7)
    lit *= 1 + gain * canvas.flash * np.clip(0.5 + 0.5 * uneven / (uneven.std() + 1e-6), 0, 1)
    if rng.random() < 0.25:
        _twinkle(rng, lit, dark)
    if rng.random() < 0.15:
        _screens(rng, lit, dark)
    if rng.random() < 0.55:
        _movers(rng, lit, dark, gain)
    if rng.random() < 0.25:
        _strays(rng, lit, dark)
    added = np.zeros_like(lit)
    unresolved = _tape(rng, added) if rng.random() < 0.25 else []
    if rng.random() < 0.2:
        _speculars(rng, added)
    count = int(rng.integers(0, 7)) if cameras is None else cameras
    places = rng.uniform((14, 14), (shape[1] - 14, shape[0] - 14), (count, 2))
    diameters = np.array([_log(rng, 1.2, 22) if rng.random() < 0.85 else _log(rng, 15, 50) for _ in range(count)])
    for n in range(1, count):
        if rng.random() < 0.35:  # binoculars, phones with several lenses
            diameters[n] = diameters[n - 1] * _log(rng, 0.7, 1.4)
            turn, apart = rng.uniform(0, 2 * math.pi), max(_log(rng, 1.5, 8) * diameters[n], 4.0)
            aside = places[n - 1] + apart * np.array([math.cos(turn), math.sin(turn)])
            places[n] = np.clip(aside, 6, (shape[1] - 7, shape[0] - 7))
    for (x, y), diameter in zip(places + _MARGIN, diameters, strict=True):
        if rng.random() < 0.35:  # the body that a lens sits in
            body, level = _polygon(rng, np.array([x, y]), _log(rng, 0.8, 4) * diameter + 1), _log(rng, 2, 120)
            for one in (lit, dark):
                _fill(one, body, level)
    if rng.random() < 0.2:  # lamps that flicker, the sun behind clouds
        dark *= rng.uniform(0.8, 1.25)
    standing = rng.random() < 0.3
    if not standing:
        turn = cv2.getRotationMatrix2D((wide[1] / 2, wide[0] / 2), rng.normal(0, 0.6), 1 + rng.normal(0, 0.004))
        turn[:, 2] += rng.uniform(-16, 16, 2)
        dark = _bent(rng, dark, rng.uniform(0, 1.5), 120, turn)
    spread = _log(rng, 0.4, 7) if rng.random() < 0.88 else _log(rng, 7, 70)
    smears = _smeared(rng), _smeared(rng)
    if standing or rng.random() < 0.4:
        smears = smears[0], smears[0]
    ratios = np.array([_log(rng, 4, 60) if rng.random() < 0.7 else _log(rng, 60, 600) for _ in range(count)])
    spots = np.zeros_like(lit)
    for (x, y), diameter, ratio in zip(places + _MARGIN, diameters, ratios, strict=True):
        stamp, left, top = _stamp(rng, diameter, x, y)
        # The height that is left after the frame's own blur.
        soft = float(cv2.filter2D(cv2.copyMakeBorder(stamp, 13, 13, 13, 13, cv2.BORDER_CONSTANT), -1, smears[0]).max())
        _add(spots, stamp * (ratio * spread / max(soft, 1e-3)), left, top)
    full = _log(rng, 0.5, 2) if rng.random() < 0.3 else 1.0
    way = _way_of_taking(rng, shape, spread)
    frames, blank = [], np.zeros(0)
    for n, (one, smear) in enumerate(zip((lit + added, dark), smears, strict=True)):
        noise = _noise(rng, shape, way)
        if n == 0:
            frames.append(_taken(one + spots, one - added, smear, full, noise, way))
            blank = _taken(one, one - added, smear, full, noise, way)
        else:
            frames.append(_taken(one, one, smear, full, noise, way))
    shown = frames[0].astype(np.float32) - blank
    level = spread * np.sqrt(1 - way.level + way.level * blank / np.float32(128)) + 0.3
    seen = np.array([_energy(shown / level, at, wide) for at, wide in zip(places, diameters, strict=True)])
    where = np.array(unresolved).reshape(-1, 2) - _MARGIN
    return Varied(frames[0], frames[1], places, diameters, ratios, seen, where)


@dataclass(frozen=True)
class _Way:
    """How frames are taken: what the sensor and the processing do to both of a pair."""

    spread: float
    level: float
    grain: float
    rows: bool
    comb: bool
    hot: Array
    glow: Array
    sharp: tuple[float, float]
    tint: Array | None
    title: str
    quality: int


def _way_of_taking(rng: np.random.Generator, shape: tuple[int, int], spread: float) -> _Way:
    count = int(rng.integers(0, 40)) if rng.random() < 0.2 else 0
    return _Way(
        spread=spread,
        level=rng.uniform(0.2, 1.0),
        grain=_log(rng, 0.35, 0.9) if rng.random() < 0.35 else 0.0,
        rows=rng.random() < 0.15,
        comb=rng.random() < 0.06,
        hot=rng.uniform((0, 0), shape[::-1], (count, 2)).astype(int),
        glow=rng.uniform(20, 255, count),
        sharp=(_log(rng, 0.2, 1.5), _log(rng, 0.7, 2.5)) if rng.random() < 0.35 else (0.0, 1.0),
        tint=np.array([rng.uniform(0.6, 1), 1.0, rng.uniform(0.6, 1)]) if rng.random() < 0.15 else None,
        title="".join(chr(int(n)) for n in rng.integers(33, 123, 9)) if rng.random() < 0.08 else "",
        quality=int(rng.integers(15, 96)) if rng.random() < 0.4 else 0,
    )


def _noise(rng: np.random.Generator, shape: tuple[int, int], way: _Way) -> tuple[Array, Array]:
    """Noise of unit deviation, [H, W], and what each row adds, [H, 1]."""
    noise = rng.normal(0, 1, shape).astype(np.float32)
    if way.grain:
        noise = cv2.GaussianBlur(noise, (0, 0), way.grain)
        noise /= noise.std()
    return noise, rng.normal(0, 0.7 * way.rows, (shape[0], 1))


def _taken(picture: Array, other: Array, smear: Array, full: float, noise: tuple[Array, Array], way: _Way) -> Array:
    """The frame [H, W], uint8, that a sensor takes of a picture; of two fields the second is of another picture."""
    inner = slice(_MARGIN, -_MARGIN)
    seen = cv2.filter2D(picture, -1, smear, borderType=cv2.BORDER_REFLECT)[inner, inner] * full
    if way.comb:  # the probe's light is in one field only
        seen[1::2] = (cv2.filter2D(other, -1, smear, borderType=cv2.BORDER_REFLECT)[inner, inner] * full)[1::2]
    taken = seen + way.spread * noise[0] * np.sqrt(1 - way.level + way.level * np.clip(seen, 0, 255) / 128)
    taken += way.spread * noise[1]
    taken[way.hot[:, 1], way.hot[:, 0]] += way.glow
    if way.sharp[0]:  # as cameras do: edges overshoot, and a glint has a dark halo
        taken = np.clip(taken, 0, 255).astype(np.float32)
        taken += way.sharp[0] * (taken - cv2.GaussianBlur(taken, (0, 0), way.sharp[1]))
    taken = np.clip(taken, 0, 255).round().astype(np.uint8)
    if way.tint is not None:  # one colour filter a pixel, as a grey scene is seen in three colours, whose mean is taken
        raw = taken.astype(np.float32)
        raw[::2, ::2] *= way.tint[0]
        raw[1::2, 1::2] *= way.tint[2]
        colour = cv2.cvtColor(raw.round().astype(np.uint8), cv2.COLOR_BayerRGGB2RGB)
        taken = np.clip(colour / way.tint, 0, 255).mean(2).round().astype(np.uint8)
    if way.title:
        cv2.putText(taken, way.title, (10, 20), 0, 0.5, 255.0, 1)
    if way.quality:
        coded = cv2.imencode(".jpg", taken, [cv2.IMWRITE_JPEG_QUALITY, way.quality])[1]
        taken = cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)
    return taken


def _energy(shown: Array, at: Array, diameter: float) -> float:
    """Root of the sum of squares of what a camera adds to a frame, in units of the noise, about its place."""
    reach = math.ceil(0.75 * diameter + 2)
    left, top = (max(0, round(float(n)) - reach) for n in at)
    part = np.maximum(shown[top : top + 2 * reach + 1, left : left + 2 * reach + 1], 0)
    return float(np.sqrt(np.square(part).sum()))
