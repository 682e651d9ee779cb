"""Frames → detections → tracks → estimates.

`detect` finds the retro-reflections in a frame, `Tracker` follows them, `track` does both for a whole
source and asks the models about each. It knows neither where frames come from nor where results go.
"""

from __future__ import annotations

import inspect
import sys
from types import ModuleType
from typing import Any

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
_ROOM = __doc__


class _Room(ModuleType):
    """The room under its own name, callable: `tapetum.track(source)` is `tapetum.track.track(source)`.

    Importing this package makes it the attribute `track` of `tapetum`, where the function of that name belongs too.
    `help(tapetum.track)` and a notebook's `tapetum.track?` describe the function first.
    """

    def __call__(self, *args: Any, **options: Any) -> Any:
        return self.track(*args, **options)

    @property
    def __signature__(self) -> inspect.Signature:
        return inspect.signature(self.track)

    @property
    def __doc__(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return f"{self.track.__doc__}\nThe room of this name: {_ROOM}"


sys.modules[__name__].__class__ = _Room
