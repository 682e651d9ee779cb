"""Grey frames from image files: PNG, TIFF, PGM, BMP and JPEG, 8 or 16 bit, one file or a folder of them."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
from av.error import FFmpegError, InvalidDataError

from tapetum.errors import InputError
from tapetum.record.source import Frame, Stored, existing, full_scale_of

__all__ = ["IMAGE_SUFFIXES", "ImageSource", "read_image"]

IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".pgm", ".pnm", ".ppm", ".bmp", ".jpg", ".jpeg")
TIFF_SUFFIXES = (".tif", ".tiff")
DAMAGED = "copy or export it again"

_hushing = threading.Lock()
_hush = {"depth": 0, "level": 0}


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return a sort key under which `frame10` follows `frame9`."""
    return [(int(part), "") if part.isdecimal() else (-1, part.casefold()) for part in re.split(r"(\d+)", name)]


@contextlib.contextmanager
def hushed() -> Iterator[None]:
    """Silence OpenCV's messages about broken files on standard error, since an InputError reports them.

    The log level is global: the first thread to enter sets it, the last one to leave restores it.
    """
    with _hushing:
        if not _hush["depth"]:
            _hush["level"] = cv2.utils.logging.getLogLevel()
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        _hush["depth"] += 1
    try:
        yield
    finally:
        with _hushing:
            _hush["depth"] -= 1
            if not _hush["depth"]:
                cv2.utils.logging.setLogLevel(_hush["level"])


def cut_short(data: bytes) -> bool:
    """Return whether a PNG, JPEG or BMP lacks its end, which some versions of OpenCV fill with grey."""
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return b"IEND" not in data[-64:]
    if data.startswith(b"\xff\xd8\xff"):
        # Within coded data 0xff is never followed by 0xd9; some cameras append a little after the end.
        return b"\xff\xd9" not in data[-4096:]
    if data.startswith(b"BM") and len(data) >= 6:
        return int.from_bytes(data[2:6], "little") > len(data)
    return False


def damaged_jpeg(data: bytes) -> bool:
    """Return whether a JPEG's coded data are broken: OpenCV fills what is missing with grey, FFmpeg can be strict."""
    if not data.startswith(b"\xff\xd8\xff"):
        return False
    decoder = av.CodecContext.create("mjpeg", "r")
    decoder.options = {"err_detect": "explode"}
    with contextlib.suppress(FFmpegError):
        try:
            decoder.decode(av.Packet(data))
            decoder.decode(None)
        except InvalidDataError:
            return True
    return False


def pnm_maximum(data: bytes) -> int | None:
    """Return the maximum sample value in the header of a PGM or PPM; None for any other file."""
    if data[:2] not in (b"P2", b"P3", b"P5", b"P6"):
        return None
    header = re.sub(rb"#[^\n\r]*", b"", data[:4096])
    match = re.match(rb"P\d\s+\d+\s+\d+\s+(\d+)\s", header)
    return int(match.group(1)) if match else None


def to_grey(image: np.ndarray) -> np.ndarray:
    """Return [H, W] from OpenCV's [H, W], [H, W, 3] (BGR) or [H, W, 4] (BGRA), same type."""
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[..., 0])
    code = cv2.COLOR_BGRA2GRAY if image.shape[2] == 4 else cv2.COLOR_BGR2GRAY
    return cv2.cvtColor(image, code)


def read_image(path: str | os.PathLike[str], page: int = 0, *, colour: bool = False) -> tuple[np.ndarray, int]:
    """Return an image file as grey [H, W], uint8 or uint16, and its digital number of saturation.

    `page` chooses an image of a TIFF, from 0. Colour becomes luma, or with `colour` [H, W, 3] red, green, blue; it is
    turned as its orientation tag says, as viewers show it. Saturation is the maximum in a PGM's header, else 255 or
    65535. Raises an InputError when the file is unreadable, truncated, damaged, or not 8 or 16 bit.
    """
    file = Path(path)
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=file, remedy="check the path") from error
    if not data:
        raise InputError("is empty", where=file, remedy=DAMAGED)
    if cut_short(data):
        raise InputError("the image is truncated", where=file, remedy=DAMAGED)
    if damaged_jpeg(data):
        raise InputError("the image is damaged: a part of it cannot be decoded", where=file, remedy=DAMAGED)
    image = None
    # As pictures are shown: turned as they say, without transparency.
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
    with hushed(), contextlib.suppress(cv2.error):
        if page:
            _, pages = cv2.imreadmulti(str(file), start=page, count=1, flags=flags)  # type: ignore[call-overload]
            image = pages[0] if len(pages) else None
        else:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        remedy = f"{DAMAGED}; of kinds of files PNG, TIFF, PGM, BMP and JPEG are always read"
        raise InputError("is truncated, or not an image that can be read", where=file, remedy=remedy)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"holds {image.dtype} samples", where=file, remedy="save it with 8 or 16 bit")
    stated = pnm_maximum(data)
    # OpenCV scales 1-bit and palette images to the whole byte.
    rgb = colour and image.ndim == 3 and image.shape[2] > 2
    kept = cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2RGB) if rgb else to_grey(image)
    return kept, stated if stated else full_scale_of(image.dtype)


def count_pages(file: Path) -> int:
    """Return the number of images in a TIFF; 1 for a damaged one, whose reading raises the error."""
    with hushed(), contextlib.suppress(cv2.error):
        return max(1, cv2.imcount(str(file)))
    return 1


@dataclass(frozen=True)
class ImageSource(Stored):
    """Image `files`, in order, as a source of frames. Without a clock, frames are timed by `rate` (per second).

    `name` is what messages call the source.
    """

    files: tuple[Path, ...]
    name: str
    rate: float = 15.0

    @functools.cached_property
    def _pages(self) -> list[tuple[Path, int]]:
        """The file of every image, and its page in it."""
        pages = [(file, count_pages(file) if file.suffix.lower() in TIFF_SUFFIXES else 1) for file in self.files]
        return [(file, page) for file, count in pages for page in range(count)]

    @classmethod
    def from_path(cls, path: str | os.PathLike[str], rate: float = 15.0) -> ImageSource:
        """Return a source of an image file, or of all in a folder in natural order; raise an InputError without any."""
        place = existing(path)
        if not place.is_dir():
            return cls((place,), str(place), rate)
        found = [
            file
            for file in place.iterdir()
            if file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".") and file.is_file()
        ]
        if not found:
            looked_for = ", ".join(suffix.lstrip(".") for suffix in IMAGE_SUFFIXES)
            raise InputError("the folder holds no images", where=place, remedy=f"put frames in it ({looked_for})")
        return cls(tuple(sorted(found, key=lambda file: natural_key(file.name))), str(place), rate)

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self._pages)

    @property
    def full_scale(self) -> int:
        """Digital number at which the first frame saturates; `Frame.full_scale` is right for every one."""
        return read_image(*self._pages[0])[1]

    def __iter__(self) -> Iterator[Frame]:
        for index, (file, page) in enumerate(self._pages):
            image, full_scale = read_image(file, page)
            name = f"{file.name}[{page}]" if page else file.name
            yield Frame(index, index / self.rate, image, name, full_scale)
