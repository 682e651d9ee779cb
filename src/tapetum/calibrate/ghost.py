"""Calibration of the beam splitter's ghost: its offset and ratio, for `track`, and as the second beam of scenes."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tapetum.bench.measured import GHOST_SCHEMA
from tapetum.calibrate.page import write_calibration
from tapetum.calibrate.uncertainty import Measured
from tapetum.calibrate.verdict import Check, verdict
from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.record.source import Frame
from tapetum.report.figures._style import MODELS, QUIET, dress, new_figure
from tapetum.track.detections import Detections
from tapetum.track.ghosts import APART, Ghost, ghost_apart, ghost_of, ghost_pairs
from tapetum.track.pipeline import make_detector

__all__ = ["GhostCalibration", "calibrate_second_beam"]

_FRAMES, _SATURATED, _MOVED, _HELD = 20, 0.2, 30.0, 0.5


@dataclass(frozen=True, eq=False)
class GhostCalibration:
    """A calibrated ghost.

    Attributes
    ----------
    ghost
        Where it stands, for the tracker.
    dx, dy, ratio
        Offset in pixels and ratio of heights, with standard uncertainties: the scatter of single frames, because a
        spot's shape, which moves its centroid, follows the target's gaze and does not average out in one film. Where
        the two spots touch, the bright one cuts the ghost, and a quarter of its diameter is added.
    pairs
        [N, 5] of the frames that agree: see `tapetum.track.ghosts.ghost_pairs`.
    frames, paired, saturated
        Frames read, that show two spots or more, and whose brightest spot saturates.
    moved, diameter
        Largest extent of the bright spot's way, and its median diameter, in pixels.
    angle
        Of the second beam, along x and y in radians, with uncertainties; None without focal length and pitch.
    """

    ghost: Ghost
    dx: Measured
    dy: Measured
    ratio: Measured
    pairs: NDArray[np.float64]
    frames: int
    paired: int
    saturated: int
    moved: float
    diameter: float
    angle: tuple[Measured, Measured] | None

    @property
    def held(self) -> int:
        """Frames that agree."""
        return len(np.unique(self.pairs[:, 0]))

    @property
    def verdict(self) -> str:
        """`good`, or which checks failed."""
        return verdict(self.checks())

    def checks(self) -> list[Check]:
        """Return what was checked."""
        share = self.saturated / max(self.frames, 1)
        away = math.hypot(self.dx.value, self.dy.value)
        return [
            Check(
                "offset over the spots' diameter",
                f"{away / self.diameter:.2f}",
                f"{APART:g} or more",
                away >= APART * self.diameter,
                "the bright spot touches the ghost and cuts it: make the spots smaller by the target's focus",
            ),
            Check(
                "frames that agree",
                str(self.held),
                f"{_FRAMES} or more",
                self.held >= _FRAMES,
                "film for longer",
            ),
            Check(
                "share of frames with two spots that agree",
                f"{100 * self.held / max(self.paired, 1):.0f} %",
                f"{100 * _HELD:.0f} % or more",
                self.held >= _HELD * self.paired,
                "film one camera alone: other spots are in view",
            ),
            Check(
                "saturated frames",
                f"{100 * share:.0f} %",
                f"{100 * _SATURATED:.0f} % or less",
                share <= _SATURATED,
                "shorten the exposure: the height of a saturated spot is unknown",
            ),
            Check(
                "way of the bright spot",
                f"{self.moved:.0f} px",
                f"{_MOVED:g} px or more",
                self.moved >= _MOVED,
                "move the camera through the frame: a lamp that stands would look like a ghost",
            ),
        ]

    def numbers(self) -> list[tuple[str, str]]:
        """Return what was measured, with standard uncertainties, as text."""
        told = [
            ("offset along x", f"{self.dx} px"),
            ("offset along y", f"{self.dy} px"),
            ("ratio of heights", f"{self.ratio}"),
            ("reach in which it is dropped", f"{self.ghost.reach:g} px"),
        ]
        if self.angle is not None:
            for axis, one in zip("xy", self.angle, strict=True):
                told.append((f"second beam along {axis}", f"{Measured(1e3 * one.value, 1e3 * one.error)} mrad"))
        return [*told, ("frames", f"{self.held} of {self.frames} agree")]

    def as_dict(self) -> dict[str, Any]:
        """Return what was measured as plain values."""
        told: dict[str, Any] = {
            name: {"value": float(f"{one.value:.6g}"), "error": float(f"{one.error:.3g}")}
            for name, one in (("dx", self.dx), ("dy", self.dy), ("ratio", self.ratio))
        }
        return {**told, "frames": self.frames, "agree": self.held, "saturated": self.saturated}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the YAML file for `track --ghost`, and, where the angle is known, for a scene's second beam."""
        ghost = {name: getattr(self.ghost, name) for name in ("dx", "dy", "ratio", "reach")}
        content: dict[str, Any] = {"ghost": ghost}
        if self.angle is not None:
            angles = [float(f"{one.value:.6g}") for one in self.angle]
            content["second_beam"] = {"ratio": float(f"{self.ratio.value:.6g}"), "angle": angles}
        content |= {"verdict": self.verdict, "measured": self.as_dict()}
        text = f"# Written by tapetum calibrate ghost: offsets in pixels, angles in radians.\nschema: {GHOST_SCHEMA}\n"
        with atomic_file(path) as part:
            part.write_text(
                text + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110), "utf-8"
            )

    def figure(self) -> Figure:
        """Draw the offsets and the ratios of the frames that agree."""
        figure = new_figure(8.5, 3.6)
        left, right = figure.subplots(1, 2)
        left.plot(self.pairs[:, 1], self.pairs[:, 2], "o", color=MODELS[0], markersize=3, alpha=0.5)
        left.errorbar(
            self.dx.value, self.dy.value, self.dy.error, self.dx.error, "s", color=MODELS[1], markersize=5, capsize=3
        )
        left.invert_yaxis()
        left.set_aspect("equal", adjustable="datalim")
        dress(left, title="Offset of the ghost", x="along x, px", y="along y (down), px", letter="a")
        right.plot(self.pairs[:, 0], np.exp(self.pairs[:, 3]), "o", color=MODELS[0], markersize=3)
        right.axhline(self.ratio.value, color=QUIET, linewidth=1)
        right.set_ylim(bottom=0)
        dress(right, title="Height over the bright spot's", x="frame", letter="b")
        return figure

    def write_page(self, path: str | os.PathLike[str]) -> None:
        """Write the page: verdict, numbers, pictures and checks."""
        write_calibration(
            path,
            "Calibration of a beam splitter's ghost",
            self.checks(),
            self.numbers(),
            self.figure(),
            alt=f"Offsets of the ghost in {self.held} frames: {self.dx}, {self.dy} px, ratio {self.ratio}.",
            caption="(a) From the bright spot to the ghost, frame by frame, and the middle with its uncertainty. "
            "(b) The ghost's height over the bright spot's.",
            notes=["The ratio of heights is that of the beams' powers as far as both spots have one shape."],
        )


def calibrate_second_beam(
    frames: Iterable[Frame],
    *,
    detector: str = "spots",
    focal_length: float | None = None,
    pitch: float | None = None,
) -> GhostCalibration:
    """Measure the ghost of the probe's beam splitter in frames of one bright, moving RR.

    Parameters
    ----------
    frames, detector
        The probe's frames, and what finds the spots in them.
    focal_length, pitch
        Of the probe's lens and sensor in metres: with both the second beam's angle is known too.

    Raises
    ------
    InputError
        When no offset holds in half of the frames that show two spots, and five at least.
    """
    # The rule of the bench would drop whatever is dim near a brighter one, marked or not.
    free = {"ghost_ratio": 0.0, "stray": 0.0} if detector == "spots" else {}
    find = make_detector(detector, {**free, "ghosts": "mark"})
    count = paired = saturated = 0
    places: list[tuple[float, float]] = []

    def found() -> Iterable[Detections]:
        nonlocal count, paired, saturated
        for frame in frames:
            spots = find(frame)
            count += 1
            paired += len(spots) > 1
            if len(spots):
                brightest = int(np.argmax(spots.peak))
                saturated += bool(spots.saturated[brightest])
                places.append((float(spots.x[brightest]), float(spots.y[brightest])))
            yield spots

    try:
        pairs = ghost_pairs(found())
    except InputError as error:
        # Of the frames an error names the file; of the ghost the option of another command.
        if error.where != "--calibrate-ghost":
            raise
        raise InputError(error.what, where="calibrate ghost", remedy=error.remedy) from error
    ghost = ghost_of(pairs)
    spread = pairs[:, 1:4].std(axis=0, ddof=1)
    diameter = float(np.median(pairs[:, 4]))
    way = np.median(pairs[:, 1:3], axis=0)
    cut = 0.0 if ghost_apart(pairs) >= APART else diameter / 4
    along = np.abs(way) / math.hypot(*way)
    ratio = math.exp(float(np.median(pairs[:, 3])))
    dx, dy = (Measured(float(way[n]), float(math.hypot(spread[n], cut * along[n]))) for n in (0, 1))
    angle = None
    if focal_length is not None and pitch is not None:
        scale = pitch / focal_length
        # The sign is that of `Ghost.of`: the probe's picture is turned by half a turn against the target's plane.
        angle = (_angle(dx, scale), _angle(dy, scale))
    moved = float(np.ptp(np.array(places), axis=0).max()) if places else 0.0
    return GhostCalibration(
        ghost,
        dx,
        dy,
        Measured(ratio, ratio * float(spread[2])),
        pairs,
        count,
        paired,
        saturated,
        moved,
        diameter,
        angle,
    )


def _angle(offset: Measured, scale: float) -> Measured:
    return Measured(-math.atan(offset.value * scale), offset.error * scale)
