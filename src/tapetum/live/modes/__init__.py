"""What a watch's page can do beside watching: an exhibit, a vote, a guard's desk, a scan, a recording.

Each mode hears the watch's states and events, and says how it stands in a frozen dataclass: its published form.
"""

from tapetum.live.modes.board import Modes, ModesState

__all__ = ["Modes", "ModesState"]
