"""Recordings on disk: format, video, clocks and labels; the virtual bench that films a scene."""

from tapetum.record.clocks import join
from tapetum.record.clutter import Glint, Lamp, Tape, draw_clutter
from tapetum.record.film import Session, film
from tapetum.record.frames import open_frames
from tapetum.record.imaging import Imaging
from tapetum.record.labels import label_recording
from tapetum.record.laser import BlinkCode, Exposure
from tapetum.record.motion import HandMotion, ProbeShake
from tapetum.record.recording import Recording, open_recording
from tapetum.record.session import Placed
from tapetum.record.shot import Shot
from tapetum.record.source import Frame, FrameSource, Source
from tapetum.record.spot import find_spot
from tapetum.record.stray import DimRoom, FixedPattern, Gradient, draw_stray
from tapetum.record.writer import RecordingWriter

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
