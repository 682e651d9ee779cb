"""The record button: what is written, what is lost, and what stays when something fails."""

from __future__ import annotations

import contextlib
import resource
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.live.recorder import Recorder
from tapetum.record.recording import open_recording
from tapetum.record.source import Frame

FRAMES = [
    Frame(
        k,
        k / 20,
        np.random.default_rng(k).integers(0, 255, (48, 64)).astype(np.uint8),
        monotonic_ns=10**9 + k * 50_000_000,
        utc_ns=10**18 + k * 50_000_000,
        lit=bool(k % 2),
        lost=int(k == 7),
    )
    for k in range(40)
]


def test_frames_are_recorded_between_start_and_stop(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path)
    recorder.offer(FRAMES[0])
    name = recorder.start()
    with pytest.raises(InputError, match="a recording is under way"):
        recorder.start()
    for one in FRAMES[5:25]:
        recorder.offer(one)
    # A frame of another size is left out and counted; the recording goes on.
    recorder.offer(replace(FRAMES[25], image=np.zeros((10, 10), np.uint8)))
    recorder.offer(FRAMES[26])
    recorder.stop()
    recorder.offer(FRAMES[27])
    state = recorder.state
    assert (state.running, state.frames, state.lost, state.fault) == (False, 21, 1, "")
    read = open_recording(tmp_path / name)
    got = list(read.source("probe"))
    assert [one.image.tobytes() for one in got] == [one.image.tobytes() for one in [*FRAMES[5:25], FRAMES[26]]]
    assert [one.lit for one in got[:4]] == [True, False, True, False]
    assert [one.lost for one in got[:4]] == [0, 0, 1, 0] and got[-1].lost == 1
    assert recorder.start() != name
    recorder.stop()
    # Without a frame nothing stays.
    assert [one.name for one in tmp_path.iterdir()] == [name]


def test_without_a_folder_or_room_there_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="serve with --folder"):
        Recorder().start()
    with pytest.raises(InputError, match="the disk has"):
        Recorder(tmp_path, least_free=1 << 60).start()


def test_a_disk_that_fills_up_ends_the_recording_which_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tapetum.live.recorder._CHECK_EVERY", 0.0)
    recorder = Recorder(tmp_path)
    name = recorder.start()
    for one in FRAMES[:10]:
        recorder.offer(one)
    end = time.monotonic() + 20
    while recorder.state.frames < 10 and time.monotonic() < end:
        time.sleep(0.01)
    recorder.least_free = 1 << 60
    recorder.offer(FRAMES[10])
    while recorder.state.running and time.monotonic() < end:
        time.sleep(0.01)
    assert "the disk has" in recorder.state.fault and "are kept" in recorder.state.fault
    assert len(list(open_recording(tmp_path / name).source("probe"))) >= 10


def limited(folder: Path, count: int, told: Connection) -> None:
    """Record where no file may grow beyond 200 kB; say the recording's name, that all is written, and the fault."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
    recorder = Recorder(folder, least_free=0)
    told.send(recorder.start())
    rng = np.random.default_rng(0)
    for k in range(count):
        image = rng.integers(0, 255, (96, 128)).astype(np.uint8)
        recorder.offer(Frame(k, k / 20, image, monotonic_ns=k * 10**7 + 1, utc_ns=k))
        time.sleep(0.003)
    while recorder.state.running and recorder.state.frames < count:
        time.sleep(0.01)
    told.send("ready")
    told.recv()
    recorder.stop()
    told.send(recorder.state.fault)


@contextlib.contextmanager
def started(processes: BaseContext, folder: Path, count: int) -> Iterator[tuple[BaseProcess, Connection]]:
    here, there = processes.Pipe()
    process = processes.Process(target=limited, args=(folder, count, there))
    process.start()
    there.close()
    try:
        yield process, here
    finally:
        process.kill()
        process.join()


def test_a_limit_of_the_files_size_keeps_every_frame_before_it(tmp_path: Path, processes: BaseContext) -> None:
    with started(processes, tmp_path, 60) as (process, told):
        name = told.recv()
        assert told.recv() == "ready"
        told.send("stop")
        assert "kept in" in told.recv()
        process.join(60)
        assert process.exitcode == 0
    frames = _readable(tmp_path / name)
    assert len(frames) >= 10


def test_kill_9_keeps_what_was_recorded(tmp_path: Path, processes: BaseContext) -> None:
    with started(processes, tmp_path, 12) as (process, told):
        name = told.recv()
        assert told.recv() == "ready"
        process.kill()
        process.join(20)
        assert process.exitcode == -signal.SIGKILL
    # At most the newest frame is lost.
    assert len(_readable(tmp_path / name)) >= 11


def _readable(path: Path) -> list[Frame]:
    frames: list[Frame] = []
    with contextlib.suppress(InputError):
        frames.extend(open_recording(path).source("probe"))
    return frames
