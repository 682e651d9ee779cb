"""The playground: settings of a scene in, pictures and numbers out."""

from tapetum.live.playground.core import Limit, Playground, Result
from tapetum.live.playground.settings import SETTINGS, Setting, apply, settings_of

__all__ = ["SETTINGS", "Limit", "Playground", "Result", "Setting", "apply", "settings_of"]
