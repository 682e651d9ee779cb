"""The ghost of the probe's beam splitter: every retro-reflection has a dim companion at one offset and ratio.

Once it is calibrated, with one camera alone in view, a second camera near a brighter one is not taken for it.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tapetum.bench import Scene
from tapetum.bench.measured import GHOST_SCHEMA, read_measured
from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.track.detections import Detections

__all__ = ["APART", "Ghost", "calibrate_ghost", "ghost_apart", "ghost_of", "ghost_pairs", "is_ghost"]

APART = 1.3
"""Diameters of the bright spot between it and its ghost from which it does not cut the ghost."""

_FORMAT = "tapetum-ghost"
_YAML = (".yaml", ".yml")
# Half the width of the band of ratios that a ghost may have: twice, for noise and fringes.
_FACTOR = 2.0
_DIMMER = 0.5
# How far from its place the middle of a smeared ghost may lie, as a share of its diameter and of the way to its bright
# spot.
_ON_THE_WAY = 0.6
# The second beam's light has another gaze, so that its spot may be cut elsewhere: in pixels, and as a share of the
# bright spot's diameter.
_REACH_OF_A_SCENE, _CUT = 15.0, 0.4
# How far offsets of one ghost may lie apart: in pixels, and as a share of the spots' diameter.
_WITHIN, _OF_SIZE = 3.0, 0.1
_FEWEST = 5
_LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Ghost:
    """Where a ghost stands and how bright it is.

    Parameters
    ----------
    dx, dy
        From the retro-reflection to its ghost, in pixels.
    ratio
        Height of the ghost over its retro-reflection's, below 1.
    reach
        How far from there it may be, in pixels.

    Raises
    ------
    InputError
        When a number is not finite or out of range.
    """

    dx: float
    dy: float
    ratio: float
    reach: float = 3.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.dx) and math.isfinite(self.dy) and math.hypot(self.dx, self.dy) > self.reach > 0):
            what = f"offset ({self.dx}, {self.dy}) px must be finite and farther than its reach, {self.reach} px"
            raise InputError(what, where="ghost")
        if not 0 < self.ratio < 1:
            raise InputError(f"ratio must lie between 0 and 1, is {self.ratio}", where="ghost")

    def among(
        self,
        x: NDArray[np.float64],
        y: NDArray[np.float64],
        peak: NDArray[np.float64],
        saturated: NDArray[np.generic],
        diameter: NDArray[np.float64] | None = None,
    ) -> NDArray[np.bool_]:
        """Which spots [N] are the ghost of another; one spot has one ghost, the nearest to where it is due.

        Of a saturated spot the true height is unknown: its ghost may be brighter than the ratio says. A ghost that
        touches its bright spot is cut, or runs into what that left; with `diameter` (pixels) a spot that touches it is
        its ghost where it covers the place, and so is one wider than it.
        """
        ghost = np.zeros(len(x), bool)
        for n in np.argsort(-peak, kind="stable"):
            if ghost[n]:
                continue
            off = np.hypot(x - x[n] - self.dx, y - y[n] - self.dy)
            share = peak / max(float(peak[n]), 1e-12) / self.ratio
            near = off <= self.reach
            if diameter is not None:
                near |= off <= _CUT * diameter[n]
                away = math.hypot(self.dx, self.dy)
                touching = (diameter > diameter[n]) | ((diameter + diameter[n]) / 2 > away)
                near |= touching & (off <= _ON_THE_WAY * np.minimum(diameter, away))
            fits = near & (share >= 1 / _FACTOR) & (share <= (math.inf if saturated[n] else _FACTOR))
            fits &= (peak < peak[n]) & ~ghost
            if fits.any():
                ghost[np.argmin(np.where(fits, off, np.inf))] = True
        return ghost

    @classmethod
    def of(cls, scene: Scene) -> Ghost:
        """The ghost that a scene's second beam makes, at infinity's focus of its probe.

        Raises
        ------
        InputError
            When the scene has no second beam.
        """
        beam, probe = scene.illumination.second_beam, scene.probe
        if beam is None or beam.ratio == 0:
            raise InputError("has none, so that there is no ghost", where="illumination.second_beam")
        dx, dy = (-probe.lens.focal_length * math.tan(angle) / probe.sensor.pitch for angle in beam.angle)
        return cls(dx, dy, beam.ratio, _REACH_OF_A_SCENE)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it as JSON."""
        with atomic_file(path) as part:
            part.write_text(json.dumps({"format": _FORMAT, "version": 1, **asdict(self)}, indent=1) + "\n", "utf-8")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Ghost:
        """Read what `save` wrote, or `tapetum calibrate ghost` (`.yaml`).

        Raises
        ------
        InputError
            When the file is missing, damaged or none of these.
        """
        remedy = "give a file that `tapetum track --calibrate-ghost` wrote"
        if not Path(path).is_file():
            raise InputError("no such file", where=path, remedy=remedy)
        try:
            if Path(path).suffix.lower() in _YAML:
                known = read_measured(path, GHOST_SCHEMA, "calibrate ghost")["ghost"]
                return cls(**{name: float(known[name]) for name in ("dx", "dy", "ratio", "reach")})
            known = json.loads(Path(path).read_text("utf-8"))
            if known.get("format") != _FORMAT or known.get("version") != 1:
                raise InputError("is no calibrated ghost of version 1", where=path, remedy=remedy)
            return cls(**{name: float(known[name]) for name in ("dx", "dy", "ratio", "reach")})
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError("is no calibrated ghost", where=path, remedy=remedy) from error


def is_ghost(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is named or written as a calibrated ghost, and not as a scene."""
    file = Path(path)
    if file.suffix.lower() not in _YAML or not file.is_file():
        return file.suffix.lower() == ".json"
    return GHOST_SCHEMA.encode() in file.read_bytes()[:4096]


def calibrate_ghost(frames: Iterable[Detections]) -> Ghost:
    """Find the ghost in detections of frames that show one camera, or several, each with its ghost.

    Of every spot and each dimmer one the offset is taken; where most frames agree stands the ghost.

    Parameters
    ----------
    frames
        Spots of each frame, ghosts not dropped.

    Raises
    ------
    InputError
        When no offset with one ratio holds in half of the frames that show two spots or more, and in five at least.
    """
    return ghost_of(ghost_pairs(frames))


def ghost_of(pairs: NDArray[np.float64]) -> Ghost:
    """Return the ghost in the middle of `ghost_pairs`."""
    dx, dy, ratio = np.median(pairs[:, 1:4], axis=0)
    spread = float(np.median(np.hypot(pairs[:, 1] - dx, pairs[:, 2] - dy)))
    return Ghost(round(float(dx), 3), round(float(dy), 3), round(math.exp(ratio), 5), round(max(2.0, 4 * spread), 2))


def ghost_apart(pairs: NDArray[np.float64]) -> float:
    """Return the way from spot to ghost over the spot's diameter, of `ghost_pairs`; see `APART`."""
    return float(np.hypot(*np.median(pairs[:, 1:3], axis=0)) / np.median(pairs[:, 4]))


def ghost_pairs(frames: Iterable[Detections]) -> NDArray[np.float64]:
    """Return the pairs of spot and ghost, [N, 5]: frame, offset x and y in pixels, logarithm of the ratio of heights,
    and the bright spot's diameter in pixels.

    Parameters and errors as of `calibrate_ghost`.
    """
    found: list[tuple[float, ...]] = []
    shown = 0
    for frame, spots in enumerate(frames):
        if len(spots) > 1:
            shown += 1
        for n in range(len(spots)):
            for k in np.flatnonzero((spots.peak < _DIMMER * spots.peak[n]) & (spots.saturated == 0)):
                if spots.saturated[n]:
                    continue
                offset = float(spots.x[k] - spots.x[n]), float(spots.y[k] - spots.y[n])
                height = math.log(float(spots.peak[k] / spots.peak[n]))
                found.append((frame, *offset, height, float(spots.diameter[n])))
    pairs = np.array(found).reshape(-1, 5)
    remedy = "film one camera that is not saturated, alone in view, as it moves through the frame"
    best: tuple[int, NDArray[np.bool_]] | None = None
    # The two spots see different gazes, so that their shapes and their middles differ by a part of their size.
    within = max(_WITHIN, _OF_SIZE * float(np.median(pairs[:, 4]))) if found else _WITHIN
    for one in pairs:
        near = (np.hypot(*(pairs[:, 1:3] - one[1:3]).T) <= within) & (np.abs(pairs[:, 3] - one[3]) <= math.log(_FACTOR))
        count = len(np.unique(pairs[near, 0]))
        if best is None or count > best[0]:
            best = count, near
    if best is None or best[0] < _FEWEST or best[0] < _LEAST_SHARE * shown:
        held = 0 if best is None else best[0]
        what = f"no ghost was found: the best offset holds in {held} of {shown} frames that show two spots or more"
        raise InputError(what, where="--calibrate-ghost", remedy=remedy)
    return pairs[best[1]]
