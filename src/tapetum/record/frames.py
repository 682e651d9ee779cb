"""Opening of frames from a camera, a folder of images, an image, a recording or a video."""

from __future__ import annotations

import os
from dataclasses import replace

from tapetum.record.camera import Camera, is_camera
from tapetum.record.images import IMAGE_SUFFIXES, ImageSource
from tapetum.record.recording import is_recording, open_recording
from tapetum.record.source import Frame, FrameSource, Source, existing
from tapetum.record.video import VideoSource

__all__ = ["Frame", "FrameSource", "Source", "open_frames"]

_RATE = 15.0


def open_frames(
    source: str | os.PathLike[str], stream: str = "probe", *, rate: float | None = None, late: bool = False
) -> Source:
    """Open frames; stored ones can be iterated again.

    Parameters
    ----------
    source
        A camera of this machine (`camera:0`), a folder of images (in natural order; 8 or 16 bit; colour becomes grey),
        one image file, a `NAME.rec` folder, or a video file.
    stream
        Stream of a recording.
    rate
        Frames per second to request from a camera, or that time images (15 by default), which have no clock.
    late
        Whether a truncated video gives its readable frames before it raises.

    Raises
    ------
    InputError
        When nothing is there, the camera is in use, the folder holds no image, or the file is damaged or of an unknown
        type. Images are read one by one, so that a damaged one raises at its turn.
    """
    if is_camera(str(source)):
        return Camera(str(source), rate)
    place = existing(source)
    if is_recording(place):
        return replace(open_recording(place).source(stream), late=late)
    if place.is_dir() or place.suffix.lower() in IMAGE_SUFFIXES:
        return ImageSource.from_path(place, rate or _RATE)
    return VideoSource.from_path(place, late=late)
