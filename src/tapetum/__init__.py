"""Tapetum turns the light a camera throws back into knowledge of that camera.

The names below are loaded when first used, so that `import tapetum` stays quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tapetum.bench import Scene, load_scene
    from tapetum.data import build_dataset, open_dataset
    from tapetum.detection import find_cameras
    from tapetum.errors import InputError
    from tapetum.models import ResNet18, ZernikeRidge, load_model, pretrained, save_model
    from tapetum.record import Session, film, label_recording, open_frames, open_recording
    from tapetum.simulate import Camera, Image, expose, fisher, link_budget, retroreflect
    from tapetum.track import detect, track

    __version__: str

_HOME = {
    "bench": ("Scene", "load_scene"),
    "data": ("build_dataset", "open_dataset"),
    "detection": ("find_cameras",),
    "errors": ("InputError",),
    "models": ("ResNet18", "ZernikeRidge", "load_model", "pretrained", "save_model"),
    "record": ("Session", "film", "label_recording", "open_frames", "open_recording"),
    "simulate": ("Camera", "Image", "expose", "fisher", "link_budget", "retroreflect"),
    "track": ("detect", "track"),
}
_ROOM = {name: room for room, names in _HOME.items() for name in names}

__all__ = [
    "Camera",
    "Image",
    "InputError",
    "ResNet18",
    "Scene",
    "Session",
    "ZernikeRidge",
    "build_dataset",
    "detect",
    "expose",
    "film",
    "find_cameras",
    "fisher",
    "label_recording",
    "link_budget",
    "load_model",
    "load_scene",
    "open_dataset",
    "open_frames",
    "open_recording",
    "pretrained",
    "retroreflect",
    "save_model",
    "track",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("tapetum")
    if name not in _ROOM:
        raise AttributeError(f"module 'tapetum' has no attribute {name!r}")
    room = importlib.import_module(f"tapetum.{_ROOM[name]}")
    # The room `track` is callable itself: a name cannot be both a package and a function in it.
    return room if name == "track" else getattr(room, name)


def __dir__() -> list[str]:
    return sorted(
        {*__all__, "__version__", *(name for name in globals() if name.startswith("__") and name.endswith("__"))}
    )
