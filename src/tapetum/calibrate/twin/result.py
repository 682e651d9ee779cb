"""The result of a twin: its scene, what is known of each parameter, and how well it explains the recording."""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.bench import Scene, scene_yaml
from tapetum.calibrate.twin.normal_equations import Linear, Normal, by_parameters
from tapetum.calibrate.twin.search import LIMIT, covariance, untold
from tapetum.files import atomic_file
from tapetum.record.marks import scene_mark
from tapetum.record.recording import Recording

__all__ = ["Before", "Fitted", "Seen", "Twin", "twin_of"]

Array = NDArray[np.float64]
# Frames that are shown: some of all misfits.
_SHOWN = 5


@dataclass(frozen=True)
class Before:
    """How well the scene explained the frames as it was: log-likelihood without constants, and misfits."""

    log_likelihood: float
    misfit: float
    misfit_lit: float


@dataclass(frozen=True)
class Fitted:
    """One parameter of a twin.

    Attributes
    ----------
    name, unit
        Of the parameter.
    before, value, deviation
        The scene's value, the twin's, and its standard deviation; None where the recording does not determine it, and
        the value is the scene's.
    like
        Of one that is not determined: other parameters whose changes look like its own.
    spread
        Usual difference between copies of a camera, in the value's unit.
    """

    name: str
    unit: str
    before: float
    value: float
    deviation: float | None
    like: tuple[str, ...] = ()
    spread: float = math.nan

    @property
    def told(self) -> bool:
        """Whether the recording determines it."""
        return self.deviation is not None


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame with its fit: index, label and fitted gaze [2], misfit; [side, side] counts, expectation, deviations."""

    index: int
    label: Array
    gaze: Array
    misfit: float
    counts: Array | None = None
    expected: Array | None = None
    deviation: Array | None = None


@dataclass(frozen=True, eq=False)
class Twin:
    """A scene fitted to a recording.

    Attributes
    ----------
    scene, before
        The twin, and how well the scene explained the frames as it was.
    parameters
        What was fitted.
    misfit, misfit_lit
        Mean squared residual in variances, of all pixels of the windows and of those that the retro-reflection lights.
    log_likelihood
        Of the pixels, without constants.
    scatter
        Relative scatter of the frames' brightness.
    converged
        Whether the search did.
    covariance
        [P, P] of the parameters' coordinates (inverse distance and F-number, else the value), those not determined with
        their usual spread.
    frames
        The frames used; some with pictures.
    systematic
        Standard deviations of the gaze's x and y, in fractions of the field, that frames read with this twin have in
        common, since its parameters are not exactly known.
    recording, options
        Name and uuid of the recording, and how it was fitted.
    """

    scene: Scene
    before: Before
    parameters: tuple[Fitted, ...]
    misfit: float
    misfit_lit: float
    log_likelihood: float
    scatter: float
    converged: bool
    covariance: Array
    frames: tuple[Seen, ...]
    systematic: tuple[float, float]
    recording: Mapping[str, str]
    options: Mapping[str, Any]

    def __getitem__(self, name: str) -> Fitted:
        """Return one parameter."""
        return next(one for one in self.parameters if one.name == name)

    @property
    def explains(self) -> bool:
        """Whether the scene explains the recording."""
        return self.misfit_lit <= LIMIT

    @property
    def untold(self) -> tuple[Fitted, ...]:
        """Parameters that the recording does not determine."""
        return tuple(one for one in self.parameters if not one.told)

    @property
    def gain(self) -> float:
        """Log-likelihood over that of the scene as it was."""
        return self.log_likelihood - self.before.log_likelihood

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers."""
        return {
            "format": "tapetum-twin",
            "version": 1,
            "recording": dict(self.recording),
            "explains": self.explains,
            "misfit": self.misfit,
            "misfit_lit": self.misfit_lit,
            "limit": LIMIT,
            "log_likelihood": self.log_likelihood,
            "before": asdict(self.before),
            "gain": self.gain,
            "converged": self.converged,
            "scatter": self.scatter,
            "parameters": [_plain(one) for one in self.parameters],
            "covariance": self.covariance.tolist(),
            "systematic": list(self.systematic),
            "scene": scene_mark(self.scene),
            "frames": [
                {"index": one.index, "label": one.label.tolist(), "gaze": one.gaze.tolist(), "misfit": one.misfit}
                for one in self.frames
            ],
            "options": dict(self.options),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the scene as YAML, which `load_scene` reads."""
        lines = [
            f"# Twin of the camera in {self.recording['name']}, fitted by tapetum twin {_version()}.",
            f"# Misfit {self.misfit_lit:.3f} of the lit pixels, {self.before.misfit_lit:.3g} as the scene was.",
        ]
        for one in self.parameters:
            known = "not determined by this recording" if one.deviation is None else f"± {one.deviation:.2g}"
            lines.append(f"# {one.name}: {one.value:.6g} {known} ({one.unit})")
        with atomic_file(path) as part:
            part.write_text("\n".join(lines) + "\n" + scene_yaml(self.scene), encoding="utf-8")

    def save_numbers(self, path: str | os.PathLike[str]) -> None:
        """Write the numbers as JSON."""
        with atomic_file(path) as part:
            part.write_text(json.dumps(self.as_dict(), indent=1, allow_nan=False) + "\n", encoding="utf-8")

    def write_page(self, path: str | os.PathLike[str]) -> None:
        """Write a page with the numbers, and pictures of frames, fits and residuals."""
        from tapetum.calibrate.twin.page import write_twin

        write_twin(self, path)


def _version() -> str:
    return importlib.metadata.version("tapetum")


def _plain(one: Fitted) -> dict[str, Any]:
    # JSON has no infinity: a target may be focused there.
    def number(value: float | None) -> float | str | None:
        return value if value is None or math.isfinite(value) else str(value)

    plain = {name: number(getattr(one, name)) for name in ("before", "value", "deviation", "spread")}
    return {"name": one.name, "unit": one.unit, **plain, "told": one.told, "like": list(one.like)}


def twin_of(
    normal: Normal,
    linear: Linear,
    held: Sequence[int],
    before: Before,
    converged: bool,
    recording: Recording,
    options: Mapping[str, Any],
    unsure: Array,
) -> Twin:
    """Return the twin of a search that has ended; `unsure` [P, P], in squared spreads, is the simulation's part."""
    misfit, lit = linear.misfit(), linear.misfit(lit=True)
    known = covariance(linear.information, held) * max(1.0, misfit, lit) + unsure
    deviations = np.sqrt(known.diagonal()) * normal.spread
    names = [one.name for one in normal.parameters]
    like = {one.number: tuple(names[k] for k in one.like) for one in untold(linear.information)}
    fitted: list[Fitted] = []
    coordinates = linear.state.coordinates
    for n, one in enumerate(normal.parameters):
        own, at = one.read(normal.scene), float(coordinates[n])
        told = n not in held
        value = one.value(at) if told else one.value(own)
        deviation = one.deviation(at, float(deviations[n])) if told else None
        spread = one.deviation(at, one.spread)
        fitted.append(Fitted(one.name, one.unit, one.value(own), value, deviation, like.get(n, ()), spread))
    moved = [n for n in range(len(names)) if n not in held]
    scene = normal.scene
    for n in moved:
        scene = normal.parameters[n].write(scene, float(coordinates[n]))
    return Twin(
        scene,
        before,
        tuple(fitted),
        misfit,
        lit,
        linear.log_likelihood,
        normal.scatter,
        converged,
        known * np.outer(normal.spread, normal.spread),
        _seen(normal, linear),
        _systematic(linear, known),
        {"name": recording.name, "uuid": recording.uuid},
        options,
    )


def _systematic(linear: Linear, known: Array) -> tuple[float, float]:
    """Return the standard deviations of the gaze, x and y, by the parameters' covariance in squared spreads."""
    slopes = by_parameters(linear)
    x, y = np.sqrt(np.mean(np.einsum("nip,pq,niq->ni", slopes, known, slopes), axis=0))
    return float(x), float(y)


def _seen(normal: Normal, linear: Linear) -> tuple[Seen, ...]:
    misfits, gazes = linear.misfits(), linear.state.gazes
    order = np.argsort(misfits)
    shown = {int(order[k]) for k in np.linspace(0, len(order) - 1, min(_SHOWN, len(order))).round().astype(int)}
    pictures = normal.pictures(linear.state.coordinates)
    found: list[Seen] = []
    for n, frame in enumerate(normal.frames):
        one = Seen(frame.index, frame.gaze, gazes[n], float(misfits[n]))
        if n in shown:
            search, pose = normal.search(frame, pictures), linear.state.poses[n]
            mean, _ = search.tangent(pose, linear.state.slow[n], normal.names(pictures))
            expected, _, variance = normal.model(mean)
            shape = frame.counts.shape
            one = replace(
                one,
                counts=frame.counts,
                expected=expected.reshape(shape),
                deviation=np.sqrt(variance).reshape(shape),
            )
        found.append(one)
    return tuple(found)
