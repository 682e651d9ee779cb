"""Small labelled recordings, written by the real writer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from synth_plans import little_plan

from tapetum.data.synth import synthesise
from tapetum.record.recording import RecordingWriter, StreamInfo, open_recording

HEIGHT, WIDTH = 72, 90


def filmed(
    path: Path,
    *,
    frames: int = 20,
    bits: int = 8,
    dark: tuple[int, ...] = (),
    unlabelled: tuple[int, ...] = (),
    poor: tuple[int, ...] = (),
    columns: tuple[str, str] | None = ("gaze_x", "gaze_y"),
    seed: int = 0,
) -> Path:
    """Film a wandering spot; return the recording's folder. Frame n's label is (n / 100, -n / 100)."""
    rng, top = np.random.default_rng(seed), 2**bits - 1
    rows, cols = np.mgrid[:HEIGHT, :WIDTH]
    info = StreamInfo(HEIGHT, WIDTH, bits=bits)
    with RecordingWriter(path, streams={"probe": info}, rate=15.0, start_utc_ns=10**18) as writer:
        for n in range(frames):
            x, y = place(n)
            height = 0 if n in dark else 0.7 * top
            image = 0.05 * top + height * np.exp(-((cols - x) ** 2 + (rows - y) ** 2) / 50)
            image = np.clip(np.rint(image + rng.normal(0, 0.01 * top, image.shape)), 0, top).astype(info.dtype)
            now = n * 66_666_667
            writer.write("probe", image, monotonic_ns=now, utc_ns=10**18 + now)
    if columns is not None:
        value = [None if n in unlabelled else n / 100 for n in range(frames)]
        table = {
            "frame": pa.array(range(frames), pa.int64()),
            columns[0]: pa.array(value, pa.float64()),
            columns[1]: pa.array([None if v is None else -v for v in value], pa.float64()),
            "how": ["laser-spot"] * frames,
            "quality": pa.array([0.1 if n in poor else 0.9 for n in range(frames)], pa.float64()),
        }
        open_recording(path).write_labels(pa.table(table))
    return path


def place(n: int) -> tuple[float, float]:
    """Where the spot of frame n is, in pixels."""
    return 30 + 1.3 * n, 36 + 4 * np.sin(n)


@pytest.fixture
def film(tmp_path: Path) -> Callable[..., Path]:
    return lambda name="a.rec", **how: filmed(tmp_path / name, **how)


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The little plan's set, made by one process."""
    return synthesise(little_plan(), tmp_path_factory.mktemp("synth") / "whole.zarr")
