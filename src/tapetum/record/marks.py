"""Marks by which films of one camera are recognised: the recording, and on the virtual bench the copy of the camera.

A model keeps the marks of the films that it was trained on, and so knows whether further frames show the same copy. For
a real camera the marks show only whether it is the same recording; the rest a person has to say (`--unit`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from tapetum.bench import Scene
from tapetum.bench.load import scene_dict

__all__ = ["recording_mark", "recording_marks", "scene_mark"]


def recording_mark(uuid: str) -> str:
    """Return the mark of a recording."""
    return f"recording:{uuid}"


def scene_mark(scene: Scene | Mapping[str, Any]) -> str:
    """Return the mark of a scene: of target, distance, light, and the probe's lens and pitch.

    What changes from one film of a copy to the next has no part in it: the target's turn, the laser's power, the
    probe's frame and exposure, and how finely the scene is computed.
    """
    told = scene_dict(scene) if isinstance(scene, Scene) else scene
    target, light, probe = (dict(told.get(name) or {}) for name in ("target", "illumination", "probe"))
    target.pop("rotation", None)
    light.pop("power", None)
    pitch = (probe.get("sensor") or {}).get("pitch")
    same = [told.get("distance"), target, light, probe.get("lens"), pitch]
    return f"scene:{hashlib.sha256(json.dumps(same, sort_keys=True).encode()).hexdigest()[:32]}"


def recording_marks(told: Mapping[str, Any]) -> frozenset[str]:
    """Return the marks of a recording by what it or a dataset says of it: its uuid and its scene, where known.

    The scene of a bench with further cameras has no mark, as frames may show any of them; nor has one whose target
    walks.
    """
    marks = {recording_mark(str(told["uuid"]))} if told.get("uuid") else set()
    parameters = told.get("parameters")
    told = parameters if isinstance(parameters, Mapping) else told
    walks = (told.get("motion") or {}).get("walk")
    if isinstance(told.get("scene"), Mapping) and not told.get("others") and not walks:
        marks.add(scene_mark(told["scene"]))
    return frozenset(marks)
