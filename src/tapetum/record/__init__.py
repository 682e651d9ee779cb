"""Recordings on disk: format, video, clocks and labels; the virtual bench that films a scene."""

from tapetum.record.clocks import join
from tapetum.record.film import Session, film
from tapetum.record.frames import open_frames
from tapetum.record.motion import HandMotion
from tapetum.record.recording import Recording, open_recording
from tapetum.record.source import Frame, FrameSource
from tapetum.record.spot import find_spot, label_recording
from tapetum.record.writer import RecordingWriter

__all__ = [
    "Frame",
    "FrameSource",
    "HandMotion",
    "Recording",
    "RecordingWriter",
    "Session",
    "film",
    "find_spot",
    "join",
    "label_recording",
    "open_frames",
    "open_recording",
]
