"""Cameras in a room: retro-reflections in one frame, or in a lit and a dark frame of the same scene.

`find_cameras` registers the dark frame to the lit one (registration.py), looks for small bright places in the
difference (candidates.py), measures features of each (features.py), has a small network judge the likeliest (second.py)
and says how likely each is a camera (score.py). `find_each` takes many frames (many.py).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
