"""The judge's traced lens head on: the middle of the picture, where everything is round.

Rays along one line from the axis to the rim, in their images of the stop, stand for rings; their waves at the sensor
are sums over exact distances, whose azimuth is a series of Bessel functions. What a pixel in the middle receives is the
sum of the squared field over the sensor (reciprocity). So it reaches light that is too far out of focus for sums over
two dimensions: hundreds of the spot's rings, where rings count until they fade by one over their number.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import jv

from tapetum.optics.focus import FocusedLens

from .quadrature import Complex, Real, legendre, phasor
from .rays import Traced
from .traced import _landing, _wave

__all__ = ["middle", "of_engine"]

# Dark rings beyond the rays, and half of them.
_RINGS = (112.0, 224.0)
_TERMS = 5


def of_engine(focused: FocusedLens) -> Traced:
    """The judge's lens with the surfaces and the sensor where the engine has them: it moves no groups of a zoom."""
    lens = focused.lens
    aspheres = tuple(tuple((n + 2, a) for n, a in enumerate(row) if a) for row in lens.asphere.tolist())
    numbers = (tuple(one.tolist()) for one in (lens.z, lens.curvature, lens.conic))
    return Traced(
        *numbers,
        aspheres,
        tuple(lens.semi_diameter.tolist()),
        tuple(lens.index.tolist()),
        lens.stop,
        focused.entrance_pupil,
        focused.image,
    )


def middle(lens: Traced, wavelength: float, probe_focal_length: float) -> float:
    """Irradiance of the picture's middle for 1 W/m² of collimated light and a perfect mirror, to the far field.

    The error of a window falls with one over its rings: two of them tell what none would leave out.
    """
    less, more = _amplitudes(lens, 2 * math.pi / wavelength)
    return abs((2 * more - less) / (wavelength * probe_focal_length)) ** 2


def _amplitudes(lens: Traced, k: float) -> list[complex]:
    """By each window; the field in the widest serves all."""
    zero = np.zeros(2)
    coarse = _wave(lens, zero, 0.0, 1, 40, k)
    sine = float(np.abs(coarse.direction[:, :2]).max())
    _, spread = _landing(coarse, lens.image)
    halves = [spread + rings * math.pi / (k * sine) for rings in _RINGS]
    half = max(halves)
    turns = k * sine / (2 * math.pi)
    wave = _wave(lens, zero, 0.0, 1, math.ceil(4 * turns * (spread + half) + 40), k)
    nodes, weights = legendre(math.ceil(6 * turns * half + 40))
    place, share = (nodes + 1) / 2 * half, weights * half / 2
    summed = _rings(wave.position, wave.strength, wave.path, lens.image, place, k) ** 2 * 2 * math.pi * place * share
    fades = (np.clip(2 * (one - place) / (one - spread), 0, 1) for one in halves)
    return [complex((summed * (1 - np.cos(math.pi * fade)) / 2).sum()) for fade in fades]


def _rings(position: Real, strength: Real, path: Real, image: float, place: Real, k: float) -> Complex:
    """The field at distances `place` [M] from the axis of rings [N], whose rays are known along one line."""
    r, z = np.hypot(position[:, 0], position[:, 1])[:, None], (image - position[:, 2])[:, None]
    far = np.sqrt(r**2 + place**2 + z**2)
    # √(R² - 2 r u cosφ) = R (1 - x cosφ - x² cos²φ/2 - …), x = r u/R².
    x = r * place / far**2
    a, b = k * far * x, k * far * x**2 / 4
    azimuth = jv(0, b) * jv(0, a) + 2 * sum(1j**m * jv(m, b) * jv(2 * m, a) for m in range(1, _TERMS))
    wave = phasor(k * (far + path[:, None]) - b) * azimuth / far
    return (strength[:, None] * k / (2 * math.pi) * wave).sum(0)
