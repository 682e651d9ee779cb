"""Opening of frames from a camera, the virtual bench, a folder of images, an image, a recording or a video."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from tapetum.bench import as_scene
from tapetum.errors import one_of
from tapetum.record.camera import Camera, is_camera
from tapetum.record.drawn_room import DrawnRoom
from tapetum.record.genicam import GenicamCamera, is_genicam
from tapetum.record.images import IMAGE_SUFFIXES, ImageSource
from tapetum.record.network import NetworkCamera, is_network
from tapetum.record.recording import is_recording, open_recording
from tapetum.record.source import Frame, FrameSource, Source, existing
from tapetum.record.stacks import StackSource
from tapetum.record.v4l2 import V4l2Camera, is_v4l2
from tapetum.record.video import VideoSource

__all__ = ["SOURCES", "Asked", "Frame", "FrameSource", "Source", "SourceKind", "is_device", "is_hands", "open_frames"]

_RATE = 15.0
_BENCH = "bench:"


@dataclass(frozen=True)
class Asked:
    """What is asked of a source: see `open_frames`."""

    stream: str = "probe"
    rate: float | None = None
    late: bool = False


@dataclass(frozen=True)
class SourceKind:
    """A kind of source.

    Parameters
    ----------
    takes
        Whether a text names a source of this kind.
    opens
        Opens it.
    device
        Whether it is a camera, of this machine or of a network.
    """

    takes: Callable[[str], bool]
    opens: Callable[[str, Asked], Source]
    device: bool = False


# What the bench films is simulated by PyTorch, which takes two seconds to load: other sources do without it.
def is_hands(source: str) -> bool:
    """Return whether a text names hands on the virtual bench: `hand` or `hand:3`."""
    return source.partition(":")[0] == "hand"


def _hands(name: str, asked: Asked) -> Source:
    from tapetum.record.hand import Hands

    return Hands(name, rate=asked.rate)


def _bench(name: str, asked: Asked) -> Source:
    from tapetum.record.session import Session
    from tapetum.record.shot import Shot

    cameras = Shot(as_scene(name.removeprefix(_BENCH)), Session(rate=asked.rate or _RATE)).cameras
    return cameras[one_of(asked.stream, tuple(cameras), "stream")]


def _is_images(place: str) -> bool:
    return Path(place).is_dir() or Path(place).suffix.lower() in IMAGE_SUFFIXES


SOURCES: dict[str, SourceKind] = {
    "camera": SourceKind(is_camera, lambda name, asked: Camera(name, asked.rate), device=True),
    "v4l2": SourceKind(is_v4l2, lambda name, asked: V4l2Camera(name, asked.rate), device=True),
    "genicam": SourceKind(is_genicam, lambda name, asked: GenicamCamera(name, asked.rate), device=True),
    # Opened only if it is named on the command line: no file, scene or page can name it.
    "network": SourceKind(is_network, lambda name, asked: NetworkCamera(name), device=True),
    # A file or folder of that name comes first.
    "demo": SourceKind(
        lambda name: name == "demo" and not Path(name).exists(), lambda name, asked: DrawnRoom(asked.rate or 20.0)
    ),
    "hand": SourceKind(lambda name: is_hands(name) and not Path(name).exists(), _hands),
    "bench": SourceKind(lambda name: name.startswith(_BENCH), _bench),
    "recording": SourceKind(
        lambda name: is_recording(existing(name)),
        lambda name, asked: replace(open_recording(name).source(asked.stream), late=asked.late),
    ),
    "images": SourceKind(_is_images, lambda name, asked: ImageSource.from_path(Path(name), asked.rate or _RATE)),
    "stack": SourceKind(
        lambda name: Path(name).suffix.lower() == ".npy",
        lambda name, asked: StackSource.from_path(name, asked.rate or _RATE),
    ),
    "video": SourceKind(lambda _: True, lambda name, asked: VideoSource.from_path(Path(name), late=asked.late)),
}
"""Kinds of sources by name; the first that takes a text opens it.

To add one, write a `Source` in a file of its own, and name it here.
"""


def is_device(source: str) -> bool:
    """Return whether a text names a camera, whether it is there or not."""
    return any(kind.device and kind.takes(source) for kind in SOURCES.values())


def open_frames(
    source: str | os.PathLike[str], stream: str = "probe", *, rate: float | None = None, late: bool = False
) -> Source:
    """Open frames; stored ones can be iterated again.

    Parameters
    ----------
    source
        A camera of this machine (`camera:0`, `v4l2:0,Y12`, `genicam:NAME`: see `tapetum cameras`) or of a network
        (`rtsp://…`, `http://…`), a scene of the
        virtual bench, filmed for a minute while it is read (`bench:hand-held`, `bench:FILE.yaml`), `demo`, a drawn
        room with three cameras in real time, `hand` or `hand:3`, cameras in simulated hands, a folder of images
        (in natural order; 8 or 16 bit; colour becomes grey), one image file, a `.npy` array [N, H, W], a `NAME.rec`
        folder, or a video file.
    stream
        Stream of a recording or of the bench.
    rate
        Frames per second to request from a camera or the bench, or that time images (15 by default), which have no
        clock.
    late
        Whether a truncated video gives its readable frames before it raises.

    Raises
    ------
    InputError
        When nothing is there, the camera is in use, the folder holds no image, or the file is damaged or of an unknown
        type. Images are read one by one, so that a damaged one raises at its turn.
    """
    name, asked = str(source), Asked(stream, rate, late)
    kind = next(kind for kind in SOURCES.values() if kind.takes(name))
    return kind.opens(name, asked)
