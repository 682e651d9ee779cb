"""Grey images from the raw bytes of cameras: words and packed forms of 8 to 16 bits.

Names are those of V4L2 (Linux kernel documentation, "Luma-Only Formats") and of GenICam (Pixel Format Naming
Convention 2.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError

__all__ = ["FORMATS", "PixelFormat", "decode"]

# For each pixel of a group, its pieces: (byte, lowest bit in it, bits, place in the pixel).
Pieces = tuple[tuple[tuple[int, int, int, int], ...], ...]


@dataclass(frozen=True)
class PixelFormat:
    """How grey pixels lie in memory.

    Parameters
    ----------
    bits
        Depth.
    size, pixels
        Bytes of a group, and pixels in it.
    pieces
        Where the bits of each pixel of a group are; empty for whole little-endian words.
    shift
        Unused low bits of a word.
    """

    bits: int
    size: int
    pixels: int = 1
    pieces: Pieces = ()
    shift: int = 0

    @property
    def full_scale(self) -> int:
        """Largest number that a pixel can hold."""
        return 2**self.bits - 1

    def row_bytes(self, width: int) -> int:
        """Bytes of a row without padding."""
        return -(-width // self.pixels) * self.size


def _tops_first(bits: int, pixels: int, low: Pieces) -> PixelFormat:
    """Return a MIPI form (CSI-2, RAW10 and so on): the upper 8 bits of each pixel, then the lower ones."""
    pieces = tuple(((n, 0, 8, bits - 8), *low[n]) for n in range(pixels))
    return PixelFormat(bits, bits * pixels // 8, pixels, pieces)


def _stream(bits: int, pixels: int, *, little: bool) -> PixelFormat:
    """Return a form whose pixels follow bit by bit, from the lowest bit of a byte (`little`) or the highest."""
    pieces = []
    for n in range(pixels):
        own = []
        for bit in range(bits):
            place = n * bits + bit
            byte, inside = divmod(place, 8)
            own.append((byte, inside, 1, bit) if little else (byte, 7 - inside, 1, bits - 1 - bit))
        pieces.append(_joined(own))
    return PixelFormat(bits, bits * pixels // 8, pixels, tuple(pieces))


def _joined(bits: list[tuple[int, int, int, int]]) -> tuple[tuple[int, int, int, int], ...]:
    """Join single bits of one byte into pieces."""
    found: dict[tuple[int, int], list[int]] = {}
    for byte, inside, _, place in bits:
        found.setdefault((byte, place - inside), []).append(inside)
    return tuple((byte, min(inside), len(inside), shift + min(inside)) for (byte, shift), inside in found.items())


def _words(bits: int) -> PixelFormat:
    return PixelFormat(bits, 2)


_BYTE = PixelFormat(8, 1)
# Two pixels in three bytes, the lower bits of both in the middle one (GigE Vision 1).
_GIGE10 = PixelFormat(10, 3, 2, (((0, 0, 8, 2), (1, 0, 2, 0)), ((2, 0, 8, 2), (1, 4, 2, 0))))
_GIGE12 = PixelFormat(12, 3, 2, (((0, 0, 8, 4), (1, 0, 4, 0)), ((2, 0, 8, 4), (1, 4, 4, 0))))
_MIPI14: Pieces = (
    ((4, 0, 6, 0),),
    ((4, 6, 2, 0), (5, 0, 4, 2)),
    ((5, 4, 4, 0), (6, 0, 2, 4)),
    ((6, 2, 6, 0),),
)

FORMATS: dict[str, PixelFormat] = {
    "GREY": _BYTE,
    "Y10": _words(10),
    "Y12": _words(12),
    "Y14": _words(14),
    "Y16": _words(16),
    "Y012": PixelFormat(12, 2, shift=4),
    "Y10B": _stream(10, 4, little=False),
    "Y10P": _tops_first(10, 4, tuple(((4, 2 * n, 2, 0),) for n in range(4))),
    "Y12P": _tops_first(12, 2, tuple(((2, 4 * n, 4, 0),) for n in range(2))),
    "Y14P": _tops_first(14, 4, _MIPI14),
    "Mono8": _BYTE,
    "Mono10": _words(10),
    "Mono12": _words(12),
    "Mono14": _words(14),
    "Mono16": _words(16),
    "Mono10Packed": _GIGE10,
    "Mono12Packed": _GIGE12,
    "Mono10p": _stream(10, 4, little=True),
    "Mono12p": _stream(12, 2, little=True),
    "Mono14p": _stream(14, 4, little=True),
}
"""Forms that can be read, by their names in V4L2 and GenICam."""


def decode(
    data: bytes | memoryview, name: str, width: int, height: int, stride: int | None = None, where: object = None
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Return the image [height, width] in a buffer: uint8 for 8 bits, else uint16.

    Parameters
    ----------
    data, name, width, height
        The bytes, their form (a key of `FORMATS`), and the image's size in pixels.
    stride
        Bytes from one row to the next, where rows are padded.
    where
        What gave them, for messages.

    Raises
    ------
    InputError
        For an unknown form, or too few bytes.
    """
    if name not in FORMATS:
        raise InputError(f"gives {name}", where=where, remedy=f"set it to one of {', '.join(FORMATS)}")
    form = FORMATS[name]
    used = form.row_bytes(width)
    step = max(stride or used, used)
    needed = step * (height - 1) + used
    raw = np.frombuffer(data, np.uint8)
    if len(raw) < needed:
        what = f"gave {len(raw)} bytes where {width} x {height} px of {name} take {needed}"
        raise InputError(what, where=where, remedy="check cable and bandwidth, or ask for a smaller picture")
    whole = np.zeros(step * height, np.uint8)
    whole[: min(len(raw), step * height)] = raw[: step * height]
    rows = whole.reshape(height, step)[:, :used]
    if form.size == 1:
        return np.ascontiguousarray(rows[:, :width])
    if not form.pieces:
        words = np.ascontiguousarray(rows).view("<u2")[:, :width].astype(np.uint16)
        # Drivers may leave something above the depth.
        words >>= np.uint16(form.shift)
        return words & np.uint16(form.full_scale)
    groups = rows.reshape(height, -1, form.size).astype(np.uint16)
    out = np.zeros((height, groups.shape[1], form.pixels), np.uint16)
    for n, pieces in enumerate(form.pieces):
        for byte, low, bits, place in pieces:
            out[:, :, n] |= ((groups[:, :, byte] >> low) & (2**bits - 1)) << place
    return np.ascontiguousarray(out.reshape(height, -1)[:, :width])
