"""Finding and following retro-reflections in whole frames, beside laserbeamsize's beam_size on the same frames."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import tapetum as tp
from tapetum.record.source import Frame
from tapetum.track import Tracker, detect, track

from .measure import Contender, Effort, Figure, Row, in_turns

TITLE = "Detection and tracking: frames of 640 × 480 pixels from the virtual bench"
PEERS = ("laserbeamsize",)


@contextmanager
def filmed(seconds: float) -> Iterator[Path]:
    """A recording of the demo's scene, removed afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.rec"
        tp.film(tp.load_scene("hand-held"), path, tp.Session(seconds=seconds, seed=3))
        yield path


def run(effort: Effort) -> list[Row]:
    """Detection alone, detection with tracking, and the peer, in turns, on frames in memory."""
    import laserbeamsize

    with filmed(effort.of(4, 1)) as path:
        frames = list(tp.open_frames(path))
    # The peer looks for one beam in a frame that has one; ours looks for any number.
    few = frames[:: max(1, len(frames) // effort.of(15, 4))]

    def detected(some: list[Frame]) -> list[int]:
        return [len(detect(frame.image, full_scale=frame.full_scale)) for frame in some]

    timings = in_turns(
        {
            "detect": Contender(lambda: detected(frames), work=len(frames)),
            "track": Contender(lambda: deque(track(frames, tracker=Tracker()), maxlen=0), work=len(frames)),
            "peer": Contender(lambda: [laserbeamsize.beam_size(frame.image) for frame in few], work=len(few)),
        },
        effort.rounds,
    )
    once = sum(count == 1 for count in detected(frames))
    peer = Figure.rate(timings.typical("peer"), "frames")
    note = f"exactly one RR found in {once} of {len(frames)} frames; the peer takes one for granted"
    return [
        Row(
            case,
            Figure.rate(timings.typical(name), "frames"),
            "laserbeamsize, beam_size",
            peer,
            timings.speed_up(name, "peer"),
            note if name == "detect" else "",
        )
        for name, case in (("detect", "detection"), ("track", "detection and tracking"))
    ]
