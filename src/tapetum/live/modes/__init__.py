"""What a watch's page can do beside watching: an exhibit, a vote, a guard's desk, a scan, a recording.

Each mode gets the watch's states and events, and gives its own state as a frozen dataclass, in which it is published.
"""

from tapetum.live.modes.board import Modes, ModesState

__all__ = ["Modes", "ModesState"]
