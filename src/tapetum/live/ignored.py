"""Cameras that are ours, about which nothing is reported."""

from __future__ import annotations

import functools
import hashlib
import json
import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from tapetum.live.state import CameraState

__all__ = ["Ignored"]


@dataclass(frozen=True)
class Ignored:
    """A camera that is ours, by place, by device or by look.

    Parameters
    ----------
    x, y, radius
        Everything within so many pixels of a place is ours.
    device
        Every camera of this device is.
    looks, tolerance
        Looks of it that were seen (see `tapetum.live.look`), and how far another look may lie from them. One camera at
        a time is taken for it.
    """

    x: float = 0.0
    y: float = 0.0
    radius: float = 0.0
    device: str = ""
    looks: tuple[tuple[float, ...], ...] = ()
    tolerance: float = 0.0

    def holds(self, camera: CameraState) -> bool:
        """Return whether a camera is this one by place or device."""
        if self.looks:
            return False
        if self.device:
            return camera.device == self.device
        return math.dist((self.x, self.y), (camera.x, camera.y)) <= self.radius

    @functools.cached_property
    def id(self) -> str:
        """A short name, which follows from all the rest."""
        return hashlib.sha256(self.as_text().encode()).hexdigest()[:12]

    def as_text(self) -> str:
        """Return it as JSON; see `from_text`."""
        return json.dumps({one.name: getattr(self, one.name) for one in fields(self)})

    @classmethod
    def from_text(cls, text: str) -> Ignored:
        """Return what `as_text` wrote."""
        read = json.loads(text)
        return cls(**{**read, "looks": tuple(tuple(one) for one in read.get("looks", ()))})

    @functools.cached_property
    def known(self) -> NDArray[np.float64]:
        """The looks as an array [N, numbers]."""
        return np.array(self.looks)
