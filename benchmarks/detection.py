"""Cameras in a large frame of a room, alone and with its dark one, beside OpenCV's SimpleBlobDetector."""

from __future__ import annotations

import math
import time

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

import tapetum as tp
from tapetum.detection import find_each

from .measure import Contender, Effort, Figure, Row, in_turns

TITLE = "Cameras in a room: frames of 2592 × 1944 pixels, 8 bit, drawn, 30 glints of 3 to 20 pixels"
PEERS = ("opencv-python-headless",)
_COUNT = 30
_AT_ONCE = 12


def _room(rng: np.random.Generator) -> np.ndarray:
    """Overlapping rectangles of any brightness, softened as by a lens."""
    picture = np.full((1944, 2592), 60.0, np.float32)
    for _ in range(800):
        x, y, w, h = rng.uniform(0, 2592), rng.uniform(0, 1944), *rng.uniform(10, 300, 2)
        corner = int(x + w), int(y + h)
        cv2.rectangle(picture, (int(x), int(y)), corner, float(rng.uniform(15, 150)), -1)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 1.0))


def _frames() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A lit frame, a dark one shifted by some pixels, and where the glints are, [30, 2]."""
    rng = np.random.default_rng(5)
    room = _room(rng)
    lit, places = room.copy(), rng.uniform((60, 60), (2530, 1880), (_COUNT, 2))
    for x, y in places:
        sigma, height = rng.uniform(0.8, 5), rng.uniform(50, 150)
        reach = math.ceil(5 * sigma)
        rows, columns = np.mgrid[int(y) - reach : int(y) + reach + 1, int(x) - reach : int(x) + reach + 1]
        lit[rows, columns] += height * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    dark = np.roll(room, (4, -7), (0, 1))
    lit, dark = (np.clip(one + rng.normal(0, 2, one.shape), 0, 255).astype(np.uint8) for one in (lit, dark))
    return lit, dark, places


def _found(x: np.ndarray, y: np.ndarray, places: np.ndarray) -> int:
    return int((np.hypot(x[None] - places[:, :1], y[None] - places[:, 1:]) < 4).any(1).sum())


def run(effort: Effort) -> list[Row]:
    """One frame alone, a pair, and the peer, in turns."""
    lit, dark, places = _frames()
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        blobs = cv2.SimpleBlobDetector.create(_bright())
        with threadpool_limits(1, user_api="blas"):
            timings = in_turns(
                {
                    "frame": Contender(lambda: tp.find_cameras(lit), repeats=effort.of(3, 1)),
                    "pair": Contender(lambda: tp.find_cameras(lit, dark, swaps=False), repeats=effort.of(3, 1)),
                    "frames": Contender(lambda: _several((lit, None)), work=_AT_ONCE),
                    "pairs": Contender(lambda: _several((lit, dark), swaps=False), work=_AT_ONCE),
                    "peer": Contender(lambda: blobs.detect(lit)),
                },
                effort.rounds,
            )
        peers = np.array([point.pt for point in blobs.detect(lit)]).reshape(-1, 2)
        found = tp.find_cameras(lit, dark, false_alarms=0.1)
        apart = {
            case: min(_by_processes(frame, swaps=False) for _ in range(effort.rounds))
            for case, frame in (("one frame alone", (lit, None)), ("lit and dark, registered", (lit, dark)))
        }
    finally:
        cv2.setNumThreads(before)
    peer = Figure.rate(timings.typical("peer"), "frames")
    hits, theirs = _found(found.x, found.y, places), _found(peers[:, 0], peers[:, 1], places)
    told = f"{hits} of {_COUNT} found and {len(found) - hits} others; the peer, of the lit frame alone, {theirs} and "
    told += f"{len(peers) - theirs} others"
    rows = [
        Row(
            case,
            Figure.rate(timings.typical(name), what),
            "OpenCV, SimpleBlobDetector",
            peer,
            timings.speed_up(name, "peer"),
            told if name == "pair" else "",
        )
        for name, case, what in (
            ("frame", "one frame alone, one thread", "frames"),
            ("frames", "one frame alone, two threads", "frames"),
            ("pair", "lit and dark, registered, one thread", "pairs"),
            ("pairs", "lit and dark, registered, two threads", "pairs"),
        )
    ]
    for case, seconds in apart.items():
        what = "pairs" if "dark" in case else "frames"
        rows.append(Row(f"{case}, two processes", Figure.rate(seconds, what), note="frames in shared memory"))
    return rows


def _several(frame: tuple[np.ndarray, np.ndarray | None], **options: bool) -> None:
    for _ in find_each([frame] * _AT_ONCE, threads=2, **options):
        pass


def _by_processes(frame: tuple[np.ndarray, np.ndarray | None], **options: bool) -> float:
    """Seconds a frame with two processes, once they have started."""
    count, begin = 5 * _AT_ONCE, 0.0
    for n, _ in enumerate(find_each([frame] * count, processes=2, **options)):
        if n == _AT_ONCE - 1:
            begin = time.perf_counter()
    return (time.perf_counter() - begin) / (count - _AT_ONCE)


def _bright() -> cv2.SimpleBlobDetector.Params:
    """Bright blobs of 3 to 60 pixels, of any shape."""
    options = cv2.SimpleBlobDetector.Params()
    options.filterByColor, options.blobColor = True, 255
    options.filterByArea, options.minArea, options.maxArea = True, 5.0, 3000.0
    options.filterByCircularity = options.filterByInertia = options.filterByConvexity = False
    return options
