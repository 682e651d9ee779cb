"""When a target images: its camera app is open, or its shutter. An idle sensor returns no light, its filter does."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tapetum.bench import PhoneTarget, Scene
from tapetum.errors import InputError

__all__ = ["Imaging", "idle_scene", "imaging_scene"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Imaging:
    """Times at which a target begins and stops to image.

    Parameters
    ----------
    switches
        Times in seconds, rising, at which it changes from one state to the other.
    at_first
        Whether it images before the first of them.
    """

    switches: tuple[float, ...] = ()
    at_first: bool = True

    def __post_init__(self) -> None:
        times = np.array(self.switches)
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise InputError(f"must rise, are {self.switches}", where="imaging.switches", remedy="give rising seconds")

    @classmethod
    def draw(cls, seconds: float, rng: np.random.Generator, *, least: float = 2.0, most: float = 6.0) -> Imaging:
        """States of random length, in seconds, and a random first one."""
        lengths = rng.uniform(least, most, int(seconds / least) + 1)
        times = np.cumsum(lengths)
        return cls(tuple(times[times < seconds].tolist()), bool(rng.integers(2)))

    def share(self, times: Array, exposure: Array | float = 0.0) -> Array:
        """Return the share [T] of exposures around times [T] (both in seconds) in which the target images."""
        long = np.maximum(np.broadcast_to(exposure, times.shape), 1e-9)
        first, last = self._imaged(np.stack([times - long / 2, times + long / 2]))
        return np.clip(np.round((last - first) / long, 6), 0, 1)

    def _imaged(self, times: Array) -> Array:
        """Seconds of imaging up to times, up to a constant."""
        ends = np.array([times.min() - 1, *self.switches, times.max() + 1])
        images = (np.arange(len(ends) - 1) + int(not self.at_first)) % 2 == 0
        ends[0], ends[-1] = min(ends[0], *ends[1:]), max(ends[-1], *ends[:-1])
        return np.interp(times, ends, np.r_[0.0, np.cumsum(np.diff(ends) * images)])


def imaging_scene(scene: Scene) -> Scene:
    """The scene while its target images."""
    target = scene.target
    return replace(scene, target=replace(target, imaging=True)) if isinstance(target, PhoneTarget) else scene


def idle_scene(scene: Scene) -> Scene:
    """The scene while its target does not image: its sensor reflects nothing, the layers before it as always."""
    target = scene.target
    if isinstance(target, PhoneTarget):
        return replace(scene, target=replace(target, imaging=False))
    sensor = replace(target.sensor, reflectance=0.0, array=None, microlens=None, mask=None, diffuse=None)
    return replace(scene, target=replace(target, sensor=sensor))
