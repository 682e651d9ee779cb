from .acquire import Acquisition
from .events import Event, Events, Region
from .log import Log
from .loop import Watch
from .state import CameraState, Health, State

__all__ = [
    "Acquisition",
    "CameraState",
    "Event",
    "Events",
    "Health",
    "Log",
    "Region",
    "State",
    "Watch",
]
