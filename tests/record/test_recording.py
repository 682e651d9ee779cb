"""Recordings: what is written comes back, after a proper end, a crash, a kill -9 and on a full disk."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import signal
import subprocess
import threading
import time
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tapetum.errors import InputError
from tapetum.record.frames import open_frames
from tapetum.record.recording import Recording, RecordingWriter, StreamInfo, open_recording
from tapetum.record.source import Frame

START = 1_800_000_000_000_000_000
STREAMS = {"probe": StreamInfo(48, 64), "target": StreamInfo(40, 50, bits=12, rate=30)}
SECOND = 10**9


def image(number: int, stream: str = "probe") -> np.ndarray:
    """The image of a frame, from nothing but its number."""
    info = STREAMS[stream]
    rng = np.random.default_rng(number)
    return rng.integers(0, info.full_scale or 0, (info.height, info.width), info.dtype, endpoint=True)


def writer(path: Path, **options: object) -> RecordingWriter:
    """A writer of two small streams."""
    given: dict = {
        "streams": STREAMS,
        "rate": 15,
        "start_utc_ns": START,
        "hardware": {"probe": "virtual"},
        **options,
    }
    return RecordingWriter(path, **given)


def fill(recorder: RecordingWriter, count: int) -> None:
    """Write `count` frames of both streams; the target is 5 ms late, and lost two before its third."""
    for number in range(count):
        moment = number * SECOND // 15
        recorder.write("probe", image(number), monotonic_ns=moment, utc_ns=START + moment)
        recorder.write(
            "target",
            image(number, "target"),
            monotonic_ns=moment + 5_000_000,
            utc_ns=START + moment + 5_000_000,
            dropped_before=2 if number == 2 else 0,
        )


def check(recording: Recording, stream: str) -> int:
    """Compare every frame of a stream with what was written; return how many there are."""
    source = recording.source(stream)
    count = 0
    for frame in source:
        assert np.array_equal(frame.image, image(frame.index, stream))
        assert frame.time == pytest.approx(frame.index / 15, abs=1e-8)
        count += 1
    assert count == source.count == len(source) == len(recording.frames(stream))
    return count


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "a.rec"
    with writer(path, extra={"scene": {"name": "thin-lens"}, "seed": 7}) as recorder:
        fill(recorder, 9)
        assert recorder.counts == {"probe": 9, "target": 9}
    assert sorted(file.name for file in path.iterdir()) == [
        "frames.parquet",
        "probe.mkv",
        "recording.json",
        "target.mkv",
    ]
    recording = open_recording(path)
    assert recording.finished and recording.name == "a" and len(recording.uuid) == 36
    assert recording.meta["format"] == "tapetum-recording" and recording.meta["version"] == 2
    assert recording.meta["start_utc"] == "2027-01-15T08:00:00.000000Z"
    assert recording.meta["seed"] == 7 and recording.meta["hardware"] == {"probe": "virtual"}
    assert recording.streams == {
        "probe": StreamInfo(48, 64, 8, 255, 15),
        "target": StreamInfo(40, 50, 12, 4095, 30),
    }
    assert check(recording, "probe") == check(recording, "target") == 9
    table = recording.frames("target")
    assert table.column_names == ["stream", "index", "monotonic_ns", "utc", "dropped_before", "exposure", "lit"]
    assert table["dropped_before"].to_pylist() == [0, 0, 2, 0, 0, 0, 0, 0, 0]
    assert recording.utc_ns("target")[1] == START + SECOND // 15 + 5_000_000
    source = open_frames(path, "target")
    assert source.full_scale == 4095 and source.name.endswith("a.rec:target")
    assert [frame.name for frame in source][3] == "target[3]"
    assert recording.labels() is None and recording.truth() is None


def test_labels_and_truth_are_kept_and_replaced(tmp_path: Path) -> None:
    with writer(tmp_path / "a.rec") as recorder:
        fill(recorder, 2)
    recording = open_recording(tmp_path / "a.rec")
    for quality in (0.5, 0.9):
        table = pa.table({"frame": [0, 1], "how": ["hand"] * 2, "quality": [quality] * 2})
        recording.write_labels(table)
        assert recording.labels() == table
    recording.write_truth(pa.table({"frame": [0, 1], "gaze_x": [0.1, 0.2]}))
    truth = recording.truth()
    assert truth is not None and truth["gaze_x"].to_pylist() == [0.1, 0.2]
    with pytest.raises(InputError, match="lack the columns how, quality"):
        recording.write_labels(pa.table({"frame": [0]}))
    with pytest.raises(InputError, match="frame"):
        recording.write_truth(pa.table({"gaze_x": [0.0]}))
    (recording.path / "labels.parquet").write_bytes(b"PAR1 but not really")
    with pytest.raises(InputError, match=r"labels\.parquet: is damaged"):
        recording.labels()


def test_an_exception_leaves_a_readable_unfinished_recording(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), writer(tmp_path / "a.rec") as recorder:
        fill(recorder, 6)
        raise ZeroDivisionError
    recording = open_recording(tmp_path / "a.rec")
    assert not recording.finished
    assert check(recording, "probe") == check(recording, "target") == 6


def test_an_exception_before_the_first_frame_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), writer(tmp_path / "a.rec"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def endless(path: Path, sent: Connection) -> None:
    """Film without an end, and say each frame that was handed over."""
    recorder = writer(path)
    for number in range(10_000):
        moment = number * SECOND // 15
        for stream in STREAMS:
            recorder.write(stream, image(number, stream), monotonic_ns=moment, utc_ns=START + moment)
        sent.send_bytes(number.to_bytes(4))


@pytest.mark.parametrize("after", [1, 40])
def test_kill_9_in_the_middle_of_filming(tmp_path: Path, after: int, processes: BaseContext) -> None:
    path = tmp_path / "a.rec"
    told, sent = processes.Pipe(duplex=False)
    process = processes.Process(target=endless, args=(path, sent))
    process.start()
    sent.close()
    said = -1
    while said < after:
        said = int.from_bytes(told.recv_bytes())
    process.kill()
    with contextlib.suppress(EOFError, OSError):
        while True:
            said = int.from_bytes(told.recv_bytes())
    process.join()
    assert process.exitcode == -signal.SIGKILL
    recording = open_recording(path)
    assert not recording.finished
    for stream in STREAMS:
        # Frames 0 … said were handed over; the newest may be lost, and one more may have been on its way.
        assert said <= check(recording, stream) <= said + 2
        assert len(list(open_frames(path, stream))) == len(recording.frames(stream))


def test_a_torn_journal_and_a_torn_video_are_clipped(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), writer(tmp_path / "a.rec") as recorder:
        fill(recorder, 6)
        raise ZeroDivisionError
    journal, video = tmp_path / "a.rec" / "frames.journal", tmp_path / "a.rec" / "target.mkv"
    journal.write_bytes(journal.read_bytes()[:-7])
    data = video.read_bytes()
    video.write_bytes(data[: len(data) // 2])
    recording = open_recording(tmp_path / "a.rec")
    assert check(recording, "probe") == 6
    assert check(recording, "target") in (2, 3)
    journal.write_bytes(b"probe 0 garbage\n" + journal.read_bytes())
    with pytest.raises(InputError, match=r"frames\.journal: line 1 is damaged"):
        recording.frames("probe")
    journal.unlink()
    with pytest.raises(InputError, match=r"neither frames\.parquet nor frames\.journal"):
        recording.frames("probe")


def test_a_finished_recording_with_a_truncated_video_is_refused(tmp_path: Path) -> None:
    with writer(tmp_path / "a.rec") as recorder:
        fill(recorder, 6)
    video = tmp_path / "a.rec" / "probe.mkv"
    data = video.read_bytes()
    video.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"probe\.mkv: the video is truncated or damaged: [23] frames"):
        list(open_frames(tmp_path / "a.rec"))
    video.unlink()
    with pytest.raises(InputError, match=r"probe\.mkv: does not exist"):
        open_frames(tmp_path / "a.rec")


def limited(path: Path, told: Connection) -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
    try:
        with writer(path) as recorder:
            fill(recorder, 200)
    except InputError as error:
        told.send(str(error))


def test_a_file_that_may_grow_no_more(tmp_path: Path, processes: BaseContext) -> None:
    path = tmp_path / "a.rec"
    told, sent = processes.Pipe(duplex=False)
    process = processes.Process(target=limited, args=(path, sent))
    process.start()
    sent.close()
    complaint = told.recv()
    process.join()
    assert process.exitcode == 0 and "a.rec" in complaint and "\n" not in complaint
    recording = open_recording(path)
    assert not recording.finished
    assert check(recording, "probe") > 10


def test_a_full_disk_is_one_line_and_loses_nothing_before(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=400k", "tapetum-test", str(disk)]
    if os.name != "posix" or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("this user may not mount a small file system")
    try:
        with (
            pytest.raises(InputError, match="no room left on the disk") as caught,
            writer(disk / "a.rec") as recorder,
        ):
            fill(recorder, 500)
        assert "\n" not in str(caught.value)
        recording = open_recording(disk / "a.rec")
        assert not recording.finished
        assert check(recording, "probe") > 20 and check(recording, "target") > 20
        # No room at all: nothing is left behind.
        with pytest.raises(InputError, match="no room left"), writer(disk / "b.rec") as recorder:
            fill(recorder, 500)
        assert not any(path.name == "b.rec" for path in disk.iterdir())
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=False)


def test_frames_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with writer(tmp_path / "a.rec") as recorder:
        good = {"monotonic_ns": 5, "utc_ns": START}
        with pytest.raises(InputError, match="no stream 'side'"):
            recorder.write("side", image(0), **good)
        with pytest.raises(InputError, match=r"\[40, 50\] uint16"):
            recorder.write("probe", image(0, "target"), **good)
        recorder.write("probe", image(0), **good)
        with pytest.raises(InputError, match=r"probe\[1\]: the monotonic clock does not rise \(5 then 5 ns\)"):
            recorder.write("probe", image(1), **good)
        with pytest.raises(InputError, match="dropped_before"):
            recorder.write("probe", image(1), monotonic_ns=6, utc_ns=START, dropped_before=-1)
        recorder.write("probe", image(1), monotonic_ns=6, utc_ns=START + 1)
    with pytest.raises(InputError, match="closed"):
        recorder.write("probe", image(2), monotonic_ns=7, utc_ns=START + 2)
    assert len(open_recording(tmp_path / "a.rec").frames("probe")) == 2
    # A stream in which nothing came stays a stream without frames.
    assert list(open_frames(tmp_path / "a.rec", "target")) == []
    with pytest.raises(InputError, match="no stream 'side'; the recording has probe, target"):
        open_frames(tmp_path / "a.rec", "side")


def test_the_laser_s_state_is_a_bool_of_any_type(tmp_path: Path) -> None:
    states = [None, True, np.bool_(False), np.True_, 0, np.int64(1)]
    with writer(tmp_path / "a.rec") as recorder:
        for number, lit in enumerate(states):
            given: dict = {"monotonic_ns": number, "utc_ns": START + number, "lit": lit}
            recorder.write("probe", image(number), **given)
        for wrong in (2, 0.5, "on"):
            given = {"monotonic_ns": 99, "utc_ns": START + 99, "lit": wrong}
            with pytest.raises(InputError, match=f"lit cannot be {wrong!r}"):
                recorder.write("probe", image(0), **given)
    kept = open_recording(tmp_path / "a.rec").frames("probe")["lit"].to_pylist()
    assert kept == [None, True, False, True, False, True]


def test_a_frame_without_clocks_is_told(tmp_path: Path) -> None:
    with writer(tmp_path / "a.rec") as recorder:
        with pytest.raises(InputError, match="frame 3: utc_ns is None and monotonic_ns is 7"):
            recorder.add("probe", Frame(3, 0.0, image(3), monotonic_ns=7))
        fill(recorder, 1)


def test_bad_arguments(tmp_path: Path) -> None:
    path = tmp_path / "a.rec"
    with pytest.raises(InputError, match="at least one"):
        writer(path, streams={})
    with pytest.raises(InputError, match=r"cannot name a stream '\.\./x'"):
        writer(path, streams={"../x": StreamInfo(4, 4)})
    with pytest.raises(InputError, match="uuid is a name"):
        writer(path, extra={"uuid": "mine"})
    with pytest.raises(InputError, match="JSON cannot hold"):
        writer(path, extra={"array": np.zeros(3)})
    with pytest.raises(InputError, match="JSON cannot hold"):
        writer(path, hardware={"gain": float("nan")})
    with pytest.raises(InputError, match="bits"):
        StreamInfo(4, 4, bits=17)
    with pytest.raises(InputError, match="size"):
        StreamInfo(0, 4)
    assert not path.exists()


def test_overwriting_only_recordings_and_only_when_asked(tmp_path: Path) -> None:
    path = tmp_path / "a.rec"
    for count in (3, 2):
        with writer(path, overwrite=True) as recorder:
            fill(recorder, count)
    with pytest.raises(InputError, match="exists already"):
        writer(path)
    assert check(open_recording(path), "probe") == 2
    precious = tmp_path / "thesis"
    precious.mkdir()
    (precious / "chapter.tex").write_text("x")
    with pytest.raises(InputError, match=r"recording\.json"):
        writer(precious, overwrite=True)
    assert (precious / "chapter.tex").exists()


@pytest.mark.parametrize("frames", [0, 2])
def test_a_recording_stands_until_the_one_that_replaces_it_is_whole(tmp_path: Path, frames: int) -> None:
    path = tmp_path / "a.rec"
    with writer(path) as recorder:
        fill(recorder, 3)
    old = open_recording(path).uuid
    with pytest.raises(KeyboardInterrupt) as raised, writer(path, overwrite=True) as recorder:
        fill(recorder, frames)
        assert open_recording(path).uuid == old
        raise KeyboardInterrupt
    assert open_recording(path).uuid == old and check(open_recording(path), "probe") == 3
    left = tmp_path / "a.unfinished.rec"
    assert left.exists() == bool(frames)
    if frames:
        new = open_recording(left)
        assert not new.finished and check(new, "probe") == frames
        assert raised.value.__notes__ == [
            f"2 probe frames and 2 target frames are kept in {left}, marked as unfinished"
        ]
    # What was left is not in the way of the next one, and that takes the old one's place at once.
    with writer(path, overwrite=True) as recorder:
        fill(recorder, 4)
    assert check(open_recording(path), "probe") == 4 and open_recording(path).finished
    assert left.exists() == bool(frames) and len(list(tmp_path.iterdir())) == 1 + bool(frames)


def test_a_second_command_does_not_write_into_a_recording(tmp_path: Path) -> None:
    told: list[str] = []

    def second() -> None:
        with pytest.raises(InputError) as raised:
            writer(tmp_path / "a.rec", overwrite=True)
        told.append(str(raised.value))

    with writer(tmp_path / "a.rec") as recorder:
        fill(recorder, 2)
        thread = threading.Thread(target=second)
        thread.start()
        thread.join()
        assert "is being written by process" in told[0]
    assert check(open_recording(tmp_path / "a.rec"), "probe") == 2


def test_what_is_called_finished_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not Path("/proc/self/fd").exists():
        pytest.skip("asks Linux which file was flushed")
    calls: list[str] = []
    flush, replace, unlink = os.fsync, os.replace, Path.unlink

    def fsync(handle: int) -> None:
        calls.append("flush " + re.sub(r"^\.(.*?)-.*", r"\1", Path(f"/proc/self/fd/{handle}").readlink().name))
        flush(handle)

    def replaced(one, other, **more):
        finished = '"finished": true' in Path(one).read_text("utf-8", "ignore")
        calls.append(f"name {Path(other).name}{' finished' * finished}")
        return replace(one, other, **more)

    def unlinked(self: Path, **more) -> None:
        calls.append(f"remove {self.name}")
        unlink(self, **more)

    with writer(tmp_path / "a.rec") as recorder:
        fill(recorder, 2)
        monkeypatch.setattr(os, "fsync", fsync)
        monkeypatch.setattr(os, "replace", replaced)
        monkeypatch.setattr(Path, "unlink", unlinked)
    done = calls.index("name recording.json finished")
    for before in ("flush probe.mkv", "flush target.mkv", "flush frames.parquet", "flush recording.json"):
        assert before in calls[:done], calls
    assert calls.index("flush frames.parquet") < calls.index("name frames.parquet") < done
    # The names are flushed too before the journal, the other list of the frames, goes.
    assert calls.index("remove frames.journal") > done + calls[done:].index("flush a.rec")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 3}, "is of version 3, this Tapetum reads up to 2; update Tapetum"),
        ({"version": "1"}, "no usable version"),
        ({"format": "tapetum-dataset"}, "is not a tapetum-recording"),
        ({"streams": {"probe": {"height": 4}}}, "streams.probe.file: is missing"),
        ({"finished": None}, "finished: must be a valid boolean, is None"),
    ],
)
def test_foreign_and_newer_recordings_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    with writer(tmp_path / "a.rec") as recorder:
        fill(recorder, 1)
    file = tmp_path / "a.rec" / "recording.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(InputError, match=r"recording\.json") as caught:
        open_recording(tmp_path / "a.rec")
    assert message in str(caught.value)
    file.write_text("{")
    with pytest.raises(InputError, match="is damaged"):
        open_recording(tmp_path / "a.rec")


def test_writing_keeps_up_with_two_cameras(tmp_path: Path) -> None:
    # A floor far below what is usual (some 150 a second and more), for machines that do much else.
    streams = {"probe": StreamInfo(480, 640), "target": StreamInfo(486, 648)}
    rng = np.random.default_rng(0)
    frames = {name: rng.poisson(20, (info.height, info.width)).astype(np.uint8) for name, info in streams.items()}
    start = time.process_time()
    with writer(tmp_path / "a.rec", streams=streams) as recorder:
        for number in range(15):
            for name, frame in frames.items():
                recorder.write(name, frame, monotonic_ns=number, utc_ns=START + number)
    assert (time.process_time() - start) / 30 < 1 / 30
