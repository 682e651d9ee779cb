"""Raw bytes of cameras become the pixels that were packed."""

from __future__ import annotations

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.record.pixels import FORMATS, decode


def packed(image: np.ndarray, name: str) -> bytes:
    """Pack by the definitions of each form, written as bit strings: an own way, apart from the tables under test."""
    form = FORMATS[name]
    bits = form.bits
    if form.size == 1:
        return image.astype(np.uint8).tobytes()
    if not form.pieces:
        return (image.astype(np.uint16) << form.shift).astype("<u2").tobytes()
    rows = []
    for row in image:
        values = [int(one) for one in row] + [0] * (-len(row) % form.pixels)
        groups = [values[k : k + form.pixels] for k in range(0, len(values), form.pixels)]
        rows.append(b"".join(group_bytes(group, name, bits) for group in groups))
    return b"".join(rows)


def group_bytes(group: list[int], name: str, bits: int) -> bytes:
    if name.endswith("Packed"):
        a, b = group
        low = bits - 8
        mask = 2**low - 1
        return bytes([a >> low, (b & mask) << 4 | (a & mask), b >> low])
    if name.endswith("p"):
        # Least significant bit first, through the bytes.
        number = sum(value << (bits * n) for n, value in enumerate(group))
        return number.to_bytes(bits * len(group) // 8, "little")
    if name.endswith("B"):
        text = "".join(f"{value:0{bits}b}" for value in group)
        return int(text, 2).to_bytes(len(text) // 8, "big")
    # MIPI CSI-2: the upper bytes, then the low bits of all, first pixel lowest.
    low = bits - 8
    rest = sum((value & (2**low - 1)) << (low * n) for n, value in enumerate(group))
    return bytes(value >> low for value in group) + rest.to_bytes(low * len(group) // 8, "little")


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("width", [8, 13])
def test_what_was_packed_is_read(name: str, width: int) -> None:
    rng = np.random.default_rng(3)
    image = rng.integers(0, FORMATS[name].full_scale + 1, (5, width))
    found = decode(packed(image, name), name, width, 5)
    assert found.dtype == (np.uint8 if FORMATS[name].bits == 8 else np.uint16)
    assert np.array_equal(found, image)


def test_rows_may_be_padded_and_the_last_one_cut() -> None:
    image = np.arange(12).reshape(3, 4) * 300
    rows = [packed(row[None], "Y12P") for row in image]
    data = b"".join(row + b"\xff\xff" for row in rows)
    assert np.array_equal(decode(data, "Y12P", 4, 3, stride=8), image)
    assert np.array_equal(decode(data[:-2], "Y12P", 4, 3, stride=8), image)


def test_bits_above_the_depth_are_dropped() -> None:
    assert decode(np.array([0xF123], "<u2").tobytes(), "Y12", 1, 1)[0, 0] == 0x123


def test_what_cannot_be_read_is_refused() -> None:
    with pytest.raises(InputError, match=r"v4l2:0: gave 10 bytes where 4 x 3 px of Y16 take 24; check cable"):
        decode(bytes(10), "Y16", 4, 3, where="v4l2:0")
    with pytest.raises(InputError, match=r"gives MJPG; set it to one of GREY, Y10"):
        decode(bytes(10), "MJPG", 4, 3)
