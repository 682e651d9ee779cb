"""The command line in process, and one small chain from recording to model that its tests share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import torch

from tapetum.cli.app import main
from tapetum.record.recording import RecordingWriter, StreamInfo, open_recording

HEIGHT, WIDTH = 72, 90


@dataclass(frozen=True)
class Ran:
    """What a command did."""

    code: int
    out: str
    err: str

    @property
    def complaint(self) -> str:
        """The one line on standard error."""
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        assert "Traceback" not in self.err
        return lines[0]


@pytest.fixture(autouse=True, scope="package")
def one_thread() -> Iterator[None]:
    """Small tensors gain nothing by threads, which on a busy machine lose minutes waiting for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., Ran]:
    """Run `tapetum` with these arguments."""

    def command(*arguments: object) -> Ran:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        return Ran(code, *capsys.readouterr())

    return command


def filmed(path: Path, *, frames: int = 20, target_later: float | None = None, labels: bool = True) -> Path:
    """Write a recording of a wandering spot; with a target stream that many seconds later, where given."""
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    streams = {"probe": StreamInfo(HEIGHT, WIDTH)}
    if target_later is not None:
        streams["target"] = StreamInfo(HEIGHT, WIDTH)
    with RecordingWriter(path, streams=streams, rate=15.0, start_utc_ns=10**18) as writer:
        for name in streams:
            later = round(1e9 * (target_later or 0.0)) if name == "target" else 0
            for n in range(frames):
                x, y = 30 + 1.3 * n, 36 + 4 * np.sin(n)
                image = 12 + 180 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 50)
                image = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
                moment = n * 66_666_667
                writer.write(name, image, monotonic_ns=moment, utc_ns=10**18 + moment + later)
    if labels:
        gaze = np.arange(frames) / 100
        table = {
            "frame": pa.array(range(frames), pa.int64()),
            "gaze_x": pa.array(gaze),
            "gaze_y": pa.array(-gaze),
            "how": ["laser-spot"] * frames,
            "quality": pa.array(np.full(frames, 0.9)),
        }
        open_recording(path).write_labels(pa.table(table))
    return path


@dataclass(frozen=True)
class Chain:
    """A labelled recording, the dataset cut from it, and a ridge trained on that, all made by the commands."""

    recording: Path
    dataset: Path
    model: Path


@pytest.fixture(scope="session")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    folder = tmp_path_factory.mktemp("chain")
    made = Chain(filmed(folder / "spot.rec"), folder / "spot.zarr", folder / "ridge")
    assert main(["dataset", "build", str(made.recording), "-o", str(made.dataset)]) == 0
    assert main(["train", str(made.dataset), "-o", str(made.model)]) == 0
    return made
