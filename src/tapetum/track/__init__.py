"""Frames → detections → tracks → estimates.

`detect` finds the retro-reflections in a frame, `Tracker` follows them, `track` does both for a whole
source and asks the models about each. It knows neither where frames come from nor where results go.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from tapetum.track.detect import detect
from tapetum.track.detections import Detections
from tapetum.track.pipeline import TrackSummary, track, track_to_file
from tapetum.track.rows import TrackedFrame, TrackRow, retrack
from tapetum.track.tables import read_tracks, track_schema, write_tracks
from tapetum.track.tracker import Tracker, TrackPoint

__all__ = [
    "Detections",
    "TrackPoint",
    "TrackRow",
    "TrackSummary",
    "TrackedFrame",
    "Tracker",
    "detect",
    "read_tracks",
    "retrack",
    "track",
    "track_schema",
    "track_to_file",
    "write_tracks",
]


class _Room(ModuleType):
    """The room under its own name, callable: `tapetum.track(source)` is `tapetum.track.track(source)`.

    Importing this package makes it the attribute `track` of `tapetum`, where the function of that name belongs too.
    """

    def __call__(self, *args: Any, **options: Any) -> Iterator[TrackedFrame]:
        return track(*args, **options)


sys.modules[__name__].__class__ = _Room
# `help(tapetum.track)` and a notebook's `tapetum.track?` then describe the function first.
__signature__ = inspect.signature(track)
__doc__ = f"{track.__doc__}\nThe room of this name: {__doc__}"
