"""The virtual bench's frames a second, and lossless video beside FFmpeg's own FFV1 settings."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

import tapetum as tp
from tapetum.record.video import VideoWriter, read_video

from .measure import Contender, Effort, Figure, Row, in_turns

TITLE = "Filming: the demo's scene, 640 × 480 and 648 × 486 pixels, and its lossless video"
PEERS = ("av",)
_RATE = 15.0


def run(effort: Effort) -> list[Row]:
    """Film both streams beside real time; write and read the probe's video beside bare PyAV."""
    scene, seconds = tp.load_scene("hand-held"), effort.of(4, 1)
    session = tp.Session(seconds=seconds, rate=_RATE, seed=3)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = folder / "bench.rec"
        filming = in_turns(
            {"ours": Contender(lambda: tp.film(scene, recording, session, overwrite=True), work=seconds * _RATE)},
            min(effort.rounds, 3),
        )
        images = [frame.image for frame in tp.open_frames(recording)]
        own, bare = folder / "own.mkv", folder / "bare.mkv"
        writing = in_turns(
            {
                "ours": Contender(lambda: _write(own, images), work=len(images)),
                "peer": Contender(lambda: _write_bare(bare, images), work=len(images)),
            },
            effort.rounds,
        )
        reading = in_turns(
            {
                "ours": Contender(lambda: deque(read_video(own), maxlen=0), work=len(images)),
                "peer": Contender(lambda: deque(_read_bare(own), maxlen=0), work=len(images)),
            },
            effort.rounds,
        )
        for path in (own, bare):
            if not all(np.array_equal(a, b) for a, b in zip(images, read_video(path, tolerant=True), strict=True)):
                raise AssertionError(f"{path.name} does not give its frames back")
        sizes = [path.stat().st_size / sum(image.nbytes for image in images) for path in (own, bare)]
    pace = filming.typical("ours")
    shares = f"{sizes[0]:.0%} of the raw size against {sizes[1]:.0%}"
    return [
        Row(
            "both streams filmed, encoded and kept",
            Figure.rate(pace, "frames"),
            "real time",
            Figure(_RATE, "frames/s"),
            (1 / pace / _RATE, 1 / pace / _RATE, 1 / pace / _RATE),
        ),
        _video_row("FFV1 written", writing, f"every frame safe from a crash at once; {shares}"),
        _video_row("FFV1 read", reading, "each frame's checksums looked at"),
    ]


def _video_row(case: str, timings: Any, note: str) -> Row:
    ours, theirs = (Figure.rate(timings.typical(name), "frames") for name in ("ours", "peer"))
    return Row(case, ours, "PyAV as it comes", theirs, timings.speed_up("ours", "peer"), note)


def _write(path: Path, images: list[NDArray[Any]]) -> None:
    with VideoWriter(path, images[0].shape, rate=_RATE) as video:
        for image in images:
            video.write(image)


def _write_bare(path: Path, images: list[NDArray[Any]]) -> None:
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("ffv1", rate=Fraction(15))
        stream.height, stream.width, stream.pix_fmt = *images[0].shape, "gray"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
        container.mux(stream.encode(None))


def _read_bare(path: Path) -> Iterator[NDArray[Any]]:
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray()
