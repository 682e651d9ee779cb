"""Tracking that ends early keeps every row: after Ctrl-C, a frame that cannot be read, a full disk, a kill."""

from __future__ import annotations

import itertools
import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from pathlib import Path

import cv2
import numpy as np
import pytest

from tapetum.cli.app import main
from tapetum.errors import InputError
from tapetum.files import reserved
from tapetum.models.prediction import Prediction
from tapetum.record.source import Frame
from tapetum.track import read_tracks, retrack, track_to_file
from tapetum.track.tables import detections_schema, read_table, table_writer, track_schema

KINDS = ["parquet", "csv", "jsonl"]
IMAGE = np.zeros((48, 64), np.uint8)
IMAGE[20:25, 30:35] = 200


def frames(count: int, error: BaseException | None = None) -> Iterator[Frame]:
    for n in range(count):
        yield Frame(n, n / 30, IMAGE)
    if error is not None:
        raise error


class Guess:
    """A model that says 0.25 of everything."""

    target_names = ("gaze_x",)

    def predict(self, data, /, *, full_scale=None) -> Prediction:
        value = np.full((len(data), 1), 0.25)
        return Prediction(("gaze_x",), value, value - 0.1, value + 0.1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("error", [KeyboardInterrupt(), InputError("cannot be read", where="frame 20")])
@pytest.mark.parametrize("model", [None, Guess()])
def test_every_row_before_the_end_is_kept(tmp_path: Path, kind: str, error, model) -> None:
    out, found = tmp_path / f"t.{kind}", tmp_path / f"d.{kind}"
    out.write_text("of an earlier run")
    error = type(error)(*error.args)
    with pytest.raises(type(error)) as raised:
        track_to_file(frames(20, error), out, detections=found, model=model)
    assert out.read_text() == "of an earlier run" and not found.exists()
    left, spots = tmp_path / f"t.unfinished.{kind}", tmp_path / f"d.unfinished.{kind}"
    assert raised.value.__notes__ == [f"20 rows are kept in {left}", f"20 rows are kept in {spots}"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([out.name, left.name, spots.name])
    tracks = read_tracks(left)
    assert tracks["frame"].to_pylist() == list(range(20))
    assert retrack(spots)["frame"].to_pylist() == list(range(20))
    if model is not None:
        assert set(tracks["gaze_x"].to_pylist()) == {0.25}


def test_two_early_ends_do_not_overwrite_each_other(tmp_path: Path) -> None:
    for count in (5, 3):
        with pytest.raises(KeyboardInterrupt):
            track_to_file(frames(count, KeyboardInterrupt()), tmp_path / "t.csv")
    assert read_tracks(tmp_path / "t.unfinished.csv").num_rows == 5
    assert read_tracks(tmp_path / "t.unfinished-2.csv").num_rows == 3


def test_nothing_is_left_of_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt) as raised:
        track_to_file(frames(0, KeyboardInterrupt()), tmp_path / "t.parquet", detections=tmp_path / "d.csv")
    assert not list(tmp_path.iterdir()) and not hasattr(raised.value, "__notes__")


def test_a_signal_waits_for_the_frame_under_way(tmp_path: Path) -> None:
    def live() -> Iterator[Frame]:
        for n in itertools.count():
            if n == 7:
                os.kill(os.getpid(), signal.SIGINT)
            yield Frame(n, n / 30, IMAGE)

    with pytest.raises(KeyboardInterrupt):
        track_to_file(live(), tmp_path / "t.parquet", model=Guess(), batch=16)
    tracks = read_tracks(tmp_path / "t.unfinished.parquet")
    assert tracks["frame"].to_pylist() == list(range(7)) and set(tracks["gaze_x"].to_pylist()) == {0.25}


def test_a_kill_costs_a_second_at_most(tmp_path: Path, processes: BaseContext) -> None:
    folders = [tmp_path / kind for kind in KINDS]
    for folder in folders:
        folder.mkdir()
    # Each waits for some seconds: side by side.
    with ThreadPoolExecutor(len(KINDS)) as pool:
        list(pool.map(killed, folders, KINDS, [processes] * len(KINDS)))


def endless(out: Path, sent: Connection) -> None:
    """Track frames without an end, and say when each is asked for."""

    def seen() -> Iterator[Frame]:
        for n in itertools.count():
            sent.send(n)
            yield Frame(n, n / 30, IMAGE)
            time.sleep(0.02)

    track_to_file(seen(), out)


def killed(folder: Path, kind: str, processes: BaseContext) -> None:
    """Kill a process that tracks; check what it leaves."""
    asked, sent = processes.Pipe(duplex=False)
    process = processes.Process(target=endless, args=(folder / f"t.{kind}", sent))
    process.start()
    sent.close()
    moments: list[float] = []
    # The first frame loads libraries.
    while len(moments) < 12 or moments[-1] - moments[10] < 2.2:
        asked.recv()
        moments.append(time.monotonic())
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    left = folder / f"t.unfinished.{'arrow' if kind == 'parquet' else kind}"
    # The lock of a killed run is hidden, keeps nobody out, and goes with the next run.
    with reserved(folder / f"t.{kind}"):
        assert sorted(path.name for path in folder.iterdir()) == sorted([f".t.{kind}.lock", left.name])
    assert list(folder.iterdir()) == [left]
    kept = read_tracks(left)["frame"].to_pylist()
    assert kept == list(range(len(kept)))
    # A row is written before the next frame is asked for, and handed over by the first write a second later.
    slowest = max(np.diff(moments[10:]))
    assert len(kept) >= sum(moment < moments[-1] - 1.0 - 2 * slowest for moment in moments) - 1
    assert len(kept) >= 10


@pytest.mark.parametrize("kind", ["csv", "jsonl"])
def test_a_torn_last_line_is_left_out(tmp_path: Path, kind: str) -> None:
    with pytest.raises(KeyboardInterrupt):
        track_to_file(frames(5, KeyboardInterrupt()), tmp_path / f"t.{kind}")
    left = tmp_path / f"t.unfinished.{kind}"
    left.write_bytes(left.read_bytes()[:-7])
    assert read_tracks(left)["frame"].to_pylist() == [0, 1, 2, 3]
    # A table that is called whole has to be.
    with pytest.raises(InputError, match="cannot be read"):
        read_tracks(left.rename(tmp_path / f"t.{kind}"))


def test_what_is_written_in_parts_reads_as_one(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("tapetum.track.tables._FLUSH", 7)
    with table_writer(tmp_path / "t.parquet", track_schema()) as writer:
        for n in range(40):
            writer.write({"frame": n, "time": n / 30, "track": 1})
    assert read_tracks(tmp_path / "t.parquet")["frame"].to_pylist() == list(range(40))
    with table_writer(tmp_path / "d.parquet", detections_schema()):
        pass
    assert read_table(tmp_path / "d.parquet", detections_schema()).num_rows == 0


def test_the_command_says_what_is_kept(tmp_path: Path, capsys) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for n in range(6):
        cv2.imwrite(str(folder / f"{n}.png"), IMAGE)
    (folder / "6.png").write_bytes((folder / "5.png").read_bytes()[:60])
    out = tmp_path / "t.parquet"
    assert main(["track", str(folder), "-o", str(out)]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "6.png: the image is truncated" in line
    assert f"6 rows are kept in {tmp_path / 't.unfinished.parquet'}" in line
    assert read_tracks(tmp_path / "t.unfinished.parquet").num_rows == 6 and not out.exists()


def test_tracks_that_cannot_be_smoothed_are_kept(tmp_path: Path, monkeypatch, capsys) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for n in range(4):
        cv2.imwrite(str(folder / f"{n}.png"), IMAGE)

    class Blind(Guess):
        def predict(self, data, /, *, full_scale=None) -> Prediction:
            value = np.full((len(data), 1), 0.25)
            return Prediction(("gaze_x",), value, value - np.inf, value + np.inf)

    monkeypatch.setattr("tapetum.cli.track.find_model", lambda *_: Blind())
    out = tmp_path / "t.csv"
    assert main(["track", str(folder), "-o", str(out), "--model", "x", "--smooth", "whole"]) == 2
    assert f"the tracks as they are stand in {tmp_path / 't.unsmoothed.csv'}" in capsys.readouterr().err
    assert read_tracks(tmp_path / "t.unsmoothed.csv").num_rows == 4 and not out.exists()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc")
def test_memory_stays_flat_over_a_long_stream(tmp_path: Path) -> None:
    """A thousand frames, with births and ends of tracks, add no twentieth; kept, they would add 77 MB to some 300."""
    marks: list[int] = []
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 4, (240, 320), dtype=np.uint8)

    def long() -> Iterator[Frame]:
        for n in range(1200):
            if n in (200, 1199):
                marks.append(int(Path("/proc/self/statm").read_text().split()[1]))
            image = np.roll(noise, n, axis=1)
            row, column = 20 + (7 * n) % 200, 20 + 60 * (n // 50 % 5)
            image[row - 2 : row + 3, column - 2 : column + 3] = 200
            yield Frame(n, n / 30, image)

    track_to_file(long(), tmp_path / "t.parquet", detections=tmp_path / "d.parquet")
    assert marks[1] <= 1.05 * marks[0]
