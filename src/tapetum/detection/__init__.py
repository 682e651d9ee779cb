"""Cameras in a room: retro-reflections in one frame, or in a lit and a dark frame of the same scene.

`find_cameras` registers the dark frame to the lit one (registration.py), looks for small bright places in the
difference (candidates.py), measures features of each (features.py), has a small network judge the likeliest (second.py)
and says how likely each is a camera (score.py). `find_each` takes many frames (many.py).
"""

from __future__ import annotations

from tapetum.detection.find import find_cameras
from tapetum.detection.found import Found
from tapetum.detection.many import find_each
from tapetum.detection.registration import Registered, register

__all__ = ["Found", "Registered", "find_cameras", "find_each", "register"]
