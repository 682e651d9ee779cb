"""Linux's interface to cameras: its numbers against the system's header, and a stand-in for a driver."""

from __future__ import annotations

import itertools
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.record import v4l2
from tapetum.record.frames import open_frames
from tapetum.record.v4l2 import IOCTLS, V4l2Camera, modes_of

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="V4L2 is Linux's")


def test_the_requests_are_those_of_the_system(tmp_path: Path) -> None:
    """Each number holds its structure's size."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not Path("/usr/include/linux/videodev2.h").exists():
        # From <linux/videodev2.h> of Linux 6.1, 64 bits.
        known = {"VIDIOC_QUERYCAP": 0x80685600, "VIDIOC_S_FMT": 0xC0D05605, "VIDIOC_DQBUF": 0xC0585611}
        known |= {"VIDIOC_REQBUFS": 0xC0145608, "VIDIOC_ENUM_FRAMESIZES": 0xC02C564A, "VIDIOC_S_PARM": 0xC0CC5616}
        assert {name: IOCTLS[name] for name in known} == known
        return
    lines = [f'  printf("{name} %lu\\n", (unsigned long){name});' for name in IOCTLS]
    # Where the members lie that are read and written.
    members = ("index", "flags", "timestamp", "sequence", "m", "length")
    lines += [
        f'  printf("buffer.{one} %lu\\n", (unsigned long)offsetof(struct v4l2_buffer, {one}));' for one in members
    ]
    lines.append('  printf("pix %lu\\n", (unsigned long)offsetof(struct v4l2_format, fmt));')
    head = "#include <linux/videodev2.h>\n#include <stdio.h>\n#include <stddef.h>\nint main(void) {\n"
    (tmp_path / "a.c").write_text(head + "\n".join(lines) + "\n  return 0;\n}\n")
    subprocess.run([compiler, "a.c", "-o", "a"], cwd=tmp_path, check=True)
    told = subprocess.run([str(tmp_path / "a")], capture_output=True, text=True, check=True).stdout.split("\n")
    found = dict(line.split() for line in told if line)
    assert {name: int(found[name]) for name in IOCTLS} == IOCTLS
    # A buffer with one value a member, to see where the code puts it.
    values = struct.unpack("=22I", v4l2._BUFFER.pack(1, 0, 0, 4, 0, 6, 0, 14, 0, 16, 18, 0, 0))
    places = {"index": 1, "flags": 4, "timestamp": 6, "sequence": 14, "m": 16, "length": 18}
    assert {name: 4 * values.index(value) for name, value in places.items()} == {
        name: int(found[f"buffer.{name}"]) for name in places
    }
    assert int(found["pix"]) == 8


class Driver(v4l2.Device):
    """A camera that counts: `frames` are given one after another, then it is unplugged."""

    def __init__(self, *, codes: tuple[str, ...] = ("MJPG", "Y12 ", "GREY"), frames: int = 6, able: int = 0x0420_0001):
        self.codes, self.left, self.able = codes, frames, able
        self.memory: list[bytearray] = []
        self.queue: list[int] = []
        self.number = 7
        self.streams, self.closed, self.missing = False, False, 0

    def _send(self, number: int, buffer: bytearray) -> None:
        name = next(name for name, value in IOCTLS.items() if value == number)
        getattr(self, name.removeprefix("VIDIOC_").lower())(buffer)

    def querycap(self, buffer: bytearray) -> None:
        v4l2._CAPABILITY.pack_into(buffer, 0, b"fake", b"A camera", b"usb-1", 0, 0x8400_0000 | self.able, self.able)

    def enum_fmt(self, buffer: bytearray) -> None:
        index = v4l2._FORMAT_ENTRY.unpack(buffer)[0]
        if index >= len(self.codes):
            raise OSError(22, "Invalid argument")
        code = int.from_bytes(self.codes[index].encode(), "little")
        v4l2._FORMAT_ENTRY.pack_into(buffer, 0, index, 1, 0, b"", code)

    def enum_framesizes(self, buffer: bytearray) -> None:
        index, code, *_ = v4l2._SIZE_ENTRY.unpack(buffer)
        if index > 1:
            raise OSError(22, "Invalid argument")
        size = ((8, 6), (16, 12))[index]
        v4l2._SIZE_ENTRY.pack_into(buffer, 0, index, code, 1, *size, 0, 0, 0, 0)

    def enum_frameintervals(self, buffer: bytearray) -> None:
        index, *rest = v4l2._RATE_ENTRY.unpack(buffer)
        if index > 1:
            raise OSError(22, "Invalid argument")
        v4l2._RATE_ENTRY.pack_into(buffer, 0, index, *rest[:3], 1, 1, (15, 60)[index], 0, 0, 0, 0)

    def s_fmt(self, buffer: bytearray) -> None:
        _, self.width, self.height, self.code, field, _, _ = v4l2._FORMAT.unpack(buffer)
        self.stride = 2 * self.width + 4
        v4l2._FORMAT.pack_into(
            buffer, 0, 1, self.width, self.height, self.code, field, self.stride, self.stride * self.height
        )

    def s_parm(self, buffer: bytearray) -> None:
        v4l2._RATE.pack_into(buffer, 0, 1, 0, 0, 1, 30)

    def reqbufs(self, buffer: bytearray) -> None:
        count = v4l2._REQUEST.unpack(buffer)[0] - 2
        self.memory = [bytearray(self.stride * self.height) for _ in range(count)]
        v4l2._REQUEST.pack_into(buffer, 0, count, 1, 1)

    def querybuf(self, buffer: bytearray) -> None:
        values = list(v4l2._BUFFER.unpack(buffer))
        values[9], values[10] = 4096 * values[0], len(self.memory[values[0]])
        v4l2._BUFFER.pack_into(buffer, 0, *values)

    def qbuf(self, buffer: bytearray) -> None:
        self.queue.append(v4l2._BUFFER.unpack(buffer)[0])

    def streamon(self, buffer: bytearray) -> None:
        self.streams = True

    def streamoff(self, buffer: bytearray) -> None:
        self.streams = False

    def dqbuf(self, buffer: bytearray) -> None:
        if not self.left:
            raise OSError(19, "No such device")
        self.left -= 1
        self.number += 1 + self.missing
        self.missing = 0
        index = self.queue.pop(0)
        image = np.full((self.height, self.stride // 2), 0xEEEE, "<u2")
        image[:, : self.width] = self.number * 100
        self.memory[index][:] = image.tobytes()
        now = time.monotonic_ns()
        v4l2._BUFFER.pack_into(
            buffer, 0, index, 1, len(self.memory[index]), 0x2000, 0, now // 10**9, now % 10**9 // 1000,
            self.number, 1, 0, 0, 0, 0,
        )  # fmt: skip

    def map(self, length: int, offset: int) -> memoryview:
        assert length == len(self.memory[offset // 4096])
        return memoryview(self.memory[offset // 4096])

    def wait(self, seconds: float) -> bool:
        return bool(self.queue)

    def close(self) -> None:
        self.closed = True


def test_the_deepest_grey_form_at_its_largest_size_is_read() -> None:
    driver = Driver(frames=5)
    camera = V4l2Camera("v4l2:0", device=driver)
    assert camera.hardware["bits"] == 12 and camera.hardware["card"] == "A camera" and camera.full_scale == 4095
    assert camera.rate == 60 and camera.live and camera.first().image[0, 0] == 800
    came = []
    with pytest.raises(InputError, match=r"v4l2:0: gives no more frames \(No such device\); is it still plugged in"):
        for frame in camera:
            came.append(frame)
            if len(came) == 2:
                driver.missing = 3
    assert [int(frame.image[3, 5]) for frame in came] == [900, 1000, 1400, 1500]
    assert all(frame.image.shape == (12, 16) and (frame.image == frame.image[0, 0]).all() for frame in came)
    assert [frame.lost for frame in came] == [0, 0, 3, 0]
    assert all(a.monotonic_ns < b.monotonic_ns for a, b in itertools.pairwise(came))  # type: ignore[operator]
    assert abs((came[0].utc_ns or 0) - time.time_ns()) < 5e9
    camera.close()
    assert driver.closed and not driver.streams


def test_a_form_and_a_size_can_be_asked_for() -> None:
    driver = Driver(codes=("Y10 ", "Y16 "))
    camera = V4l2Camera("v4l2:/dev/video3,Y10,8x6", rate=30, device=driver)
    assert camera.first().image.shape == (6, 8) and camera.full_scale == 1023 and camera.rate == 30
    assert driver.code.to_bytes(4, "little") == b"Y10 "
    camera.close()
    offered = r"ask for one of Y10,8x6, Y10,16x12, Y16,8x6, Y16,16x12"
    for asked in ("Y12", "9x9"):
        driver = Driver(codes=("Y10 ", "Y16 "))
        with pytest.raises(InputError, match=rf"v4l2:0,{asked}: offers no {asked}; {offered}"):
            V4l2Camera(f"v4l2:0,{asked}", device=driver)
        assert driver.closed


def test_what_gives_no_grey_frames_is_refused() -> None:
    with pytest.raises(InputError, match=r"offers no grey form, but MJPG, YUYV; use camera:N"):
        V4l2Camera("v4l2:0", device=Driver(codes=("MJPG", "YUYV")))
    with pytest.raises(InputError, match="gives no frames"):
        V4l2Camera("v4l2:0", device=Driver(able=0x1))
    with pytest.raises(InputError, match=r"/dev/video97 cannot be opened \(No such file"):
        open_frames("v4l2:97")
    with pytest.raises(InputError, match="names no camera; write v4l2:0"):
        open_frames("v4l2:front")


def test_a_camera_that_waits_for_a_trigger_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver()
    monkeypatch.setattr(driver, "wait", lambda seconds: False)
    with pytest.raises(InputError, match=r"gave no frame for 5 s; is it still plugged in, or does it wait"):
        V4l2Camera("v4l2:0", device=driver)
    assert driver.closed


def test_modes_are_listed_with_their_bits() -> None:
    modes = modes_of(Driver())
    assert [(mode.code, mode.width, mode.bits) for mode in modes] == [
        ("MJPG", 8, None), ("MJPG", 16, None), ("Y12", 8, 12), ("Y12", 16, 12), ("GREY", 8, 8), ("GREY", 16, 8),
    ]  # fmt: skip
    assert modes[0].rates == (60.0, 15.0)


def test_the_command_lists_what_is_there(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    import json

    from tapetum.cli.app import main
    from tapetum.record import plugged

    monkeypatch.setattr(plugged, "v4l2_devices", list)
    monkeypatch.setattr(plugged, "find_genicam", lambda: None)
    assert main(["cameras"]) == 0
    said = capsys.readouterr()
    assert said.out == "no camera is plugged in\n" and "GenICam was not searched" in said.err
    drivers = {"/dev/video0": Driver(), "/dev/video1": Driver(able=0), "/dev/video2": Driver(codes=("YUYV",))}
    monkeypatch.setattr(plugged, "v4l2_devices", lambda: [*drivers, "/dev/video9"])

    def opened(path: str) -> Driver:
        if path not in drivers:
            raise PermissionError(13, "Permission denied")
        return drivers[path]

    monkeypatch.setattr(plugged, "Device", opened)
    monkeypatch.setattr(plugged, "find_genicam", lambda: [("Maker-1", "Maker M1", ["Mono8", "Mono12p"])])
    assert main(["cameras"]) == 0
    said = capsys.readouterr()
    lines = said.out.splitlines()
    assert [line for line in lines if not line.startswith(" ")] == [
        "v4l2:0  A camera (camera:0 reads its colour forms as 8 bit grey)",
        "camera:2  A camera (colour becomes grey, 8 bit)",
        "genicam:Maker-1  Maker M1",
    ]
    assert "    Y12, 16 x 12 px, 12 bit grey, up to 60 frames/s" in lines and "    Mono12p, 12 bit grey" in lines
    assert "/dev/video9 cannot be opened (Permission denied)" in said.err
    assert main(["cameras", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [one["source"] for one in told["cameras"]] == ["v4l2:0", "camera:2", "genicam:Maker-1"]
