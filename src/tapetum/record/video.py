"""Lossless grey video: FFV1 in Matroska. A killed program loses one frame; reading is exact.

Every frame is a key frame in its own cluster, which goes to the operating system as soon as the next frame comes. FFV1
version 3, Golomb-Rice coder, small context model, 4 slices on up to 2 threads is FFV1's fastest mode (the range coder
takes twice the time and saves nothing on noisy frames).
"""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import av
import numpy as np
from av.error import FFmpegError

from tapetum.errors import InputError
from tapetum.files import told_when_full
from tapetum.record.source import Frame, Stored, existing, full_scale_of

__all__ = ["VideoSource", "VideoWriter", "count_frames", "read_video"]

PIXEL_FORMATS = {np.dtype(np.uint8): "gray", np.dtype(np.uint16): "gray16le"}
FFV1 = {"level": "3", "coder": "0", "context": "0", "g": "1", "slices": "4", "slicecrc": "1"}
FULL_SCALE_TAG = "TAPETUM_FULL_SCALE"
MILLISECOND = Fraction(1, 1000)
# This list excludes play lists, which would open other files, and text, which FFmpeg would render as a terminal.
CONTAINERS = (
    "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi,mpegts,mpeg,ogg,flv,asf,nut,ivf,mjpeg,dv,mxf,gif,apng,"
    "yuv4mpegpipe,h264,hevc,wtv"
)
READ = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}
NATIVE_GREY = {"gray": 255, "gray10le": 1023, "gray12le": 4095, "gray14le": 16383, "gray16le": 65535}
FOOTER = 8  # bytes at the end of an FFV1 slice: its size (3), a status and a checksum (4)
MIRRORED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
THREADS = max(1, min(2, os.cpu_count() or 1))


class VideoWriter:
    """Writes grey images as FFV1 in Matroska; replaces an existing file.

    Parameters
    ----------
    path, size, dtype
        The file, usually `.mkv`; height and width in pixels; and numpy.uint8 or numpy.uint16.
    rate
        Nominal frames per second, for time stamps where `write` is given none.
    full_scale
        Digital number of saturation, kept as a tag (`TAPETUM_FULL_SCALE`); by default the type's largest.

    Raises
    ------
    InputError
        When size, rate or type are not supported, or the file cannot be created.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        size: tuple[int, int],
        rate: float = 15.0,
        dtype: np.dtype | type = np.uint8,
        full_scale: int | None = None,
    ) -> None:
        self.path, self.size, self.dtype = Path(path), (int(size[0]), int(size[1])), np.dtype(dtype)
        self.count = 0
        if self.dtype not in PIXEL_FORMATS:
            raise InputError(f"cannot hold {self.dtype} samples", where=self.path, remedy="give uint8 or uint16")
        if min(self.size) < 1:
            raise InputError(f"size must be positive, is {self.size}", where=self.path)
        if not 0 < rate < 1e5:
            raise InputError(f"rate must be positive, is {rate}", where=self.path, remedy="give frames per second")
        if min(self.size) < 2:
            what = f"frames of {self.size[1]} x {self.size[0]} pixels cannot be kept as FFV1"
            raise InputError(what, where=self.path, remedy="give them sides of two pixels and more")
        full_scale = full_scale_of(self.dtype) if full_scale is None else int(full_scale)
        if not 0 < full_scale <= full_scale_of(self.dtype):
            raise InputError(f"full scale {full_scale} does not fit {self.dtype}", where=self.path)
        self.rate = float(rate)
        self._last_tick = -1
        self._closed = False
        self._format = PIXEL_FORMATS[self.dtype]
        with told_when_full(self.path):
            # "file:" keeps FFmpeg from reading a name with a colon as a protocol. FFmpeg writes whole clusters only,
            # so every frame gets its own.
            options = {"flush_packets": "1", "cluster_size_limit": "1"}
            self._container = av.open(f"file:{self.path}", "w", format="matroska", options=options)
        self._container.metadata[FULL_SCALE_TAG] = str(full_scale)
        self._stream: Any = self._container.add_stream("ffv1", rate=Fraction(rate).limit_denominator(10_000))
        self._stream.height, self._stream.width = self.size
        self._stream.pix_fmt, self._stream.options = self._format, FFV1
        context = self._stream.codec_context
        self._stream.time_base = context.time_base = MILLISECOND
        context.thread_type, context.thread_count = "SLICE", THREADS
        with told_when_full(self.path):
            # Creates the file, so that an unwritable path is reported before the first frame.
            self._container.start_encoding()

    def write(self, image: np.ndarray, time: float | None = None) -> None:
        """Append one image [H, W] of the writer's size and type.

        `time` is in seconds from the first frame, kept to the millisecond; by default the frame's number over `rate`.
        Raises an InputError when the image is of another size or type, or the disk is full.
        """
        if self._closed:
            raise InputError("the video is closed already", where=self.path)
        if image.shape != self.size or image.dtype != self.dtype:
            given, wanted = f"{list(image.shape)} {image.dtype}", f"{list(self.size)} {self.dtype}"
            raise InputError(f"frame {self.count} is {given}, the video is {wanted}", where=self.path)
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=self._format)
        # Matroska counts in milliseconds and needs rising stamps, however close two frames come.
        tick = max(self._last_tick + 1, round((self.count / self.rate if time is None else time) * 1000))
        frame.pts, frame.time_base = tick, MILLISECOND
        with told_when_full(self.path):
            self._container.mux(self._stream.encode(frame))
        self._last_tick = tick
        self.count += 1

    def flush(self) -> None:
        """Do nothing: every frame but the newest has reached the operating system when `write` returns."""

    def close(self) -> None:
        """Write the rest and the index; closing twice is harmless.

        Raises an InputError when the disk is full; the frames before stay readable.
        """
        if self._closed:
            return
        self._closed = True
        with told_when_full(self.path):
            try:
                self._container.mux(self._stream.encode(None))
            finally:
                self._container.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # An error on closing must not hide the one that ended the block.
        with contextlib.nullcontext() if error is None else contextlib.suppress(OSError, InputError):
            self.close()


def open_container(file: Path) -> tuple[Any, Any]:
    """Return the opened container and its first video stream; raise an InputError for other files."""
    if file.is_file() and not file.stat().st_size:
        raise truncated(file, 0)
    try:
        container = av.open(f"file:{file}", options=READ)
    except EOFError as error:
        # Only a header: the writer was killed at its first frame.
        raise truncated(file, 0) from error
    except (FFmpegError, OSError, ValueError) as error:
        remedy = "give an image, a folder of images, a .rec folder or a video such as .mkv, .mp4 or .avi"
        what = "is not a video that can be read (or its beginning is damaged)"
        raise InputError(what, where=file, remedy=remedy) from error
    if not container.streams.video:
        container.close()
        raise InputError("holds no video", where=file, remedy="give a file with a video stream")
    stream: Any = container.streams.video[0]
    if stream.codec_context is None:
        container.close()
        what = "holds video that cannot be decoded: its kind is unknown, or its beginning is damaged"
        raise InputError(what, where=file, remedy="convert it, e.g. to FFV1 in an .mkv")
    stream.codec_context.thread_type = "SLICE" if stream.codec_context.name == "ffv1" else "AUTO"
    stream.codec_context.thread_count = THREADS
    return container, stream


def matroska_missing(file: Path) -> int | None:
    """Return by how many bytes a Matroska file is shorter than it states (RFC 8794, §6); None if it states no size.

    FFmpeg silently drops a torn last frame, so only the size shows that a file was cut.
    """
    with file.open("rb") as stream:
        head = stream.read(4096)
    if not head.startswith(b"\x1a\x45\xdf\xa3"):
        return None

    def size_at(place: int) -> tuple[int, int]:
        """Return an element's size and where its data begin; -1 for the size that means unknown."""
        width = 9 - head[place].bit_length()
        unknown = (1 << 7 * width) - 1
        value = int.from_bytes(head[place : place + width], "big") & unknown
        return (-1 if value == unknown else value), place + width

    try:
        header, start = size_at(4)
        segment = start + header
        if head[segment : segment + 4] != b"\x18\x53\x80\x67":
            return None
        size, start = size_at(segment + 4)
    except IndexError:
        return None
    return None if size < 0 else max(0, start + size - file.stat().st_size)


def count_frames(path: str | os.PathLike[str]) -> int:
    """Return the number of complete frames of a video, without decoding them (some GB per second)."""
    try:
        container, stream = open_container(existing(path))
    except InputError as error:
        if isinstance(error.__cause__, EOFError):
            return 0
        raise
    number = 0
    with container, contextlib.suppress(FFmpegError, OSError):
        for packet in container.demux(stream):
            number += packet.size > 0 and not packet.is_corrupt
    return number


def truncated(file: Path, number: int) -> InputError:
    """Return the error for a video that ends early, after `number` complete frames."""
    return InputError(
        f"the video is truncated or damaged: {number} frames could be read",
        where=file,
        remedy="copy it again, or cut it after the last good frame",
    )


def to_array(frame: Any) -> tuple[np.ndarray, int]:
    """Return a decoded frame as [H, W] uint8 or uint16, and its full scale."""
    name = frame.format.name
    if name in NATIVE_GREY:
        return frame.to_ndarray(), NATIVE_GREY[name]
    # Other formats become luma over the type's whole range.
    wanted = "gray16le" if max(part.bits for part in frame.format.components) > 8 else "gray"
    return frame.to_ndarray(format=wanted), NATIVE_GREY[wanted]


def decoded(file: Path, *, tolerant: bool, late: bool = False) -> Generator[tuple[np.ndarray, int, float | None]]:
    """Yield image, full scale and seconds (None without a time stamp), and raise an InputError for an early end.

    It is raised before the first frame where the file shows it, or with `late` only after the last; never if
    `tolerant`.
    """
    missing = matroska_missing(file)
    if missing and not tolerant and not late:
        # Raised before the first frame, not after an hour of reading.
        raise truncated(file, count_frames(file))
    number = packets = 0
    container, stream = open_container(file)
    with container:
        tag = container.metadata.get(FULL_SCALE_TAG, "")
        stated = int(tag) if tag.isdecimal() else None
        try:
            for packet in container.demux(stream):
                packets += packet.size > 0
                if stated and packet.size and not slices_whole(bytes(packet)):
                    raise truncated(file, number)
                for frame in packet.decode():
                    if frame.is_corrupt:
                        raise truncated(file, number)
                    image, full_scale = to_array(frame)
                    time = None if frame.pts is None else float(frame.pts * frame.time_base)
                    yield image, stated or full_scale, time
                    number += 1
        except (FFmpegError, OSError, InputError) as error:
            if not tolerant:
                raise truncated(file, number) from error
            return
        if not tolerant and (missing or number == 0 or packets < stream.frames):
            raise truncated(file, number)


def slices_whole(packet: bytes) -> bool:
    """Return whether the checksums of all slices of a frame of `VideoWriter` hold (RFC 9043, §4.9).

    FFmpeg's decoder silently replaces a damaged slice by that of the frame before.
    """
    # FFV1's checksum starts with each byte's highest bit, zlib's with the lowest.
    mirrored = packet.translate(MIRRORED)
    end = len(packet)
    while end >= FOOTER:
        start = end - FOOTER - int.from_bytes(packet[end - FOOTER : end - FOOTER + 3], "big")
        # The register starts at 0, and ends at 0 because the slice includes its checksum.
        if start < 0 or zlib.crc32(mirrored[start:end], 0xFFFFFFFF) != 0xFFFFFFFF:
            return False
        end = start
    return end == 0


def read_video(path: str | os.PathLike[str], *, tolerant: bool = False) -> Iterator[np.ndarray]:
    """Yield the frames of a video as grey arrays [H, W], uint8 or uint16; exactly as written if it is lossless grey.

    Any format of FFmpeg works. Raises an InputError when it cannot be read or is truncated or damaged; with `tolerant`
    it stops at the last complete frame instead.
    """
    for image, _, _ in decoded(existing(path), tolerant=tolerant):
        yield image


@dataclass(frozen=True)
class VideoSource(Stored):
    """A video file as a source of frames; times are the file's own stamps.

    Attributes
    ----------
    path, full_scale, count
        The video file, digital number of saturation, and number of frames where the file states it, else None.
    rate
        Frames per second for a file without stamps.
    late
        Whether all readable frames come before the error about a truncated file.
    """

    path: Path
    full_scale: int
    count: int | None
    rate: float
    late: bool = False

    @classmethod
    def from_path(cls, path: str | os.PathLike[str], *, late: bool = False) -> VideoSource:
        """Open a video file; raise an InputError when it is no video, has no readable frame, or is truncated."""
        file = existing(path)
        with contextlib.closing(decoded(file, tolerant=False, late=late)) as frames:
            # An empty or wholly damaged video raises here.
            _, full_scale, _ = next(frames)
        container, stream = open_container(file)
        with container:
            rate = float(stream.average_rate or 0) or 15.0
            return cls(file, full_scale, stream.frames or None, rate, late)

    @property
    def name(self) -> str:
        """The file, for messages."""
        return str(self.path)

    def __iter__(self) -> Iterator[Frame]:
        start: float | None = None
        for index, (image, full_scale, stamp) in enumerate(decoded(self.path, tolerant=False, late=self.late)):
            stamp = index / self.rate if stamp is None else stamp
            start = stamp if start is None else start
            yield Frame(index, stamp - start, image, f"{self.path.stem}[{index}]", full_scale)
