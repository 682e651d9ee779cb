from .detections import Detections
from .detector import detect
from .pipeline import TrackSummary, track, track_to_file
from .rows import TrackedFrame, TrackRow, retrack
from .tables import read_tracks, track_schema, write_tracks
from .tracker import Tracker, TrackPoint

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
