"""Recording from two real sources at once: files at their own times, cameras at this machine's."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tapetum.cli.app import main
from tapetum.errors import InputError
from tapetum.record import open_recording
from tapetum.record.capture import capture
from tapetum.record.frames import open_frames
from tapetum.record.images import hushed
from tapetum.record.layout import StreamInfo
from tapetum.record.reader import WAITING
from tapetum.record.source import Frame, Source
from tapetum.record.video import VideoWriter, read_video
from tapetum.record.writer import RecordingWriter

SIZE = (32, 40)


def picture(n: int) -> np.ndarray:
    return np.random.default_rng(n).integers(0, 256, SIZE).astype(np.uint8)


def video(path: Path, times: list[float]) -> Path:
    with VideoWriter(path, SIZE) as writer:
        for n, t in enumerate(times):
            writer.write(picture(n), t)
    return path


class Webcam:
    """What OpenCV gives for a camera: 60 frames a second in colour, then nothing more after `last`."""

    last: dict[int, int]
    opened: list[Any]

    def __init__(self, number: int) -> None:
        self.number, self.count, self.released = number, 0, False
        self.opened.append(self)

    def isOpened(self) -> bool:
        return self.number in self.last

    def set(self, key: int, value: float) -> bool:
        return key == cv2.CAP_PROP_FPS and value == 60

    def get(self, key: int) -> float:
        return {cv2.CAP_PROP_FPS: 60.0, cv2.CAP_PROP_EXPOSURE: -6.0, cv2.CAP_PROP_GAIN: -1.0}.get(key, 0.0)

    def getBackendName(self) -> str:
        return "MADE UP"

    def grab(self) -> bool:
        time.sleep(1 / 60)
        self.count += 1
        return self.count <= self.last[self.number]

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.repeat(picture(self.count)[..., None], 3, axis=2)

    def read(self) -> tuple[bool, Any]:
        return self.retrieve() if self.last[self.number] else (False, None)

    def release(self) -> None:
        self.released = True


def opened(rate: float | None = None, **sources: object) -> dict[str, Source]:
    """The sources of a recording's streams."""
    return {name: open_frames(str(one), name, rate=rate, late=True) for name, one in sources.items()}


@pytest.fixture
def webcams(monkeypatch: pytest.MonkeyPatch) -> type[Webcam]:
    Webcam.last, Webcam.opened = {0: 10**6, 1: 10**6}, []
    monkeypatch.setattr(cv2, "VideoCapture", Webcam)
    return Webcam


def test_files_keep_their_pixels_and_their_own_times(tmp_path: Path):
    times = [0.0, 0.066, 0.133, 0.4, 0.467]
    probe = video(tmp_path / "p.mkv", times)
    folder = tmp_path / "frames"
    folder.mkdir()
    for n in range(6):
        cv2.imwrite(str(folder / f"{n}.png"), picture(100 + n))
    sources = {
        "probe": open_frames(str(probe), "probe", late=True),
        "target": open_frames(str(folder), "target", rate=20.0, late=True),
    }
    told = capture(sources, tmp_path / "a.rec")
    assert {name: (one.frames, one.lost, one.fault) for name, one in told.items()} == {
        "probe": (5, 0, None),
        "target": (6, 0, None),
    }
    recording = open_recording(tmp_path / "a.rec")
    assert recording.finished
    np.testing.assert_array_equal(list(read_video(recording.video("probe"))), [picture(n) for n in range(5)])
    np.testing.assert_array_equal(list(read_video(recording.video("target"))), [picture(100 + n) for n in range(6)])
    begin = recording.meta["start_utc_ns"]
    np.testing.assert_allclose((recording.utc_ns("probe") - begin) / 1e9, times, atol=1e-6)
    np.testing.assert_allclose((recording.utc_ns("target") - begin) / 1e9, np.arange(6) / 20, atol=1e-6)
    # Both clocks count the same time.
    for name in ("probe", "target"):
        monotonic = recording.frames(name)["monotonic_ns"].to_numpy()
        np.testing.assert_array_equal(np.diff(monotonic), np.diff(recording.utc_ns(name)))
    assert recording.meta["hardware"]["target"]["file"] == "frames"


def test_two_cameras_are_read_at_the_same_time(webcams: type[Webcam], tmp_path: Path):
    webcams.last = {0: 20, 1: 20}
    sources = {
        "probe": open_frames("camera:0", "probe", rate=60, late=True),
        "target": open_frames("camera:1", "target", rate=60, late=True),
    }
    told = capture(sources, tmp_path / "a.rec")
    recording = open_recording(tmp_path / "a.rec")
    spans = {}
    for name, one in told.items():
        utc = recording.utc_ns(name)
        assert one.frames == len(utc) and one.frames + one.lost == 20
        spans[name] = (utc[0], utc[-1])
    assert spans["probe"][0] < spans["target"][1] and spans["target"][0] < spans["probe"][1]
    camera = recording.meta["hardware"]["probe"]
    assert (camera["exposure"], camera["frames_a_second"], camera["driver"]) == (-6.0, 60.0, "MADE UP")
    assert "gain" not in camera and "focus" not in camera
    assert all(one.released for one in webcams.opened)
    assert abs(recording.utc_ns("probe")[0] - time.time_ns()) < 60e9


def test_an_unplugged_camera_ends_its_stream_only(webcams: type[Webcam], tmp_path: Path):
    webcams.last[1] = 4
    probe = video(tmp_path / "p.mkv", [n / 15 for n in range(30)])
    sources = {
        "probe": open_frames(str(probe), "probe", late=True),
        "target": open_frames("camera:1", "target", late=True),
    }
    told = capture(sources, tmp_path / "a.rec")
    assert told["target"].frames == 4
    assert str(told["target"].fault) == "camera:1: gives no more pictures; is it still plugged in?"
    assert (told["probe"].frames, told["probe"].fault) == (30, None)
    recording = open_recording(tmp_path / "a.rec")
    assert recording.finished and len(recording.frames("target")) == 4


def test_a_length_holds_for_both_streams(webcams: type[Webcam], tmp_path: Path):
    probe = video(tmp_path / "p.mkv", [n / 15 for n in range(30)])
    sources = {
        "probe": open_frames(str(probe), "probe", late=True),
        "target": open_frames("camera:0", "target", late=True),
    }
    told = capture(sources, tmp_path / "a.rec", seconds=0.4)
    assert told["probe"].frames == 6
    recording = open_recording(tmp_path / "a.rec")
    assert (recording.utc_ns("target") < recording.meta["start_utc_ns"] + 0.4e9).all()


def test_a_damaged_image_ends_its_stream_only(tmp_path: Path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for n in range(6):
        cv2.imwrite(str(folder / f"{n}.png"), picture(n))
    (folder / "3.png").write_bytes((folder / "3.png").read_bytes()[:-50])
    probe = video(tmp_path / "p.mkv", [n / 15 for n in range(8)])
    told = capture(
        opened(probe=probe, target=folder),
        tmp_path / "a.rec",
    )
    assert (told["probe"].frames, told["target"].frames) == (8, 3)
    assert "3.png: the image is truncated" in str(told["target"].fault)


@pytest.mark.parametrize("kind", ["video", "recording"])
def test_a_video_that_was_cut_gives_all_that_can_be_read(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]):
    probe, target = video(tmp_path / "p.mkv", [n / 15 for n in range(40)]), tmp_path / "t.rec"
    if kind == "video":
        cut = target = video(tmp_path / "t.mkv", [n / 15 for n in range(40)])
    else:
        with RecordingWriter(target, streams={"target": StreamInfo(*SIZE)}, start_utc_ns=0) as writer:
            for n in range(40):
                writer.write("target", picture(n), monotonic_ns=n * 10**7 + 1, utc_ns=n * 10**7)
        cut = target / "target.mkv"
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size * 3 // 4])
    readable = sum(1 for _ in read_video(cut, tolerant=True))
    assert 20 < readable < 40
    out = tmp_path / "a.rec"
    assert main(["record", str(probe), "--target", str(target), "--no-labels", "-o", str(out)]) == 0
    recording = open_recording(out)
    assert recording.finished
    assert (len(recording.frames("probe")), len(recording.frames("target"))) == (40, readable)
    for frame in recording.source("target"):
        np.testing.assert_array_equal(frame.image, picture(frame.index))
    assert f"target ended early: {cut}: the video is truncated" in capsys.readouterr().err


class Made:
    """A source of pictures of any size, and of no camera's habits."""

    live, hardware, count, full_scale, rate = True, {}, None, 255, None

    def __init__(self, name: str, sizes: list[tuple[int, int]]) -> None:
        self.name, self.sizes = name, sizes

    def first(self) -> Frame:
        return Frame(0, 0.0, np.zeros(self.sizes[0], np.uint8))

    def __len__(self) -> int:
        return len(self.sizes)

    def __iter__(self) -> Iterator[Frame]:
        for n, size in enumerate(self.sizes):
            time.sleep(0.002)
            yield Frame(n, n / 15, np.zeros(size, np.uint8), f"{self.name}[{n}]")

    def close(self) -> None:
        pass


def test_a_camera_that_changes_its_size_ends_its_own_stream(tmp_path: Path):
    sources = {"probe": Made("good", [SIZE] * 60), "target": Made("bad", [SIZE] * 5 + [(16, 16)] * 15)}
    told = capture(sources, tmp_path / "a.rec")
    assert (told["probe"].frames, told["target"].frames) == (60, 5)
    assert told["probe"].fault is None
    said = "bad: bad[5] is 16 x 16 px of uint8, full scale 255; the first was 40 x 32 px of uint8, 255"
    assert said in str(told["target"].fault)
    recording = open_recording(tmp_path / "a.rec")
    assert recording.finished and len(recording.frames("probe")) == 60


def test_no_camera_is_closed_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tapetum.record.capture.PATIENCE", 0.05)
    during: list[bool] = []
    back = threading.Event()

    class Slow(Made):
        reading = False

        def __iter__(self) -> Iterator[Frame]:
            yield self.first()
            self.reading = True
            back.wait(5)
            self.reading = False

        def close(self) -> None:
            during.append(self.reading)

    def full(*_: Any, **__: Any) -> None:
        raise InputError("no room left on the disk")

    monkeypatch.setattr(RecordingWriter, "write", full)
    slow = Slow("slow", [SIZE])
    with pytest.raises(InputError, match="no room"):
        capture({"probe": slow}, tmp_path / "a.rec")
    assert during == []
    back.set()
    end = time.monotonic() + 5
    while not during and time.monotonic() < end:
        time.sleep(0.01)
    assert during == [False]


def test_frames_that_waited_in_the_driver_are_not_called_new(
    webcams: type[Webcam], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Four pictures of before the recording stand in the driver's buffer; they come at once."""
    wait = webcams.grab

    def grab(self: Webcam) -> bool:
        if self.count < 4:
            self.count += 1
            return True
        return wait(self)

    monkeypatch.setattr(webcams, "grab", grab)
    capture(opened(probe="camera:0"), tmp_path / "a.rec", seconds=0.3)
    first = next(iter(open_recording(tmp_path / "a.rec").source("probe"))).image
    assert not any(np.array_equal(first, picture(n)) for n in range(5))


def test_threads_that_silence_opencv_leave_it_as_it_was():
    before = cv2.utils.logging.getLogLevel()

    def silence() -> None:
        for _ in range(300):
            with hushed():
                assert cv2.utils.logging.getLogLevel() == cv2.utils.logging.LOG_LEVEL_SILENT
                time.sleep(0)

    threads = [threading.Thread(target=silence) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert cv2.utils.logging.getLogLevel() == before
    # The one that enters first leaves first.
    one, other = hushed(), hushed()
    one.__enter__(), other.__enter__()
    one.__exit__(None, None, None)
    assert cv2.utils.logging.getLogLevel() == cv2.utils.logging.LOG_LEVEL_SILENT
    other.__exit__(None, None, None)
    assert cv2.utils.logging.getLogLevel() == before


def test_images_of_two_sizes_are_told(tmp_path: Path):
    for n in range(3):
        cv2.imwrite(str(tmp_path / f"{n}.png"), picture(n)[: 32 - n])
    told = capture(opened(probe=tmp_path), tmp_path / "a.rec")
    assert told["probe"].frames == 1
    assert "1.png is 40 x 31 px of uint8, full scale 255; the first was 40 x 32 px" in str(told["probe"].fault)


class Quick(Made):
    """A live source faster than any disk, which reports a lost frame itself."""

    sent = 400

    def __init__(self) -> None:
        super().__init__("quick", [SIZE])

    def __iter__(self) -> Iterator[Frame]:
        for n in range(self.sent):
            yield Frame(n, n / 1000, picture(0), lost=int(n == 3))


def test_frames_that_nobody_could_take_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write = RecordingWriter.write

    def slow(self: RecordingWriter, *arguments: Any, **more: Any) -> None:
        time.sleep(0.005)
        write(self, *arguments, **more)

    monkeypatch.setattr(RecordingWriter, "write", slow)
    told = capture({"probe": Quick()}, tmp_path / "a.rec")["probe"]
    assert told.frames >= WAITING and told.lost > 1
    assert told.frames + told.lost == Quick.sent + 1
    kept = open_recording(tmp_path / "a.rec").frames("probe")["dropped_before"].to_numpy()
    assert kept[3] == 1 and kept.sum() <= told.lost


def test_ctrl_c_ends_a_recording_whole(webcams: type[Webcam], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    before = signal.getsignal(signal.SIGINT)

    def interrupt() -> None:
        # Once frames are coming: before that, Ctrl-C ends the program as always.
        while not any(one.count > 10 for one in webcams.opened):
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    arguments = ("record", "camera:0", "--target", "camera:1", "--no-labels", "-o", str(tmp_path / "a.rec"))
    assert main(arguments) == 0
    thread.join()
    assert "probe frames (" in capsys.readouterr().out
    recording = open_recording(tmp_path / "a.rec")
    assert recording.finished and len(recording.frames("probe")) > 1 and len(recording.frames("target")) > 1
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("hand-held", "--target", "p.mkv"), "hand-held: is a scene of the virtual bench, which films its own target"),
        (
            ("p.mkv", "--target", "hand-held"),
            "--target-source hand-held: is a scene of the virtual bench",
        ),
        (("p.mkv", "--target", "nothing.mkv"), "--target-source nothing.mkv: is no camera, video or folder"),
        (("nothing.mkv", "--target", "p.mkv"), "nothing.mkv: does not exist; give the probe's camera:0"),
        (("nothing",), "no such scene, file or folder"),
        (("p.mkv", "--target", "./p.mkv"), "p.mkv: is both probe and target"),
        (("camera:0", "--target", "camera:0"), "camera:0: is both probe and target"),
        (("camera:0", "--target", "camera:7"), "camera:7: no such camera, or it is in use"),
        (("camera:2", "--target", "p.mkv"), "camera:2: the camera gives no picture"),
        (("camera:x", "--target", "p.mkv"), "camera:x: names no camera; write camera:0"),
        (("p.mkv", "--seed", "3"), "--seed: belongs to scenes of the virtual bench; p.mkv is a real source"),
        (("p.mkv", "--set", "distance=3"), "--set: belongs to scenes"),
        (("p.mkv", "--target", "cut.mkv"), "cut.mkv: is not a video that can be read"),
        (("p.mkv", "--target", "words.txt"), "words.txt: is not a video that can be read"),
    ],
)
def test_misuse_is_one_line_and_nothing_is_left(
    arguments: tuple[str, ...],
    told: str,
    webcams: type[Webcam],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    webcams.last[2] = 0
    whole = video(Path("p.mkv"), [n / 15 for n in range(9)]).read_bytes()
    Path("cut.mkv").write_bytes(whole[:300])
    Path("words.txt").write_text("nothing to see")
    assert main(["record", *arguments, "-o", "a.rec"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    assert not Path("a.rec").exists()
    assert all(one.released for one in webcams.opened if one.number in (0, 2))


def test_a_source_without_a_frame_gives_the_others_back(webcams: type[Webcam], tmp_path: Path):
    class Empty(Made):
        def first(self) -> Frame:
            raise InputError("holds no frame", where=self.name)

    with pytest.raises(InputError, match="holds no frame"):
        capture({**opened(probe="camera:0"), "target": Empty("empty", [SIZE])}, tmp_path / "a.rec")
    assert all(one.released for one in webcams.opened) and not (tmp_path / "a.rec").exists()


def test_nothing_recorded_leaves_nothing(webcams: type[Webcam], tmp_path: Path):
    sources = opened(probe="camera:0")
    webcams.last[0] = 0
    with pytest.raises(InputError, match="camera:0: gives no more pictures"):
        capture(sources, tmp_path / "a.rec")
    assert not (tmp_path / "a.rec").exists()


def test_a_scene_file_is_still_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scene = tmp_path / "bench.txt"
    scene.write_text("schema: tapetum/scene/1\n")
    monkeypatch.setattr("tapetum.record.capture.capture", lambda *_, **__: pytest.fail("taken for frames"))
    assert main(["record", str(scene), "-o", str(tmp_path / "a.rec")]) == 2
