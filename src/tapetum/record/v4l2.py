"""Cameras of Linux read by its own interface (V4L2), for the grey forms of 10 to 16 bits that OpenCV cannot give.

Only what a grey camera takes: list, set a format, stream by mapped buffers. The libraries for it do not serve: linuxpy
(before: v4l2py) is under the GPL, and FFmpeg's reader knows of these forms GREY and Y16 alone. Structures and numbers
are those of <linux/videodev2.h> on machines of 64 bits; a test compares them with that header.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tapetum.errors import InputError
from tapetum.record.images import natural_key
from tapetum.record.pixels import FORMATS, decode
from tapetum.record.source import Arrival, Live

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

__all__ = ["IOCTLS", "Device", "Mode", "V4l2Camera", "is_v4l2", "modes_of", "v4l2_devices"]

PREFIX = "v4l2:"
_CAPTURE, _MAPPED, _ANY = 1, 1, 0
_VIDEO_CAPTURE, _STREAMING, _DEVICE_CAPS = 0x1, 0x0400_0000, 0x8000_0000
_DISCRETE = 1
_MONOTONIC, _CLOCKS, _ERROR = 0x2000, 0xE000, 0x40
_BUFFERS = 6
_PATIENCE = 5.0  # s without a frame


def _code(direction: int, number: int, size: int) -> int:
    """Return an ioctl's number: direction (1 write, 2 read), size, the letter V and its own number."""
    return direction << 30 | size << 16 | ord("V") << 8 | number


_CAPABILITY = struct.Struct("=16s32s32sIII12x")
_FORMAT_ENTRY = struct.Struct("=III32sI16x")
# Type, then (aligned to 8) width, height, code, field, bytes a line, bytes, and the rest of a union of 200.
_FORMAT = struct.Struct("=I4xIIIIII176x")
_REQUEST = struct.Struct("=III8x")
_BUFFER = struct.Struct("=IIIII4xqq16xIII4xIII4x")
_TYPE = struct.Struct("=I")
_SIZE_ENTRY = struct.Struct("=IIIIIIIII8x")
_RATE_ENTRY = struct.Struct("=IIIIIIIIIII8x")
# Type, capabilities, mode, seconds a frame as a fraction, and the rest of a union of 200.
_RATE = struct.Struct("=IIIII184x")

IOCTLS = {
    "VIDIOC_QUERYCAP": _code(2, 0, _CAPABILITY.size),
    "VIDIOC_ENUM_FMT": _code(3, 2, _FORMAT_ENTRY.size),
    "VIDIOC_S_FMT": _code(3, 5, _FORMAT.size),
    "VIDIOC_REQBUFS": _code(3, 8, _REQUEST.size),
    "VIDIOC_QUERYBUF": _code(3, 9, _BUFFER.size),
    "VIDIOC_QBUF": _code(3, 15, _BUFFER.size),
    "VIDIOC_DQBUF": _code(3, 17, _BUFFER.size),
    "VIDIOC_STREAMON": _code(1, 18, _TYPE.size),
    "VIDIOC_STREAMOFF": _code(1, 19, _TYPE.size),
    "VIDIOC_S_PARM": _code(3, 22, _RATE.size),
    "VIDIOC_ENUM_FRAMESIZES": _code(3, 74, _SIZE_ENTRY.size),
    "VIDIOC_ENUM_FRAMEINTERVALS": _code(3, 75, _RATE_ENTRY.size),
}
"""Requests to the kernel, by their names in <linux/videodev2.h>."""


@dataclass(frozen=True)
class Mode:
    """A form and size that a camera offers: four letters, pixels, frames a second (fastest first), bits if grey."""

    code: str
    width: int
    height: int
    rates: tuple[float, ...] = ()

    @property
    def bits(self) -> int | None:
        """Bits of a grey pixel; None for colour and compressed forms, which OpenCV reads."""
        return FORMATS[self.code].bits if self.code in FORMATS else None


class Device:
    """An opened device file: requests, mapped memory, waiting. Tests put another in its place."""

    def __init__(self, path: str) -> None:
        self.path = path
        self._file = os.open(path, os.O_RDWR | os.O_NONBLOCK)

    def ask(self, request: str, form: struct.Struct, *values: Any) -> tuple[Any, ...]:
        """Send a request with values of a structure; return those of the answer. Raises an OSError."""
        buffer = bytearray(form.pack(*values))
        self._send(IOCTLS[request], buffer)
        return form.unpack(buffer)

    def _send(self, number: int, buffer: bytearray) -> None:
        assert fcntl is not None
        fcntl.ioctl(self._file, number, buffer, True)

    def map(self, length: int, offset: int) -> Any:
        """Map memory of the driver."""
        return mmap.mmap(self._file, length, offset=offset)

    def wait(self, seconds: float) -> bool:
        """Wait for a frame."""
        return bool(select.select([self._file], [], [], seconds)[0])

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


def is_v4l2(source: str) -> bool:
    """Return whether a text names a camera of this interface: `v4l2:0`, `v4l2:0,Y12,1280x960`."""
    return source.startswith(PREFIX)


def v4l2_devices() -> list[str]:
    """Return the paths of this machine's video devices, in natural order; none where it is no Linux."""
    if fcntl is None:
        return []
    return [str(path) for path in sorted(Path("/dev").glob("video[0-9]*"), key=lambda path: natural_key(path.name))]


def _entries(device: Device, request: str, form: struct.Struct, *given: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the answers to a request that counts from 0 until the driver says no."""
    fill = form.unpack(bytes(form.size))
    for index in range(256):
        try:
            yield device.ask(request, form, index, *given, *fill[1 + len(given) :])
        except OSError:
            return


def card_of(device: Device) -> tuple[str, str] | None:
    """Return a camera's name and bus; None for a device that gives no frames. Raises an OSError."""
    _, card, bus, _, whole, own = device.ask("VIDIOC_QUERYCAP", _CAPABILITY, b"", b"", b"", 0, 0, 0)
    able = own if whole & _DEVICE_CAPS else whole
    if not (able & _VIDEO_CAPTURE and able & _STREAMING):
        return None
    return tuple(one.split(b"\0")[0].decode("utf-8", "replace") for one in (card, bus))  # type: ignore[return-value]


def modes_of(device: Device) -> list[Mode]:
    """Return what a camera offers, in its order; of sizes that go by steps, the largest."""
    modes: list[Mode] = []
    for entry in _entries(device, "VIDIOC_ENUM_FMT", _FORMAT_ENTRY, _CAPTURE):
        number = int(entry[4])
        code = _letters(number)
        for size in _entries(device, "VIDIOC_ENUM_FRAMESIZES", _SIZE_ENTRY, number):
            steps = size[2] != _DISCRETE
            width, height = (size[4], size[7]) if steps else (size[3], size[4])
            rates = _rates(device, number, width, height)
            modes.append(Mode(code, width, height, rates))
            if steps:
                break
    return modes


def _rates(device: Device, number: int, width: int, height: int) -> tuple[float, ...]:
    found = []
    for entry in _entries(device, "VIDIOC_ENUM_FRAMEINTERVALS", _RATE_ENTRY, number, width, height):
        up, down = entry[5], entry[6]
        if up and down:
            found.append(down / up)
        if entry[4] != _DISCRETE:
            break
    return tuple(sorted(found, reverse=True))


def _letters(number: int) -> str:
    """Return the four letters of a form, without trailing spaces."""
    return number.to_bytes(4, "little").decode("ascii", "replace").rstrip()


def _number(code: str) -> int:
    return int.from_bytes(code.ljust(4).encode("ascii"), "little")


class V4l2Camera(Live):
    """A grey camera by Linux's own interface, 8 to 16 bits. Frames carry the kernel's time of their arrival.

    Parameters
    ----------
    source
        `v4l2:0` for /dev/video0, or `v4l2:/dev/video0`; with form and size where more than one is offered:
        `v4l2:0,Y12,1280x960`. By default the deepest grey form at its largest size.
    rate
        Frames a second to ask for; None keeps the camera's own.
    device
        An opened device in place of the file.

    Raises
    ------
    InputError
        When there is no such camera, it is in use, or it offers no such mode.
    """

    def __init__(self, source: str, rate: float | None = None, device: Device | None = None) -> None:
        self.name = source
        place, *wanted = source.removeprefix(PREFIX).split(",")
        if not place.isdecimal() and not place.startswith("/"):
            raise InputError("names no camera", where=source, remedy="write v4l2:0 for /dev/video0")
        path = f"/dev/video{place}" if place.isdecimal() else place
        if device is None and fcntl is None:
            raise InputError("needs Linux", where=source, remedy="use camera:0, or genicam:ID")
        try:
            self._device = Device(path) if device is None else device
        except OSError as error:
            remedy = "see `tapetum cameras`; plug it in, and be in the group that may read it (video)"
            raise InputError(f"{path} cannot be opened ({error.strerror})", where=source, remedy=remedy) from error
        self._maps: list[Any] = []
        self._streams = False
        try:
            self._open(path, wanted, rate)
        except BaseException:
            self.close()
            raise

    def _open(self, path: str, wanted: list[str], rate: float | None) -> None:
        try:
            card = card_of(self._device)
            if card is None:
                raise InputError("gives no frames", where=self.name, remedy="see `tapetum cameras` for one that does")
            mode = _chosen(modes_of(self._device), wanted, self.name)
            asked = (_CAPTURE, mode.width, mode.height, _number(mode.code), _ANY, 0, 0)
            _, self._width, self._height, code, _, self._stride, _ = self._device.ask("VIDIOC_S_FMT", _FORMAT, *asked)
            self._code = _letters(code)
            if (self._code, self._width, self._height) != (mode.code, mode.width, mode.height):
                given = f"{self._code} {self._width}x{self._height}"
                what = f"gives {given} where {mode.code} {mode.width}x{mode.height} was asked for"
                raise InputError(what, where=self.name, remedy=f"ask for that: {self.name.split(',')[0]},{given}")
            self.rate = self._set_rate(rate, mode)
            self._start()
        except OSError as error:
            remedy = "close what else uses the camera, or plug it in again"
            raise InputError(f"{path} refuses ({error.strerror or error})", where=self.name, remedy=remedy) from error
        self.full_scale = FORMATS[self._code].full_scale
        self.hardware: dict[str, Any] = {
            "camera": self.name,
            "card": card[0],
            "bus": card[1],
            "format": self._code,
            "bits": FORMATS[self._code].bits,
            "driver": "V4L2",
            "time": "arrival of the frame, by the kernel's monotonic clock",
        }
        self._seen = self._next()[0]

    def _set_rate(self, rate: float | None, mode: Mode) -> float | None:
        if rate is not None:
            with contextlib.suppress(OSError):
                answer = self._device.ask("VIDIOC_S_PARM", _RATE, _CAPTURE, 0, 0, 1000, round(1000 * rate))
                return answer[4] / answer[3] if answer[3] and answer[4] else rate
        return mode.rates[0] if mode.rates else rate

    def _start(self) -> None:
        """Map the driver's buffers, give them to it, and start the stream."""
        count = self._device.ask("VIDIOC_REQBUFS", _REQUEST, _BUFFERS, _CAPTURE, _MAPPED)[0]
        for index in range(count):
            answer = self._device.ask("VIDIOC_QUERYBUF", _BUFFER, *_empty(index))
            self._maps.append(self._device.map(answer[10], answer[9]))
            self._device.ask("VIDIOC_QBUF", _BUFFER, *_empty(index))
        self._device.ask("VIDIOC_STREAMON", _TYPE, _CAPTURE)
        self._streams = True

    def _next(self) -> tuple[np.ndarray, int, int]:
        """Return the next whole frame, its number, and its monotonic time in ns."""
        while True:
            if not self._device.wait(_PATIENCE):
                what = f"gave no frame for {_PATIENCE:g} s"
                raise InputError(what, where=self.name, remedy="is it still plugged in, or does it wait for a trigger?")
            try:
                answer = self._device.ask("VIDIOC_DQBUF", _BUFFER, *_empty(0))
            except BlockingIOError:
                continue
            index, _, used, flags, _, seconds, micros, sequence = answer[:8]
            # The driver reuses the buffer as soon as it has it back: decoding copies.
            data = bytes(self._maps[index][:used])
            self._device.ask("VIDIOC_QBUF", _BUFFER, *_empty(index))
            if flags & _ERROR:
                continue
            image = decode(data, self._code, self._width, self._height, self._stride, self.name)
            own = flags & _CLOCKS == _MONOTONIC
            return image, sequence, seconds * 10**9 + micros * 1000 if own else time.monotonic_ns()

    def _arrivals(self, utc_ahead: int) -> Iterator[Arrival]:
        while True:
            try:
                image, number, moment = self._next()
            except OSError as error:
                what = f"gives no more frames ({error.strerror or error})"
                raise InputError(what, where=self.name, remedy="is it still plugged in?") from error
            yield Arrival(image, moment, number)

    def close(self) -> None:
        """Stop the stream and release the camera."""
        with contextlib.suppress(OSError):
            if self._streams:
                self._device.ask("VIDIOC_STREAMOFF", _TYPE, _CAPTURE)
        self._streams = False
        for one in self._maps:
            with contextlib.suppress(Exception):
                one.close()
        self._maps = []
        with contextlib.suppress(OSError):
            self._device.close()


def _empty(index: int) -> tuple[int, ...]:
    """Return the values of a buffer's structure that name it alone."""
    return (index, _CAPTURE, 0, 0, 0, 0, 0, 0, _MAPPED, 0, 0, 0, 0)


def _chosen(modes: list[Mode], wanted: list[str], where: str) -> Mode:
    """Return the mode that the words of a source ask for: a form and a size, in any order."""
    grey = [mode for mode in modes if mode.bits is not None]
    if not grey:
        offered = ", ".join(dict.fromkeys(mode.code for mode in modes)) or "nothing"
        raise InputError(f"offers no grey form, but {offered}", where=where, remedy="use camera:N, which reads colour")
    for word in wanted:
        width, cross, height = word.partition("x")
        if cross and width.isdecimal() and height.isdecimal():
            fitting = [mode for mode in grey if (mode.width, mode.height) == (int(width), int(height))]
        else:
            fitting = [mode for mode in grey if mode.code == word.strip()]
        if not fitting:
            offered = ", ".join(f"{mode.code},{mode.width}x{mode.height}" for mode in grey)
            raise InputError(f"offers no {word}", where=where, remedy=f"ask for one of {offered}")
        grey = fitting
    return max(grey, key=lambda mode: (mode.bits or 0, mode.width * mode.height))
