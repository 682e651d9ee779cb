"""One way to open frames, wherever they are: a folder of images, an image, a recording or a video."""

from __future__ import annotations

import os
from dataclasses import replace

from tapetum.record.images import IMAGE_SUFFIXES, ImageSource
from tapetum.record.recording import is_recording, open_recording
from tapetum.record.source import Frame, FrameSource, existing
from tapetum.record.video import VideoSource

__all__ = ["Frame", "FrameSource", "open_frames"]


def open_frames(
    source: str | os.PathLike[str], stream: str = "probe", *, rate: float = 15.0, late: bool = False
) -> FrameSource:
    """Open frames.

    Parameters
    ----------
    source
        A folder of images (in natural order; 8 or 16 bit; colour becomes grey), one image file, a `NAME.rec`
        folder, or a video file.
    stream
        Which stream of a recording; nothing else has several.
    rate
        Frames per second to count images by, which have no clock.
    late
        Whether a video that was cut short gives its readable frames before it raises.

    Returns
    -------
    FrameSource
        An iterable of `Frame` that can be iterated again.

    Raises
    ------
    InputError
        When nothing is there, the folder holds no image, or the file is damaged or of an unknown type. Images
        are read one by one, so that a damaged one raises when its turn comes.
    """
    place = existing(source)
    if is_recording(place):
        found = open_recording(place).source(stream)
        return replace(found, late=late)
    if place.is_dir() or place.suffix.lower() in IMAGE_SUFFIXES:
        return ImageSource.from_path(place, rate)
    return VideoSource.from_path(place, late=late)
