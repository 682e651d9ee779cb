"""What is known of a frame beside its picture comes with it into the tables, from a camera as from a recording."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tapetum.cli.app import main
from tapetum.record.layout import FRAMES, META, SCHEMA
from tapetum.record.recording import RecordingWriter, StreamInfo, open_recording
from tapetum.record.source import Frame
from tapetum.track import read_tracks, retrack, track, track_to_file

IMAGE = np.zeros((48, 64), np.uint8)
IMAGE[20:25, 30:35] = 200
BEGUN = 1_780_000_000_000_000_123


class Lamp:
    """A camera of 500 frames a second that loses its fourth, and whose laser blinks."""

    name, live, count, full_scale, rate, hardware = "lamp", True, None, 255, 500.0, {}
    closed = False

    def first(self) -> Frame:
        return Frame(0, 0.0, IMAGE)

    def __len__(self) -> int:
        raise TypeError

    def __iter__(self) -> Iterator[Frame]:
        for n in range(10**6):
            time.sleep(0.002)
            lit = n % 2 == 0
            yield Frame(n, n / 500, IMAGE, f"lamp[{n}]", exposure=1e-3, lit=lit, lost=int(n == 4))

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Six frames; the third one's exposure and laser nobody knows."""
    path = tmp_path / "a.rec"
    with RecordingWriter(path, streams={"probe": StreamInfo(48, 64)}, start_utc_ns=BEGUN) as writer:
        for n in range(6):
            known = {} if n == 2 else {"exposure": 1e-3 * (n + 1), "lit": n % 2 == 0}
            ns = n * 66_666_667
            writer.write("probe", IMAGE, monotonic_ns=5 + ns, utc_ns=BEGUN + ns, dropped_before=2 * (n == 3), **known)
    return path


@pytest.mark.parametrize("kind", ["parquet", "csv", "jsonl"])
def test_a_recordings_moments_are_in_its_tracks(recording: Path, tmp_path: Path, kind: str) -> None:
    out, found = tmp_path / f"t.{kind}", tmp_path / f"d.{kind}"
    assert track_to_file(recording, out, detections=found).lost == 2
    for table in (read_tracks(out), retrack(found)):
        assert table["utc_ns"].to_pylist() == [BEGUN + n * 66_666_667 for n in range(6)]
        assert table["exposure"].to_pylist() == [1e-3, 2e-3, None, 4e-3, 5e-3, 6e-3]
        assert table["lit"].to_pylist() == [True, False, None, False, True, False]
        assert table["lost"].to_pylist() == [0, 0, 0, 2, 0, 0]


def test_a_recording_of_the_first_version_is_read(recording: Path) -> None:
    """Its frames have neither exposure nor laser."""
    import pyarrow.parquet as pq

    frames = recording / FRAMES
    pq.write_table(pq.read_table(frames).select(SCHEMA.names[:5]), frames)
    meta = recording / META
    meta.write_text(meta.read_text().replace('"version": 2', '"version": 1'))
    (first, *_) = open_recording(recording).source("probe")
    assert (first.utc_ns, first.exposure, first.lit) == (BEGUN, None, None)


def test_tracks_of_an_older_version_are_read(recording: Path, tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    out = tmp_path / "t.parquet"
    track_to_file(recording, out)
    pq.write_table(pq.read_table(out).drop_columns(["utc_ns", "exposure", "lit", "lost"]), out)
    assert read_tracks(out)["utc_ns"].to_pylist() == [None] * 6
    assert read_tracks(out)["lit"].type == pa.bool_()


def test_a_journal_keeps_what_is_known(tmp_path: Path) -> None:
    """As a killed writer leaves it."""
    writer = RecordingWriter(tmp_path / "a.rec", streams={"probe": StreamInfo(48, 64)}, start_utc_ns=0)
    for n, (exposure, lit) in enumerate([(None, None), (0.1 + 0.2, True), (0.0, False)]):
        writer.write("probe", IMAGE, monotonic_ns=n, utc_ns=n, exposure=exposure, lit=lit)
    table = open_recording(tmp_path / "a.rec").frames("probe")
    assert table["exposure"].to_pylist()[:2] == [None, 0.1 + 0.2]
    assert table["lit"].to_pylist()[:2] == [None, True]
    writer.close()
    assert open_recording(tmp_path / "a.rec").frames("probe")["lit"].to_pylist() == [None, True, False]


def test_a_camera_is_tracked_as_a_file_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    made: list[Lamp] = []

    def opened(*_: object) -> Lamp:
        made.append(Lamp())
        return made[-1]

    monkeypatch.setattr("tapetum.record.frames.Camera", opened)
    out = tmp_path / "t.parquet"
    assert main(["track", "camera:0", "-o", str(out), "--seconds", "0.2"]) == 0
    table = read_tracks(out)
    assert len(table) > 10 and table["lit"].to_pylist()[:3] == [True, False, True]
    assert table["lost"].to_pylist()[:5] == [0, 0, 0, 0, 1]
    assert abs(table["utc_ns"][0].as_py() - time.time_ns()) < 60e9
    assert np.diff(table["utc_ns"].to_numpy()).min() > 0
    # More of them where this machine is slower than the camera.
    lost = sum(table["lost"].to_pylist())
    assert f"{lost} frame{'' if lost == 1 else 's'} lost" in capsys.readouterr().out
    assert made[0].closed


def test_ctrl_c_ends_a_cameras_table_whole(tmp_path: Path) -> None:
    lamp, out = Lamp(), tmp_path / "t.csv"
    threading.Timer(0.4, signal.raise_signal, (signal.SIGINT,)).start()
    summary = track_to_file(lamp, out)
    assert summary.frames > 10 and read_tracks(out).num_rows == summary.rows
    assert [path.name for path in tmp_path.iterdir()] == ["t.csv"]
    assert lamp.closed


def test_whoever_stops_looking_gives_the_camera_back() -> None:
    lamp = Lamp()
    frames = track(lamp)
    assert next(frames).moment["exposure"] == 1e-3
    frames.close()  # type: ignore[attr-defined]
    assert lamp.closed
