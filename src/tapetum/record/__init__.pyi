from .clocks import join
from .clutter import Glint, Lamp, Tape, draw_clutter
from .film import Session, film
from .frames import open_frames
from .imaging import Imaging
from .labels import label_recording
from .laser import BlinkCode, Exposure
from .motion import HandMotion, ProbeShake
from .recording import Recording, open_recording
from .session import Placed
from .shot import Shot
from .source import Frame, FrameSource, Source
from .spot import find_spot
from .stray import DimRoom, FixedPattern, Gradient, draw_stray
from .writer import RecordingWriter

__all__ = [
    "BlinkCode",
    "DimRoom",
    "Exposure",
    "FixedPattern",
    "Frame",
    "FrameSource",
    "Glint",
    "Gradient",
    "HandMotion",
    "Imaging",
    "Lamp",
    "Placed",
    "ProbeShake",
    "Recording",
    "RecordingWriter",
    "Session",
    "Shot",
    "Source",
    "Tape",
    "draw_clutter",
    "draw_stray",
    "film",
    "find_spot",
    "join",
    "label_recording",
    "open_frames",
    "open_recording",
]
