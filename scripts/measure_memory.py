"""Whether tracking keeps its memory: the process's own memory while it follows cameras for many frames.

    python scripts/measure_memory.py [FRAMES [TARGETS]]

FRAMES drawn frames (108000: an hour at 30 a second) of 640 x 480 pixels, drawn one by one, in which TARGETS spots (3)
wander, cross and are gone now and then, so that tracks end and begin. Rows are written to a table in a folder that is
removed. It prints the resident memory every twentieth of the way, and by how much the second half rises over its least.
"""

from __future__ import annotations

import argparse
import gc
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil

from tapetum.record.source import Frame
from tapetum.track import track_to_file

Array = np.ndarray
SHAPE = (480, 640)


def frames(count: int, targets: int) -> Iterator[Frame]:
    """Frames in which spots go about in a circle each of its own; a tenth of the time one is not seen."""
    rng = np.random.default_rng(7)
    middle, wide = rng.uniform((120, 120), (520, 360), (targets, 2)), rng.uniform(30, 110, (targets, 2))
    pace, phase, sigma = rng.uniform(0.002, 0.02, targets), rng.uniform(0, 6.3, targets), rng.uniform(1.5, 4, targets)
    noise = rng.normal(0, 1.5, (SHAPE[0] + 97, SHAPE[1] + 61)).astype(np.float32)
    process = psutil.Process()
    every, told = max(1, count // 20), []
    for n in range(count):
        if n % every == 0:
            gc.collect()
            told.append(process.memory_info().rss / 2**20)
            print(f"frame {n}: {told[-1]:.1f} MiB", flush=True)
        light = 8 + noise[n % 97 :, n % 61 :][: SHAPE[0], : SHAPE[1]]
        for at, reach, turn, start, spread in zip(middle, wide, pace, phase, sigma, strict=True):
            angle = turn * n + start
            if angle % 6.3 < 0.63:
                continue
            x, y = (at + reach * (np.cos(angle), np.sin(angle))).tolist()
            _add(light, x, y, spread)
        yield Frame(n, n / 30, np.clip(np.rint(light), 0, 255).astype(np.uint8))
    later = told[len(told) // 2 :]
    low, high = min(later), max(later)
    print(f"the second half: {low:.1f} to {high:.1f} MiB, {high / low - 1:.1%} over the least")


def _add(light: Array, x: float, y: float, sigma: float) -> None:
    reach = int(5 * sigma) + 1
    rows, columns = slice(int(y) - reach, int(y) + reach + 1), slice(int(x) - reach, int(x) + reach + 1)
    dy, dx = np.arange(rows.start, rows.stop) - y, np.arange(columns.start, columns.stop) - x
    light[rows, columns] += 120 * np.exp(-(dy[:, None] ** 2 + dx**2) / (2 * sigma**2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frames", type=int, nargs="?", default=108000)
    parser.add_argument("targets", type=int, nargs="?", default=3)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        summary = track_to_file(frames(options.frames, options.targets), Path(folder) / "tracks.parquet")
    print(f"{summary.frames} frames, {summary.tracks} tracks, {summary.rows} rows")


if __name__ == "__main__":
    main()
