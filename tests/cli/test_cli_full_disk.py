"""A disk without room: one line, exit code 2, and nothing half-written."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tapetum.record.recording import open_recording
from tapetum.track.tables import detections_schema, read_table, track_schema

pytestmark = pytest.mark.usefixtures("narrow")

resource = pytest.importorskip("resource", reason="the system has no limits to set")

Small = Callable[[int], contextlib.AbstractContextManager[Path]]


def mounted(folder: Path, size: int) -> bool:
    """Mount a file system of some bytes, where that is allowed."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    try:
        return subprocess.run(command, capture_output=True, check=False, timeout=20).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


@pytest.fixture(params=["full disk", "largest file"])
def small(request: pytest.FixtureRequest, tmp_path: Path) -> Small:
    """Give a folder with room for so many bytes only: a real one, or one where no file may be larger."""

    @contextlib.contextmanager
    def room(size: int) -> Iterator[Path]:
        folder = tmp_path / "small"
        folder.mkdir()
        if request.param == "largest file":
            before = resource.getrlimit(resource.RLIMIT_FSIZE)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size // 2, before[1]))
            try:
                yield folder
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, before)
            return
        if not mounted(folder, size):
            pytest.skip("no file system may be mounted here")
        try:
            yield folder
        finally:
            subprocess.run(["umount", "--lazy", str(folder)], check=True, timeout=20)

    return room


def complaint(ran) -> str:
    """The last line on standard error, above which only work that was done may stand."""
    assert ran.code == 2, ran.err
    assert "Traceback" not in ran.err and ran.err.count("error:") == 1
    line = ran.err.splitlines()[-1]
    assert "no room left on the disk" in line or "largest size allowed" in line
    return line


@pytest.mark.parametrize("name", ["x.npy", "x.tif", "x.png", "x.zarr"])
def test_simulate(run, small: Small, name: str) -> None:
    pixels = ("--set", "probe.sensor.pixels=[128, 128]", "--set", "sampling.accuracy=0.01")
    sweep = ("--sweep", "rotation=0,1") if name == "x.png" else ()
    with small(8192) as folder:
        ran = run("simulate", "thin-lens", *pixels, *sweep, "-o", folder / "new" / name)
        assert name in complaint(ran) and ran.out == ""
        assert not list(folder.iterdir())


def test_record(run, small: Small) -> None:
    pixels = ("--set", "probe.sensor.pixels=[160, 120]", "--set", "target.sensor.pixels=[162, 122]")
    with small(100_000) as folder:
        ran = run("record", "hand-held", *pixels, "--seconds", 2, "-o", folder / "x.rec")
        assert "x.rec" in complaint(ran)
        assert not list(folder.rglob("*.part*"))
        # What was filmed until then is no half-written file but a recording that says that it is unfinished.
        assert [path.name for path in folder.iterdir()] == ["x.rec"]
        recording = open_recording(folder / "x.rec")
        assert not recording.finished
        count = len(recording.frames("probe"))
        assert 0 < count < 30 and sum(1 for _ in recording.source("probe")) == count


def test_record_without_room_for_a_frame(run, small: Small) -> None:
    with small(4096) as folder:
        assert "x.rec" in complaint(run("record", "hand-held", "--seconds", 0.2, "-o", folder / "x.rec"))
        assert not list(folder.iterdir())


def test_dataset_build(run, chain, small: Small) -> None:
    with small(65_536) as folder:
        ran = run("dataset", "build", chain.recording, "-o", folder / "x.zarr")
        assert "x.zarr" in complaint(ran) and ran.out == ""
        assert not list(folder.iterdir())


def test_train(run, chain, small: Small) -> None:
    with small(16_384) as folder:
        ran = run("train", chain.dataset, "-o", folder / "m")
        assert str(folder / "m") in complaint(ran) and ran.out == ""
        assert not list(folder.iterdir())


@pytest.mark.usefixtures("narrow")
def test_train_resnet(run, chain, small: Small) -> None:
    with small(1 << 20) as folder:
        ran = run("train", chain.dataset, "--model", "resnet18", "--epochs", 1, "-o", folder / "m")
        assert "m.checkpoint" in complaint(ran)
        assert not [path for path in folder.rglob("*") if path.is_file()]


def rows_of(path: Path) -> int:
    schema = detections_schema() if path.name.startswith("d.") else track_schema()
    return read_table(path, schema).num_rows


@pytest.mark.parametrize("kind", ["parquet", "csv", "jsonl"])
def test_track(run, chain, small: Small, kind: str) -> None:
    # One block: the smallest file system that there is.
    with small(4096 if kind == "parquet" else 2560) as folder:
        ran = run("track", chain.recording, "-o", folder / f"x.{kind}", "--detections", folder / f"d.{kind}")
        line = complaint(ran)
        assert f".{kind}" in line and ran.out == ""
        # What found room is a table that can be read: whole, or called unfinished, and the line says where.
        for path in folder.iterdir():
            assert path.name == f"x.{kind}" or (".unfinished." in path.name and str(path) in line)
            assert rows_of(path) >= 20


def test_a_file_that_stood_there_stays(run, small: Small) -> None:
    with small(16_384) as folder:
        (folder / "x.npy").write_bytes(b"dear")
        complaint(run("simulate", "thin-lens", "-o", folder / "x.npy", "--overwrite"))
        assert (folder / "x.npy").read_bytes() == b"dear" and len(list(folder.iterdir())) == 1
