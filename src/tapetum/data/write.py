"""The one writer of datasets: crops and what is known of each, from recordings, pictures or the virtual bench."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec

from tapetum.data.content import DIGEST, hash_of, image_digests
from tapetum.data.crop import CENTRING, SIGMA
from tapetum.data.dataset import (
    DEVICE,
    EMBARGO,
    FORMAT,
    QUANTITIES,
    TEST,
    TRAIN,
    TRUE_GAZE,
    VERSION,
    class_variable,
    split_variable,
)
from tapetum.data.embargo import embargoed
from tapetum.errors import InputError
from tapetum.files import atomic_folder

__all__ = ["CHUNK", "LARGEST_SIDE", "DatasetWriter", "Rules", "dataset_writer", "make_array"]

CHUNK = 64
"""Frames a chunk of the store: 10 MB of 400 x 400 pixels before compression."""
LARGEST_SIDE = 4000
"""Largest side of a crop: a chunk of 16 bit crops then fills the 2 GB that its compression can take."""


@dataclass(frozen=True)
class Rules:
    """Which frames are kept, how they are cut and where they go: the arguments of `tapetum.data.build_dataset`."""

    side: int = 400
    test_fraction: float = 0.2
    min_quality: float = 0.5
    min_snr: float = 6.0
    sigma: float = SIGMA
    centring: str = CENTRING
    embargo: float = 0.0


class DatasetWriter:
    """Appends crops to a store, whole chunks at a time, and what is known of each. Made by `dataset_writer`.

    Attributes
    ----------
    told
        What became of the frames of each recording: the store's attribute ``recordings``.
    attributes
        More attributes of the store, as JSON can hold them.
    """

    def __init__(
        self,
        group: zarr.Group,
        rules: Rules,
        names: tuple[str, ...],
        classes: list[str],
        full_scale: int,
        dtype: np.dtype[Any],
    ) -> None:
        self.told: list[dict[str, Any]] = []
        self.attributes: dict[str, Any] = {}
        self._group, self._rules, self._names, self._classes = group, rules, names, classes
        self._full_scale = full_scale
        self._columns: dict[str, list[float]] = {}
        self._digests: list[NDArray[np.uint8]] = []
        self._buffer: list[NDArray[np.generic]] = []
        shape = (CHUNK, rules.side, rules.side)
        self._array = make_array(group, "image", (0, *shape[1:]), shape, dtype, ("frame", "y", "x"))
        self._array.attrs["units"] = "count"
        self._array.attrs["long_name"] = "crop around the retro-reflection"

    @property
    def empty(self) -> bool:
        """Whether nothing was added yet."""
        return not self._columns

    def add(self, image: NDArray[np.generic], /, **values: float) -> None:
        """Add a crop [side, side], and what is known of it by name."""
        self._digests.append(image_digests([image]))
        self._buffer.append(image)
        for name, value in values.items():
            self._columns.setdefault(name, []).append(value)
        if len(self._buffer) == CHUNK:
            self._flush()

    def _flush(self) -> None:
        if self._buffer:
            self._array.append(np.stack(self._buffer))
            self._buffer.clear()

    def finish(self) -> None:
        """Write what is left of the images, the variables along ``frame``, and the store's attributes.

        Raises
        ------
        InputError
            When nothing, or nothing for one of the two parts, was added.
        """
        self._flush()
        rules, names = self._rules, self._names
        _set_embargo(self._columns, self.told)
        _check_parts(self._columns, self.told, rules.test_fraction)
        variables = _write_columns(self._group, self._columns, names, self._classes)
        digests = np.concatenate(self._digests)
        array = make_array(self._group, DIGEST, digests.shape, digests.shape, digests.dtype, ("frame", "digest_byte"))
        array[:] = digests
        array.attrs["long_name"] = "BLAKE2b of the crop"
        known, scale = self._classes if DEVICE in names else (), self._full_scale
        self._group.attrs.update(
            {
                "format": FORMAT,
                "version": VERSION,
                "targets": list(names),
                "full_scale": scale,
                "centre_sigma": rules.sigma,
                "centring": rules.centring,
                "min_quality": rules.min_quality,
                "min_snr": rules.min_snr,
                "test_fraction": rules.test_fraction,
                "recordings": json.dumps(self.told),
                "sha256": hash_of(digests, variables, full_scale=scale, targets=names, classes=known),
                **self.attributes,
            }
        )


@contextmanager
def dataset_writer(
    out: str | os.PathLike[str],
    rules: Rules,
    names: tuple[str, ...],
    classes: list[str],
    full_scale: int,
    *,
    dtype: np.dtype[Any] | None = None,
    overwrite: bool = False,
) -> Iterator[DatasetWriter]:
    """Open a store for writing; it takes its name only when it is whole.

    Parameters
    ----------
    out
        The store, by convention NAME.zarr.
    rules
        How frames are judged, cut and split.
    names, classes
        What crops are labelled with, and the names of all devices.
    full_scale
        Digital number of saturation.
    dtype
        Of the crops; uint8 or uint16, as the full scale needs, where left out.
    overwrite
        Replace a store that is there already.

    Raises
    ------
    InputError
        When a store is there already, nothing was added, or nothing for one of the two parts.
    """
    kind = np.dtype(np.uint8 if full_scale <= 255 else np.uint16) if dtype is None else dtype
    with atomic_folder(out, overwrite=overwrite) as folder:
        writer = DatasetWriter(zarr.create_group(str(folder), zarr_format=3), rules, names, classes, full_scale, kind)
        yield writer
        writer.finish()


def make_array(
    group: zarr.Group,
    name: str,
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    dtype: np.dtype[Any],
    dimensions: tuple[str, ...],
) -> zarr.Array[Any]:
    shuffle = BloscShuffle.bitshuffle if dtype.itemsize == 1 else BloscShuffle.shuffle
    return group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        dimension_names=dimensions,
        # Blosc alone does not notice a flipped bit; the checksum does.
        compressors=[BloscCodec(cname="zstd", clevel=3, shuffle=shuffle), Crc32cCodec()],
        # A chunk of zeros is written too, so that a missing one can be distinguished from it.
        config={"write_empty_chunks": True},
    )


def _set_embargo(columns: dict[str, list[float]], told: list[dict[str, Any]]) -> None:
    """Take out of the test part what shares measurements with the training part, and count it."""
    if not columns:
        return
    time, back, ahead, recording = (np.asarray(columns[n]) for n in ("time", "label_back", "label_ahead", "recording"))
    split = np.asarray(columns["split"], np.int8)
    split = embargoed(split, recording, np.stack([time - back, time + ahead], axis=1))
    columns["split"] = split.tolist()
    for number, line in enumerate(told):
        line["embargo"] = int(np.count_nonzero((recording == number) & (split == EMBARGO)))


def _check_parts(columns: dict[str, list[float]], told: list[dict[str, Any]], test_fraction: float) -> None:
    split = columns.get("split", [])
    why = "; ".join(
        f"{t['name']}: {t['frames']} frames, {', '.join(f'{k} {v}' for k, v in t['left_out'].items())}" for t in told
    )
    if not split:
        remedy = "check the labels and that the probe sees the target, or lower min_snr and min_quality"
        raise InputError(f"no frame has both a good label and a visible RR ({why})", where="recordings", remedy=remedy)
    if 0 < test_fraction < 1 and not {TRAIN, TEST} <= set(split):
        part = "test" if TEST not in split else "train"
        remedy = "record longer, or set test_fraction to 0 or 1"
        if EMBARGO in split:
            why += f"; {split.count(EMBARGO)} share measurements of their labels with training frames"
        raise InputError(f"no frame is left to {part} with ({why})", where="recordings", remedy=remedy)


_COLUMNS: dict[str, tuple[type, dict[str, str]]] = {
    "centre_x": (np.float32, {"units": "px", "long_name": "centre of the crop in the probe's frame"}),
    "centre_y": (np.float32, {"units": "px", "long_name": "centre of the crop in the probe's frame"}),
    "snr": (np.float32, {"units": "1", "long_name": "height of the smoothed RR over the noise"}),
    "quality": (np.float32, {"units": "1", "long_name": "quality of the label, 0 ... 1"}),
    "recording": (np.int32, {"long_name": "number in the attribute recordings"}),
    "time": (np.float64, {"units": "s", "long_name": "time since the first frame of the recording"}),
    "frame_index": (np.int64, {"long_name": "number of the frame in the probe's video"}),
    "label_back": (np.float32, {"units": "s", "long_name": "how far the label reaches back of the frame"}),
    "label_ahead": (np.float32, {"units": "s", "long_name": "how far the label reaches ahead of the frame"}),
}
_TRUE: dict[str, tuple[type, dict[str, str]]] = {
    name: (np.float32, {"units": QUANTITIES["gaze_x"], "long_name": "where it really looked, which no label tells"})
    for name in TRUE_GAZE
}


def _write_columns(
    group: zarr.Group, columns: dict[str, list[float]], names: tuple[str, ...], classes: list[str]
) -> dict[str, NDArray[np.generic]]:
    """Write the variables along ``frame``; return them as they are stored."""
    kinds = {**{n: (np.float32, {"units": QUANTITIES[n]}) for n in names if n != DEVICE}, **_COLUMNS}
    kinds |= {name: kind for name, kind in _TRUE.items() if name in columns}
    written: dict[str, NDArray[np.generic]] = {}
    attributes: dict[str, dict[str, Any]] = {}
    for name, (kind, attrs) in kinds.items():
        written[name], attributes[name] = np.asarray(columns[name], dtype=kind), dict(attrs)
    if DEVICE in names:
        device = class_variable([classes[int(number)] for number in columns[DEVICE]], classes)
        written[DEVICE], attributes[DEVICE] = device.values, dict(device.attrs)
    split = split_variable(np.asarray(columns["split"], dtype=np.int8))
    written["split"], attributes["split"] = split.values, dict(split.attrs)
    for name, values in written.items():
        if values.dtype.kind == "f" and not math.isfinite(float(np.sum(values, dtype=np.float64))):
            raise InputError(
                f"{name} holds values that are not finite", where="recordings", remedy="report this as a bug"
            )
        array = make_array(group, name, values.shape, values.shape, values.dtype, ("frame",))
        array[:] = values
        array.attrs.update(attributes[name])
    return written
