"""What an interrupted search for a twin keeps: a JSON file, written whole after every step."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.calibrate.twin.normal_equations import State
from tapetum.calibrate.twin.result import Before
from tapetum.checked import read_json
from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.models.simulation.pictures import Pose

__all__ = ["Kept"]

Array = NDArray[np.float64]
_FORMAT = "tapetum-twin-state"


@dataclass(eq=False)
class Kept:
    """The progress of a search; without a path nothing is written.

    Attributes
    ----------
    path, digest
        The file, and what identifies the search.
    before
        How well the scene explained the frames as it was.
    starts, searched
        Coordinates of the starts, and those found from them with their log-likelihoods and misfits.
    search, whole
        The state of the search from one start, and of that over all frames.
    scatter
        Of the frames' brightness.
    """

    path: Path | None
    digest: str
    before: Before | None = None
    starts: list[Array] | None = None
    searched: list[tuple[Array, float, float]] = field(default_factory=list)
    search: State | None = None
    whole: State | None = None
    scatter: float | None = None

    @classmethod
    def open(cls, path: Path | None, digest: str) -> Kept:
        """Return what a file keeps of this very search, or an empty one.

        Raises an InputError for a file of another search, or none at all.
        """
        kept = cls(path, digest)
        if path is None or not path.exists():
            return kept
        remedy = "remove it to begin again"
        try:
            content = read_json(path)
            if content["format"] != _FORMAT:
                raise ValueError
            if content["digest"] != digest:
                what = "keeps a search with another recording, scene or options"
                raise InputError(what, where=path, remedy=f"give those, or {remedy}")
            kept.before = Before(**content["before"]) if content["before"] else None
            kept.starts = None if content["starts"] is None else [np.array(one) for one in content["starts"]]
            kept.searched = [(np.array(one), float(value), float(left)) for one, value, left in content["searched"]]
            kept.search, kept.whole = _state(content["search"]), _state(content["whole"])
            kept.scatter = content["scatter"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError("keeps no search for a twin", where=path, remedy=remedy) from error
        return kept

    def searching(self, state: State) -> None:
        """Keep the state of the search from a start."""
        self.search = state
        self.save()

    def done(self, coordinates: Array, log_likelihood: float, misfit: float) -> None:
        """Keep what was found from a start."""
        self.searched.append((coordinates, log_likelihood, misfit))
        self.search = None
        self.save()

    def wholly(self, state: State) -> None:
        """Keep the state of the search over all frames."""
        self.whole = state
        self.save()

    def save(self) -> None:
        """Write the file."""
        if self.path is None:
            return
        content = {
            "format": _FORMAT,
            "digest": self.digest,
            "before": None if self.before is None else asdict(self.before),
            "starts": None if self.starts is None else [one.tolist() for one in self.starts],
            "searched": [[one.tolist(), value, left] for one, value, left in self.searched],
            "search": _plain(self.search),
            "whole": _plain(self.whole),
            "scatter": self.scatter,
        }
        with atomic_file(self.path) as part:
            part.write_text(json.dumps(content), encoding="utf-8")


def _plain(state: State | None) -> dict[str, Any] | None:
    if state is None:
        return None
    return {
        "coordinates": state.coordinates.tolist(),
        "poses": [{name: _number(value) for name, value in asdict(pose).items()} for pose in state.poses],
        "slow": state.slow.tolist(),
    }


def _number(value: Any) -> Any:
    # JSON has no infinity, which an object distance may be.
    return "inf" if value == float("inf") else value


def _state(content: Any) -> State | None:
    if content is None:
        return None
    poses = [Pose(**{name: _read(value) for name, value in one.items()}) for one in content["poses"]]
    return State(np.array(content["coordinates"]), tuple(poses), np.array(content["slow"]).reshape(-1, 2))


def _read(value: Any) -> Any:
    return tuple(float(one) for one in value) if isinstance(value, list) else float(value)
