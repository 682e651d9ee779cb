"""Finding and following retro-reflections in whole frames, beside laserbeamsize's beam_size on the same frames.

Frames of 640 x 480 pixels come from the virtual bench. Those of 2592 x 1944 are made: Gaussian spots of 4 to 40 pixels
on an uneven, noisy ground, which drift from frame to frame, 8 bit, from memory.
"""

from __future__ import annotations

import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import tapetum as tp
from tapetum.models import NetworkEstimator, pretrained
from tapetum.models.fast import FastResNet18
from tapetum.record.source import Frame
from tapetum.track import Tracker, detect, track
from tapetum.track.turns import Turns

from .measure import Contender, Effort, Figure, Row, in_turns

TITLE = "Detection and tracking: frames of 640 × 480 pixels from the virtual bench, and made ones of 2592 × 1944"
PEERS = ("laserbeamsize",)


@contextmanager
def filmed(seconds: float) -> Iterator[Path]:
    """A recording of the demo's scene, removed afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.rec"
        tp.film(tp.load_scene("hand-held"), path, tp.Session(seconds=seconds, seed=3))
        yield path


def made(targets: int, count: int, seed: int = 1) -> list[Frame]:
    """Frames of 2592 x 1944 pixels, 30 a second, with targets that drift by up to three pixels a frame."""
    height, width = 1944, 2592
    rng = np.random.default_rng(seed)
    columns, rows = (max(1, round((targets * ratio) ** 0.5)) for ratio in (4 / 3, 3 / 4))
    grid = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows + 1) + 0.5), axis=-1).reshape(-1, 2)[:targets]
    place = grid * [width / columns, height / (rows + 1)] + rng.uniform(-40, 40, (targets, 2))
    step, sigma = rng.uniform(-3, 3, (targets, 2)), np.exp(rng.uniform(0, np.log(10), targets))
    peak = rng.uniform(60, 220, targets)
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j].astype(np.float32)
    ground = 6 + 2 * x**2 + y
    noise = rng.normal(0, 1.5, (height, width)).astype(np.float32)
    frames: list[Frame] = []
    for n in range(count):
        light = ground + np.roll(noise, (97 * n, 61 * n), (0, 1))
        for (at_x, at_y), spread, high in zip(place + n * step, sigma, peak, strict=True):
            _add(light, at_x, at_y, spread, high)
        frames.append(Frame(n, n / 30, np.clip(np.rint(light), 0, 255).astype(np.uint8)))
    return frames


def _add(light: NDArray[np.float32], x: float, y: float, sigma: float, peak: float) -> None:
    """Add a Gaussian spot where it is above a hundredth of a count."""
    reach = int(5 * sigma) + 1
    rows = slice(max(0, int(y) - reach), int(y) + reach + 1)
    columns = slice(max(0, int(x) - reach), int(x) + reach + 1)
    part = light[rows, columns]
    dy = np.arange(rows.start, rows.start + part.shape[0]) - y
    dx = np.arange(columns.start, columns.start + part.shape[1]) - x
    part += (peak * np.exp(-(dy[:, None] ** 2 + dx**2) / (2 * sigma**2))).astype(np.float32)


def paced(frames: Sequence[Frame], model: Any = None, turns: Turns | None = None) -> tuple[float, float, float]:
    """Track frames, each on its own, without ghost rules.

    Returns the seconds a frame, the 99th percentile of the seconds from one result to the next, and the spots a frame.
    """
    stamps, spots = [time.perf_counter()], 0
    free = {"ghost_ratio": 0.0, "stray": 0.0}
    follower = Tracker(ghost_ratio=0.0)
    for one in track(frames, model=model, batch=1, tracker=follower, detect_options=free, turns=turns):
        stamps.append(time.perf_counter())
        spots += len(one.detections)
    # The first results also wait for the threads to fill.
    steps = np.diff(stamps)[3:]
    return float(steps.mean()), float(np.quantile(steps, 0.99)), spots / len(frames)


def large(effort: Effort) -> list[Row]:
    """Frames of five megapixels: detection alone, tracking, and with the bundled ResNet-18 on each spot."""
    trained = pretrained()
    assert isinstance(trained, NetworkEstimator)
    network = FastResNet18(trained)
    rows: list[Row] = []
    for targets in (3, 30):
        frames = made(targets, effort.of(60, 8))
        some = frames[: effort.of(20, 4)]
        detection = in_turns(
            {"detect": Contender(lambda some=some: [detect(frame.image) for frame in some], work=len(some))},
            effort.rounds,
        )
        rate = Figure.rate(detection.typical("detect"), "frames")
        rows.append(Row(f"2592 × 1944, {targets} targets: detection, one thread", rate))
        cases = (
            ("detection and tracking", None, None),
            ("the same and ResNet-18 on each", network, None),
            ("the same and ResNet-18 by turns in 20 ms", network, Turns(0.02)),
        )
        for case, model, turns in cases:
            mean, late, spots = paced(frames, model, turns)
            note = f"p99 {late * 1e3:.0f} ms from one result to the next; {spots:.1f} spots a frame"
            rows.append(Row(f"2592 × 1944, {targets} targets: {case}", Figure.rate(mean, "frames"), note=note))
    return rows


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
    small = [
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
    return small + large(effort)
