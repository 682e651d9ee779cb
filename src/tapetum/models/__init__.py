"""Estimators: images of retro-reflections in; gaze, focus and device out, with intervals and probabilities."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
