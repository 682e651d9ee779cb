"""A fit by simulation made from a scene's file, such as a twin, with what the twin's numbers add to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tapetum.bench import load_scene
from tapetum.checked import read_json
from tapetum.errors import InputError
from tapetum.models.simulation.fit import SimulationFit
from tapetum.models.simulation.pictures import period_of
from tapetum.models.simulation.search import PHASE
from tapetum.record.marks import scene_mark

__all__ = ["SCENE_SUFFIXES", "read_by_scene"]

SCENE_SUFFIXES = (".yaml", ".yml")
"""Endings of the files that hold scenes."""

# The best match and its opposite: between them lie the two gazes whose pictures are alike.
_STARTS = 2
_TWIN = "tapetum-twin"


def read_by_scene(path: str | Path) -> SimulationFit:
    """Return an estimator of the gaze that reads frames by simulating the scene in a YAML file.

    The numbers of a twin, NAME.json beside NAME.yaml, are used where they are there. The gaze's systematic deviations
    widen the intervals; the sensor's fixed pattern, and whether the target rolls, are as they were in the fit. Where
    photosites show, their place under the spot counts as unknown.

    Raises
    ------
    InputError
        For a scene that cannot be read or fitted, and for numbers beside it that belong to another scene.
    """
    path = Path(path)
    scene = load_scene(path)
    numbers = _numbers(path.with_suffix(".json"))
    if numbers and numbers.get("scene") != scene_mark(scene):
        what = f"holds the numbers of another scene than {path.name}"
        remedy = "fit the twin again, or move this file away: intervals then hold the noise alone"
        raise InputError(what, where=path.with_suffix(".json"), remedy=remedy)
    options = numbers.get("options", {})
    unknown = ["power", "place_x", "place_y", *(PHASE if period_of(scene) is not None else ())]
    try:
        return SimulationFit(
            scene,
            nuisances=(*unknown, *(("roll",) if options.get("roll") else ())),
            starts=_STARTS,
            unevenness=float(options.get("unevenness", 0.0)),
            offsets=options.get("offsets", (0.0, 0.0)),
            systematic=numbers.get("systematic", (0.0, 0.0)),
        )
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        what = f"holds numbers that cannot be used ({error})"
        raise InputError(what, where=path.with_suffix(".json"), remedy="fit the twin again") from error


def _numbers(path: Path) -> dict[str, Any]:
    """Return a twin's numbers; none where there is no such file, one of something else, or an older twin's."""
    try:
        told = read_json(path)
    except (FileNotFoundError, ValueError, OSError):
        return {}
    return told if isinstance(told, dict) and told.get("format") == _TWIN and "scene" in told else {}
