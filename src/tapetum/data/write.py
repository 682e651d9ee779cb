"""The writer of datasets from recordings, pictures or the virtual bench."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec

from tapetum.data.content import DIGEST, hash_of, image_digests
from tapetum.data.crop import CENTRING, SIGMA, crop, find_centre, find_peak
from tapetum.data.dataset import (
    DEVICE,
    EMBARGO,
    FORMAT,
    QUANTITIES,
    STD,
    TEST,
    TRAIN,
    TRUE_GAZE,
    UNIT,
    VERSION,
    class_variable,
    split_variable,
)
from tapetum.data.embargo import embargoed
from tapetum.errors import InputError
from tapetum.files import atomic_folder

__all__ = ["AS_IMPORTED", "CHUNK", "LARGEST_SIDE", "RING_SIGMA", "DatasetWriter", "Rules", "dataset_writer"]

CHUNK = 64
"""Frames a chunk of the store: 10 MB of 400 x 400 pixels before compression."""
LARGEST_SIDE = 4000
"""Largest side of a crop: a chunk of 16-bit crops then fills the 2 GB that its compressor accepts."""
RING_SIGMA = 4.0
"""Standard deviation in pixels of the smoothing that detects a faint RR best."""
AS_IMPORTED = "as imported"
"""The `Rules.centring` of images with the RR already in their middle."""


@dataclass(frozen=True)
class Rules:
    """How frames are selected, cut and split: the arguments of `tapetum.data.build_dataset`."""

    side: int = 400
    test_fraction: float = 0.2
    min_quality: float = 0.5
    min_snr: float = 6.0
    sigma: float = SIGMA
    centring: str = CENTRING
    embargo: float = 0.0

    def cut(self, image: NDArray[np.generic]) -> tuple[NDArray[np.generic], dict[str, float]] | None:
        """Return the crop of a frame [H, W] with its place and SNR, or None where no RR is visible."""
        # A narrow smoothing detects the RR best, a wider one locates its middle.
        snr = find_peak(image, RING_SIGMA).snr
        if self.centring == AS_IMPORTED:
            x, y = (image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2
        elif snr < self.min_snr:
            return None
        else:
            x, y = find_centre(image, self.sigma)
        # A noiseless float frame has an infinite SNR, stored as 1e6.
        return crop(image, (x, y), self.side), {"centre_x": x, "centre_y": y, "snr": min(snr, 1e6)}

    def split(self, place: Any, total: Any) -> NDArray[np.int8]:
        """Return the part of frames by their place in their video, counted from 0: its end tests."""
        # Rounded, so that 0.8 of 10 frames is exactly 8.
        first_test = np.round((1 - self.test_fraction) * np.asarray(total, float), 6)
        return np.where(np.asarray(place) < first_test, TRAIN, TEST).astype(np.int8)


class DatasetWriter:
    """Appends crops and their values to a store in whole chunks. Made by `dataset_writer`.

    `told` becomes the store's attribute ``recordings``: what became of each recording's frames. `attributes` are
    further JSON attributes of the store; `units` are the names of the numbers in the column `unit`, if it is added.
    `pool` compresses a chunk while the next one is added; what is raised there is raised with the next chunk.
    """

    def __init__(
        self,
        group: zarr.Group,
        rules: Rules,
        names: tuple[str, ...],
        classes: list[str],
        full_scale: int,
        dtype: np.dtype[Any],
        pool: Executor,
    ) -> None:
        self._pool, self._written = pool, Future[Any]()
        self._written.set_result(None)
        self.told: list[dict[str, Any]] = []
        self.attributes: dict[str, Any] = {}
        self.units: list[str] = []
        self._group, self._rules, self._names, self._classes = group, rules, names, classes
        self._full_scale = full_scale
        self._columns: dict[str, list[float]] = {}
        self._digests: list[NDArray[np.uint8]] = []
        self._buffer: list[NDArray[np.generic]] = []
        side, about = rules.side, {"units": "count", "long_name": "crop around the retro-reflection"}
        empty = np.empty((0, side, side), dtype)
        self._array = _add_array(group, "image", empty, ("frame", "y", "x"), about, (CHUNK, side, side))

    @property
    def empty(self) -> bool:
        """Whether nothing was added yet."""
        return not self._columns

    def add(self, image: NDArray[np.generic], /, **values: float) -> None:
        """Add a crop [side, side] and its values by name."""
        self._digests.append(image_digests([image]))
        self._buffer.append(image)
        for name, value in values.items():
            self._columns.setdefault(name, []).append(value)
        if len(self._buffer) == CHUNK:
            self._flush()

    def _flush(self) -> None:
        if self._buffer:
            chunk = np.stack(self._buffer)
            self._buffer.clear()
            # One after another: each append makes the array longer.
            self._written.result()
            self._written = self._pool.submit(self._array.append, chunk)

    def finish(self) -> None:
        """Write the rest of the store; raise an InputError when no frame is left to train or to test with."""
        self._flush()
        self._written.result()
        rules, names = self._rules, self._names
        self._set_embargo()
        self._check_parts()
        variables = self._write_columns()
        digests = np.concatenate(self._digests)
        _add_array(self._group, DIGEST, digests, ("frame", "digest_byte"), {"long_name": "BLAKE2b of the crop"})
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

    def _set_embargo(self) -> None:
        """Set the embargo on test frames that share measurements with the training part, and count them."""
        if self.empty:
            return
        time, back, ahead, recording, split = (
            np.asarray(self._columns[name]) for name in ("time", "label_back", "label_ahead", "recording", "split")
        )
        split = embargoed(split.astype(np.int8), recording, np.stack([time - back, time + ahead], axis=1))
        self._columns["split"] = split.tolist()
        for number, line in enumerate(self.told):
            line["embargo"] = int(np.count_nonzero((recording == number) & (split == EMBARGO)))

    def _check_parts(self) -> None:
        split = self._columns.get("split", [])
        why = "; ".join(
            f"{t['name']}: {t['frames']} frames, {', '.join(f'{k} {v}' for k, v in t['left_out'].items())}"
            for t in self.told
        )
        if not split:
            what = f"no frame has both a good label and a visible RR ({why})"
            remedy = "check the labels and that the probe sees the target, or lower min_snr and min_quality"
            raise InputError(what, where="recordings", remedy=remedy)
        if 0 < self._rules.test_fraction < 1 and not {TRAIN, TEST} <= set(split):
            part = "test" if TEST not in split else "train"
            remedy = "record longer, or set test_fraction to 0 or 1"
            if EMBARGO in split:
                why += f"; {split.count(EMBARGO)} share measurements of their labels with training frames"
            raise InputError(f"no frame is left to {part} with ({why})", where="recordings", remedy=remedy)

    def _write_columns(self) -> dict[str, NDArray[np.generic]]:
        """Write the variables along ``frame``; return them as they are stored."""
        kinds = {name: (np.float32, {"units": QUANTITIES[name]}) for name in self._names if name != DEVICE} | _COLUMNS
        kinds |= {name: _TRUE for name in TRUE_GAZE if name in self._columns}
        for name in self._names:
            if f"{name}{STD}" in self._columns:
                about = {"units": QUANTITIES[name], "long_name": "standard deviation of the label"}
                kinds[f"{name}{STD}"] = (np.float32, about)
        found: dict[str, tuple[NDArray[Any], dict[str, Any]]] = {}
        found |= {name: (np.asarray(self._columns[name], kind), about) for name, (kind, about) in kinds.items()}
        if DEVICE in self._names:
            named = [self._classes[int(number)] for number in self._columns[DEVICE]]
            device = class_variable(named, self._classes)
            found[DEVICE] = device.values, dict(device.attrs)
        if UNIT in self._columns:
            found[UNIT] = np.asarray(self._columns[UNIT], np.int32), {**_UNIT, "classes": self.units}
        split = split_variable(np.asarray(self._columns["split"], dtype=np.int8))
        found["split"] = split.values, dict(split.attrs)
        for name, (values, about) in found.items():
            if values.dtype.kind == "f" and not math.isfinite(float(np.sum(values, dtype=np.float64))):
                what = f"{name} holds values that are not finite"
                raise InputError(what, where="recordings", remedy="report this as a bug")
            _add_array(self._group, name, values, ("frame",), about)
        return {name: values for name, (values, _) in found.items()}


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
    """Open the store `out` for writing; it appears, and replaces an old one with `overwrite`, only once it is complete.

    Labels are `names`, devices `classes`. Counts saturate at `full_scale`; without `dtype` crops are uint8 or uint16
    accordingly. Raises an InputError when `out` may not be replaced, or as `DatasetWriter.finish`.
    """
    kind = np.dtype(np.uint8 if full_scale <= 255 else np.uint16) if dtype is None else dtype
    with atomic_folder(out, FORMAT, overwrite=overwrite) as folder, ThreadPoolExecutor(1, "chunk") as pool:
        group = zarr.create_group(str(folder), zarr_format=3)
        writer = DatasetWriter(group, rules, names, classes, full_scale, kind, pool)
        yield writer
        writer.finish()


def _add_array(
    group: zarr.Group,
    name: str,
    values: NDArray[Any],
    dimensions: tuple[str, ...],
    about: dict[str, Any],
    chunks: tuple[int, ...] | None = None,
) -> zarr.Array[Any]:
    shuffle = BloscShuffle.bitshuffle if values.dtype.itemsize == 1 else BloscShuffle.shuffle
    array = group.create_array(
        name,
        shape=values.shape,
        chunks=values.shape if chunks is None else chunks,
        dtype=values.dtype,
        dimension_names=dimensions,
        attributes=about,
        # Blosc does not detect a flipped bit, the checksum does.
        compressors=[BloscCodec(cname="zstd", clevel=3, shuffle=shuffle), Crc32cCodec()],
        # Chunks of zeros are written too, to distinguish them from missing ones.
        config={"write_empty_chunks": True},
    )
    if values.size:
        array[:] = values
    return array


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
_UNIT = {"long_name": "copy of the camera"}
# Of synthesised sets only.
_TRUE = (np.float32, {"units": QUANTITIES["gaze_x"], "long_name": "where it really looked, which no label shows"})
