"""The live watch: a source is read without end, its cameras are followed, and what happens is published.

`Watch` runs the loop, `Log` keeps the events, `make_app` shows both on a page.
"""

from tapetum.live.acquire import Acquisition
from tapetum.live.events import Event, Events, Region
from tapetum.live.log import Log
from tapetum.live.loop import Watch
from tapetum.live.state import CameraState, Health, State

__all__ = ["Acquisition", "CameraState", "Event", "Events", "Health", "Log", "Region", "State", "Watch"]
