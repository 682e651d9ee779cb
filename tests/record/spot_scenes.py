"""Synthetic target pictures, to test and calibrate the spot finder: scenes, lasers, sensor noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

H, W = 486, 648
Y, X = np.mgrid[:H, :W].astype(np.float32)


def cloud(rng: np.random.Generator) -> np.ndarray:
    """Noise with a spectrum like a natural picture's."""
    fy, fx = np.fft.fftfreq(H)[:, None], np.fft.rfftfreq(W)
    frequency = np.hypot(fy, fx)
    frequency[0, 0] = 1
    field = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(H, W))) / frequency ** rng.uniform(0.8, 2.0), (H, W))
    field = (field - field.mean()) / field.std()
    return (rng.uniform(50, 130) + rng.uniform(12, 35) * field).astype(np.float32)


def leaves(rng: np.random.Generator) -> np.ndarray:
    """Discs and boxes over each other, down to 4 px, with edges as sharp as a lens gives."""
    field = np.full((H, W), 100, np.float32)
    for _ in range(rng.integers(100, 700)):
        x, y = int(rng.uniform(0, W)), int(rng.uniform(0, H))
        size, shade = int(np.clip(4 / rng.uniform(0.03, 1), 4, 150)), float(rng.uniform(15, 200))
        if rng.random() < 0.5:
            cv2.circle(field, (x, y), size, shade, -1)
        else:
            cv2.rectangle(field, (x, y), (x + int(size * rng.uniform(0.5, 2)), y + size), shade, -1)
    return cv2.GaussianBlur(field, (0, 0), rng.uniform(0.6, 1.2))


def board(rng: np.random.Generator) -> np.ndarray:
    """A chequered board with letters: corners and strokes."""
    pitch, turn = rng.uniform(12, 60), rng.uniform(0, np.pi)
    u = np.floor((X * np.cos(turn) + Y * np.sin(turn)) / pitch)
    v = np.floor((Y * np.cos(turn) - X * np.sin(turn)) / pitch)
    field = np.where((u + v) % 2, rng.uniform(120, 190), rng.uniform(20, 90)).astype(np.uint8)
    for _ in range(30):
        word = "".join(rng.choice(list("ABEHKMNRTVX"), 5))
        where = (int(rng.uniform(0, W)), int(rng.uniform(0, H)))
        cv2.putText(field, word, where, 0, float(rng.uniform(0.4, 1.2)), float(rng.uniform(0, 220)), 1)
    return cv2.GaussianBlur(field.astype(np.float32), (0, 0), 0.8)


def mixed(rng: np.random.Generator) -> np.ndarray:
    """Leaves, cloud and fine grain."""
    grain = cv2.GaussianBlur(rng.normal(size=(H, W)).astype(np.float32), (0, 0), 1.5)
    return np.clip((leaves(rng) + cloud(rng)) / 2 + 12 * grain / 0.19, 5, 230)


def glints(rng: np.random.Generator) -> np.ndarray:
    """Mixed, with a few blurred highlights that are not the laser."""
    field = mixed(rng)
    for _ in range(rng.integers(1, 6)):
        x, y, sigma, flat = (
            rng.uniform(5, W - 5),
            rng.uniform(5, H - 5),
            rng.uniform(2, 6),
            rng.uniform(0.4, 1),
        )
        field = field + rng.uniform(20, 90) * np.exp(-((X - x) ** 2 + ((Y - y) / flat) ** 2) / 2 / sigma**2)
    return field


def soft(rng: np.random.Generator) -> np.ndarray:
    """A scene out of focus."""
    field = cv2.GaussianBlur(rng.normal(size=(H, W)).astype(np.float32), (0, 0), rng.uniform(3, 12))
    return 100 + rng.uniform(10, 35) * field / field.std()


def dark(rng: np.random.Generator) -> np.ndarray:
    """A nearly dark, slowly changing field with a few hot pixels."""
    field = rng.uniform(2, 40) * (1 + rng.uniform(-0.8, 0.8) * (X / W - 0.5))
    hot = rng.integers(0, 8)
    field[rng.integers(0, H, hot), rng.integers(0, W, hot)] += rng.uniform(20, 200, hot)
    return field.astype(np.float32)


SCENES: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    scene.__name__: scene for scene in (cloud, leaves, board, mixed, glints, soft, dark)
}


@dataclass(frozen=True)
class Laser:
    """A spot to draw: centre and sigma in px, amplitude in numbers of 8 bit, ghost as a fraction of that."""

    x: float
    y: float
    amplitude: float
    sigma: float
    ghost: float = 0.0
    ghost_distance: float = 10.0
    ghost_angle: float = 0.0

    @classmethod
    def random(cls, rng: np.random.Generator, low: float = 90, high: float = 400, sigma: float = 3.0) -> Laser:
        """Any laser within the field; every second one with a ghost."""
        return cls(
            rng.uniform(12, W - 13),
            rng.uniform(12, H - 13),
            rng.uniform(low, high),
            rng.uniform(1.0, sigma),
            0.1 if rng.random() < 0.5 else 0.0,
            rng.uniform(8, 12),
            rng.uniform(0, 2 * np.pi),
        )

    def drawn(self, shape: tuple[int, int] = (H, W)) -> np.ndarray:
        """Return the light of spot and ghost, [H, W]."""
        y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)

        def bell(cx: float, cy: float) -> np.ndarray:
            return np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * self.sigma**2))

        light = self.amplitude * bell(self.x, self.y)
        if self.ghost:
            away = self.ghost_distance * np.array([np.cos(self.ghost_angle), np.sin(self.ghost_angle)])
            light = light + self.ghost * self.amplitude * bell(self.x + away[0], self.y + away[1])
        return light


def expose(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return 8 bit numbers with shot noise (40 electrons a number) and read noise."""
    light = np.clip(light, 0, None)
    noise = np.sqrt(light / 40 + 1.5**2) * rng.normal(size=light.shape)
    return np.clip(np.rint(light + noise), 0, 255).astype(np.uint8)
