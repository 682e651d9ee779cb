"""Draws frames of scenes without cameras, lit by a probe and dark, and puts retro-reflections into them.

Twelve kinds of scenes with what passes for a camera: noise, shade, bricks, leaves in the wind, lettering, screens,
windows, lamps, blocks of JPEG, hot pixels, people who move and furniture. The two frames of a pair are taken by hand:
shifted, turned and bent a little, and lit a little differently. Nothing here is a photograph: what is measured on these
scenes holds for scenes like them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

__all__ = ["KINDS", "Drawn", "Person", "draw", "fractal", "lettered", "room", "screen", "with_camera"]

Array = np.ndarray
_MARGIN = 48


@dataclass(frozen=True)
class Drawn:
    """A lit and a dark frame [H, W], uint8, and where cameras are, [N, 2] x and y, with their widths and heights.

    `sigma` is the standard deviation of the spots in pixels, `height` theirs in grey levels, `snr` the same over the
    noise's standard deviation at mid-grey, all [N].
    """

    lit: Array
    dark: Array
    places: Array
    sigma: Array
    height: Array
    snr: Array


def room(rng: np.random.Generator, shape: tuple[int, int], count: int = 70) -> Array:
    height, width = shape
    picture = np.full(shape, rng.uniform(30, 120), np.float32)
    for _ in range(count):
        x, y, level = rng.uniform(-40, width), rng.uniform(-40, height), float(rng.uniform(10, 200))
        w, h = rng.uniform(5, 140, 2)
        if rng.random() < 0.75:
            box = cv2.boxPoints(((x, y), (w, h), rng.choice([0.0, 0.0, rng.uniform(0, 90)]))).astype(np.int32)
            cv2.fillPoly(picture, [box], level)
        else:
            cv2.circle(picture, (int(x), int(y)), int(rng.uniform(3, 20)), level, -1)
    return picture


def fractal(rng: np.random.Generator, shape: tuple[int, int], power: float) -> Array:
    """Texture whose amplitude falls as frequency to a power, of unit standard deviation."""
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    size = np.maximum(np.hypot(fy, fx), 1 / max(shape)) ** -power
    field = np.fft.irfft2(size * np.fft.rfft2(rng.normal(size=shape)), shape)
    return ((field - field.mean()) / field.std()).astype(np.float32)


def _noise(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Array, Array]:
    flat = np.full(shape, rng.uniform(5, 160), np.float32) + 3 * fractal(rng, shape, 2.0)
    return flat, flat


def _shade(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Array, Array]:
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    picture = np.clip(rng.uniform(0, 80) + rng.uniform(-0.3, 0.3) * x + rng.uniform(-0.3, 0.3) * y, 0, 255)
    picture += rng.uniform(0, 60) * np.exp(-((x - rng.uniform(0, 600)) ** 2 + (y - rng.uniform(0, 400)) ** 2) / 2e4)
    return picture, picture


def _bricks(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Array, Array]:
    picture = np.full(shape, rng.uniform(90, 190), np.float32)
    w, h = int(rng.integers(24, 70)), int(rng.integers(10, 26))
    gap = int(rng.integers(1, 4))
    for row, top in enumerate(range(0, shape[0], h)):
        for left in range(-w, shape[1], w):
            at = left + (row % 2) * w // 2
            cv2.rectangle(picture, (at, top), (at + w - gap, top + h - gap), float(rng.uniform(40, 110)), -1)
    picture += 6 * fractal(rng, shape, 0.8)
    return picture, picture


def _leaves(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Array, Array]:
    picture = 70 + 25 * fractal(rng, shape, rng.uniform(0.7, 1.2))
    for _ in range(500):
        x, y = rng.uniform(0, shape[1]), rng.uniform(0, shape[0])
        axes = int(rng.uniform(2, 12)), int(rng.uniform(1, 5))
        level = float(rng.uniform(20, 120) if rng.random() < 0.9 else rng.uniform(150, 255))
        cv2.ellipse(picture, (int(x), int(y)), axes, rng.uniform(0, 180), 0, 360, level, -1)
    return picture, _bent(picture, rng, 1.5, 40)


def _write(picture: Array, text: str, at: tuple[int, int], font: int, size: float, level: float, thick: int) -> None:
    mask = np.zeros(picture.shape, np.uint8)
    cv2.putText(mask, text, at, font, size, 255.0, thick, cv2.LINE_AA)
    share = mask / np.float32(255)
    picture += share * (level - picture)


def _lettering(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Array, Array]:
    picture = np.full(shape, rng.uniform(20, 120), np.float32)
    for _ in range(6):
        x, y, w, h = int(rng.uniform(0, 400)), int(rng.uniform(0, 350)), *rng.integers(80, 260, 2)
        cv2.rectangle(picture, (x, y), (x + int(w), y + int(h)), float(rng.uniform(10, 230)), -1)
    letters = [chr(n) for n in range(33, 123)]
    for _ in range(60):
        text = "".join(rng.choice(letters, int(rng.integers(2, 18))))
        at = int(rng.uniform(-20, shape[1])), int(rng.uniform(0, shape[0]))
        size, thick = float(rng.uniform(0.25, 1.6)), int(rng.integers(1, 4))
        _write(picture, text, at, int(rng.integers(0, 8)), size, float(rng.uniform(0, 255)), thick)
    return picture, picture


def screen(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[int, int, Array, Array]:
    """Where a screen stands, x and y of its corner, the grid of its pixels and what it shows, [h, w] each."""
    w, h = int(rng.integers(80, 260)), int(rng.integers(60, 180))
    x, y = int(rng.uniform(0, shape[1] - w)), int(rng.uniform(0, shape[0] - h))
    period = rng.uniform(2.2, 6)
    down, along = np.mgrid[:h, :w]
    grid = 1 - 0.4 * (np.abs(np.sin(math.pi * along / period)) < 0.3) - 0.3 * (np.sin(math.pi * down / period) < -0.8)
    return x, y, grid, 130 + 40 * cv2.resize(fractal(rng, (32, 32), 1.2), (w, h))


def lettered(rng: np.random.Generator, content: Array) -> Array:
    """What a screen shows with some lines of text."""
    shown, (h, w) = content.copy(), content.shape
    for _ in range(int(rng.integers(0, 12))):
        at = int(rng.uniform(0, w)), int(rng.uniform(0, h))
        size = float(rng.uniform(0.25, 0.7))
        _write(shown, "abc xy 123", at, 0, size, float(rng.choice([0, 250])), 1)
    return shown


def _screens(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Screens with a grid of pixels, whose content changes between the two frames."""
    lit = room(rng, shape, 40)
    dark = lit.copy()
    for _ in range(int(rng.integers(2, 5))):
        x, y, grid, content = screen(rng, shape)
        for picture in (lit, dark):
            picture[y : y + len(grid), x : x + grid.shape[1]] = lettered(rng, content) * grid
    return lit, dark


def _windows(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Array, Array]:
    picture = room(rng, shape, 30) * 0.6
    for _ in range(int(rng.integers(1, 5))):
        w, h = int(rng.integers(60, 260)), int(rng.integers(60, 220))
        x, y = int(rng.uniform(-30, shape[1])), int(rng.uniform(-30, shape[0]))
        cv2.rectangle(picture, (x, y), (x + w, y + h), float(rng.uniform(180, 400)), -1)
        bars, thick = int(rng.integers(1, 6)), int(rng.integers(1, 8))
        for n in range(1, bars + 1):
            cv2.line(picture, (x + w * n // (bars + 1), y), (x + w * n // (bars + 1), y + h), 30.0, thick)
            cv2.line(picture, (x, y + h * n // (bars + 1)), (x + w, y + h * n // (bars + 1)), 30.0, thick)
        if rng.random() < 0.5:
            for n in range(y, y + h, int(rng.integers(5, 12))):
                cv2.line(picture, (x, n), (x + w, n), 60.0, 2)
    return picture, picture


def _lamps(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Array, Array]:
    picture = room(rng, shape, 40) * 0.7
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    for _ in range(int(rng.integers(1, 7))):
        at = rng.uniform(0, shape[1]), rng.uniform(0, shape[0])
        size, halo = rng.uniform(5, 30), rng.uniform(8, 60)
        away = np.hypot((x - at[0]) * rng.uniform(0.5, 1), y - at[1])
        picture += rng.uniform(250, 900) * (away < size) + rng.uniform(20, 120) / (1 + (away / halo) ** 2)
    flicker = rng.uniform(0.85, 1.15)
    return picture, picture * flicker


def _blocks(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Array, Array]:
    kind = str(rng.choice(["leaves", "room", "lettering", "bricks"]))
    return KINDS[kind](rng, shape)


@dataclass(frozen=True)
class Person:
    """A silhouette so tall in pixels; levels of clothes and skin, the cloth's weave [H, W], and small bright details.

    `details` are their places about the middle, [N, 2], and `bright` their levels, [N].
    """

    tall: float
    clothes: float
    skin: float
    weave: Array
    details: Array
    bright: Array

    @classmethod
    def drawn(cls, rng: np.random.Generator, shape: tuple[int, int], tall: float) -> Person:
        """Draw what somebody wears."""
        clothes, skin = rng.uniform(15, 160, 2)
        weave = 8 * fractal(rng, shape, 0.5)
        return cls(tall, clothes, skin, weave, rng.normal(0, 0.09, (6, 2)) * tall, rng.uniform(0, 255, 6))

    def paint(self, picture: Array, start: Array, way: Array, feet: tuple[float, float]) -> None:
        """Paint the person who went from a place along a way; `feet` is how far each foot is aside of the middle."""
        at, mask = start + way, np.zeros(picture.shape, np.uint8)
        middle = at.astype(int).tolist()
        cv2.ellipse(mask, middle, (int(0.13 * self.tall), int(0.3 * self.tall)), 0, 0, 360, 1, -1)
        for aside in feet:
            foot = at + np.array([aside, 0.55 * self.tall])
            cv2.line(mask, middle, foot.astype(int).tolist(), 1, max(2, int(0.09 * self.tall)))
        cloth = np.roll(self.weave, (round(way[1]), round(way[0])), (0, 1))
        picture[mask > 0] = self.clothes + cloth[mask > 0]
        head = (at - (0, 0.38 * self.tall)).astype(int).tolist()
        cv2.circle(picture, head, max(3, int(0.07 * self.tall)), float(self.skin), -1)
        for (px, py), level in zip(self.details, self.bright, strict=True):
            spot = int(at[0] + px), int(at[1] + 1.5 * py)
            cv2.circle(picture, spot, max(1, int(0.006 * self.tall)), float(level), -1, cv2.LINE_AA)


def _people(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Silhouettes in clothes, with buttons, glasses and shoes, that walk between the two frames."""
    base = room(rng, shape, 50)
    lit, dark = base.copy(), base.copy()
    for _ in range(int(rng.integers(1, 4))):
        x, y, tall = rng.uniform(60, shape[1] - 60), rng.uniform(140, shape[0]), rng.uniform(90, 300)
        moved = rng.normal(0, 12, 2) * (1, 0.2)
        one = Person.drawn(rng, shape, tall)
        for picture, way in ((lit, np.zeros(2)), (dark, moved)):
            feet = (0.05 * way[0] - 0.1 * tall, 0.05 * way[0] + 0.1 * tall)
            one.paint(picture, np.array([x, y]), way, feet)
    return lit, dark


def _furniture(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Array, Array]:
    picture = room(rng, shape)
    return picture, picture


KINDS: dict[str, Callable[[np.random.Generator, tuple[int, int]], tuple[Array, Array]]] = {
    "noise": _noise,
    "shade": _shade,
    "bricks": _bricks,
    "leaves": _leaves,
    "lettering": _lettering,
    "screens": _screens,
    "windows": _windows,
    "lamps": _lamps,
    "blocks": _blocks,
    "hot pixels": _furniture,
    "people": _people,
    "room": _furniture,
}


def _bent(picture: Array, rng: np.random.Generator, size: float, cell: float) -> Array:
    """The picture, bent smoothly by so many pixels over cells of so many."""
    h, w = picture.shape
    small = max(3, int(w / cell)), max(3, int(h / cell))
    bend = cv2.resize(rng.normal(0, size, (*small[::-1], 2)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
    y, x = np.mgrid[:h, :w].astype(np.float32)
    return cv2.remap(picture, x + bend[..., 0], y + bend[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _by_hand(picture: Array, rng: np.random.Generator) -> Array:
    h, w = picture.shape
    way = cv2.getRotationMatrix2D((w / 2, h / 2), rng.normal(0, 0.4), 1 + rng.normal(0, 0.003))
    way[:, 2] += rng.uniform(-12, 12, 2)
    moved = cv2.warpAffine(picture, way, (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return _bent(moved, rng, 1.0, 160)


def draw(
    kind: str,
    seed: int,
    *,
    shape: tuple[int, int] = (480, 640),
    cameras: int = 0,
    snr: tuple[float, float] = (8, 60),
    sigma: tuple[float, float] = (0.6, 4.0),
    tape: bool = True,
) -> Drawn:
    """Draw a lit and a dark frame of a scene.

    Parameters
    ----------
    kind
        One of `KINDS`.
    seed
        Of everything in it.
    shape
        Rows and columns of the frames.
    cameras
        How many retro-reflections there are.
    snr, sigma
        Between which their signal-to-noise ratios and standard deviations in pixels lie, evenly in the logarithm.
    tape
        Whether a strip of retro-reflective tape may be seen, which only the lit frame shows bright.
    """
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    wide = shape[0] + 2 * _MARGIN, shape[1] + 2 * _MARGIN
    lit, dark = KINDS[kind](rng, wide)
    soft = rng.uniform(0.6, 1.1)
    lit, dark = (np.asarray(cv2.GaussianBlur(one, (0, 0), soft)) for one in (lit, dark))
    if rng.random() < 0.6:
        dark = _by_hand(dark, rng)
    # The probe's light falls on what is near.
    lit = lit * (1 + rng.uniform(0, 0.15) * np.clip(0.5 + 0.5 * fractal(rng, wide, 2.0), 0, 1))
    lit, dark = (one[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN].copy() for one in (lit, dark))
    if tape and rng.random() < 0.2:
        box = cv2.boxPoints(
            (
                rng.uniform((40, 40), (600, 440)).tolist(),
                rng.uniform((40, 8), (120, 24)).tolist(),
                rng.uniform(0, 180),
            )
        )
        strip = np.zeros(shape, np.float32)
        cv2.fillPoly(strip, [box.astype(np.int32)], float(rng.uniform(60, 250)))
        lit += cv2.GaussianBlur(strip, (0, 0), soft)
    spread = rng.uniform(1.0, 2.5) if kind != "noise" else rng.uniform(3, 10)
    places = rng.uniform((20, 20), (shape[1] - 20, shape[0] - 20), (cameras, 2))
    wides = np.exp(rng.uniform(math.log(sigma[0]), math.log(sigma[1]), cameras))
    ratios = np.exp(rng.uniform(math.log(snr[0]), math.log(snr[1]), cameras))
    for (x, y), s, ratio in zip(places, wides, ratios, strict=True):
        with_camera(lit, x, y, ratio * spread, s)
    frames = []
    hot = rng.uniform((0, 0), (shape[1], shape[0]), (40, 2)).astype(int), rng.uniform(30, 255, 40)
    for one in (lit, dark):
        taken = one + rng.normal(0, spread, shape) * np.sqrt(0.4 + 0.6 * np.clip(one, 0, 255) / 128)
        if kind == "hot pixels":
            taken[hot[0][:, 1], hot[0][:, 0]] += hot[1]
        taken = np.clip(taken, 0, 255).round().astype(np.uint8)
        if kind == "blocks":
            quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(15, 60))]
            taken = cv2.imdecode(cv2.imencode(".jpg", taken, quality)[1], cv2.IMREAD_GRAYSCALE)
        frames.append(taken)
    return Drawn(frames[0], frames[1], places, wides, ratios * spread, ratios)


def with_camera(picture: Array, x: float, y: float, height: float, sigma: float) -> None:
    """Add a Gaussian spot to a picture [H, W], float."""
    reach = math.ceil(5 * sigma)
    left, top = max(0, int(x) - reach), max(0, int(y) - reach)
    part = picture[top : int(y) + reach + 1, left : int(x) + reach + 1]
    rows, columns = np.mgrid[: part.shape[0], : part.shape[1]]
    part += height * np.exp(-((columns + left - x) ** 2 + (rows + top - y) ** 2) / (2 * sigma**2))
