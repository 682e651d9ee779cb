"""Datasets: crops of retro-reflections with their labels, one Zarr v3 store each, opened as an xarray Dataset.

Importing this module registers the accessor ``.tp`` on every xarray Dataset. One file of more than 400 lines: what the
accessor offers stands beside the format that it reads.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, PositiveFloat, ValidationError

from tapetum.data.content import DIGEST, DIGEST_BYTES, hash_of, image_digests
from tapetum.errors import InputError
from tapetum.futures import in_order
from tapetum.progress import Progress, quiet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "DEVICE",
    "EMBARGO",
    "FORMAT",
    "QUANTITIES",
    "STD",
    "TEST",
    "TRAIN",
    "TRUE_GAZE",
    "UNIT",
    "VERSION",
    "DatasetAccessor",
    "class_variable",
    "content_hash",
    "dataset_from_arrays",
    "image_batches",
    "open_dataset",
]

FORMAT, VERSION = "tapetum-dataset", 1
TRAIN, TEST, EMBARGO = 0, 1, 2
QUANTITIES = {
    "gaze_x": "fraction of the field of view",
    "gaze_y": "fraction of the field of view",
    "object_distance": "m",
    "focal_length": "m",
}
"""Possible labels of a frame that are numbers, and their units."""

TRUE_GAZE = ("true_gaze_x", "true_gaze_y")
"""Variables of a synthesised set with the true gaze, which are not labels."""

STD = "_std"
"""Added to a label's name: the variable with its standard deviations, where they are known."""

DEVICE = "device"
"""The only label that is a class: integers, named by the variable's attribute ``classes``."""

UNIT = "unit"
"""Variable that numbers the copies of a camera, where they are known: integers, named as those of `DEVICE`."""

# Batches that are read at once: a part of the store that two of them share is then seldom read twice.
_TOGETHER = 4
_NEEDED = ("image", "split", "recording")
_AGAIN = "build the dataset again"
_BUILT = "give a folder that `tapetum dataset build` wrote"
# Errors of Zarr and xarray for a store that is damaged or of another kind.
_DAMAGED = (ValueError, OSError, KeyError, TypeError, ImportError, OverflowError, AttributeError, RuntimeError)


class _Attributes(BaseModel):
    """Required attributes of a store of a known format and version."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    full_scale: PositiveFloat
    targets: list[Any]


def content_hash(dataset: xr.Dataset, *, progress: Progress = quiet) -> str:
    """Return the SHA-256 of a dataset's content, which does not depend on how it is stored. Every image is read.

    It covers images, all variables along ``frame`` (labels, split and recording among them), the names of classes and
    labels, and the full scale. `progress` is shown over the batches of images.
    """
    total = -(-dataset.sizes["frame"] // 64)
    batches = progress(image_batches(dataset, 64), "hashing the dataset", total=total)
    digests = [image_digests(images) for images in batches]
    return _hash(dataset, np.concatenate(digests) if digests else np.empty((0, DIGEST_BYTES), np.uint8))


def _hash(dataset: xr.Dataset, digests: NDArray[np.uint8]) -> str:
    along = {str(name): one.values for name, one in dataset.variables.items() if one.dims == ("frame",)}
    accessor = dataset.tp
    return hash_of(digests, along, full_scale=accessor.full_scale, targets=accessor.targets, classes=accessor.classes)


def image_batches(dataset: xr.Dataset, size: int = 64) -> Iterator[NDArray[np.generic]]:
    """Yield the images of a dataset, stored or in memory, in order: [n, side, side], `size` frames at a time.

    Raises an InputError when a stored part cannot be read or fails its checksum.
    """
    if size < 1:
        raise InputError(f"must be positive, is {size}", where="size", remedy="give a number of frames")
    image = _images_of(dataset)
    together = _TOGETHER * size
    with ThreadPoolExecutor(1, "images") as reader:
        # The next part is read while one is used.
        parts = (
            reader.submit(_read, image.isel(frame=slice(start, start + together)), dataset)
            for start in range(0, image.sizes["frame"], together)
        )
        for part in in_order(parts, 2):
            yield from (part[start : start + size] for start in range(0, len(part), size))


def _images_of(dataset: xr.Dataset) -> xr.DataArray:
    image = dataset.get("image")
    if image is None or image.dims != ("frame", "y", "x"):
        remedy = "build it with `tapetum dataset build`"
        raise InputError("no images image(frame, y, x)", where=dataset.tp.source, remedy=remedy)
    return image


def _read(array: xr.DataArray, dataset: xr.Dataset) -> NDArray[Any]:
    try:
        return np.asarray(array.values)
    except _DAMAGED as error:
        what = f"damaged: {array.name} cannot be read ({error})"
        raise InputError(what, where=dataset.tp.source, remedy=_AGAIN) from error


def split_variable(split: NDArray[np.int8]) -> xr.Variable:
    """Return the split as CF flags: 0 train, 1 test, 2 embargo (neither)."""
    flags = {"flag_values": [TRAIN, TEST, EMBARGO], "flag_meanings": "train test embargo"}
    return xr.Variable(("frame",), split, flags)


def class_variable(names: Sequence[str], classes: Sequence[str] | None = None) -> xr.Variable:
    """Return device names [N] as the variable `device`: int32 numbers with the attribute ``classes``.

    `classes` lists all names in the order of their numbers, by default those that occur, sorted. Raises an InputError
    when a name is empty or not among the classes, or a class is named twice.
    """
    known = sorted(set(map(str, names))) if classes is None else [str(name) for name in classes]
    number = {name: n for n, name in enumerate(known)}
    strange = next((str(name) for name in names if str(name) not in number), "" if "" in number else None)
    if strange is not None:
        raise InputError(f"{strange!r} is not among the classes", where=DEVICE, remedy=f"use {', '.join(known)}")
    if len(number) < len(known):
        raise InputError("names a class twice", where=DEVICE, remedy="name every class once")
    values = np.array([number[str(name)] for name in names], dtype=np.int32)
    return xr.Variable(("frame",), values, {"long_name": "model of the target", "classes": known})


def dataset_from_arrays(
    images: ArrayLike,
    targets: Mapping[str, ArrayLike],
    *,
    full_scale: float | None = None,
    split: ArrayLike | None = None,
    recording: ArrayLike | None = None,
) -> xr.Dataset:
    """Make a dataset in memory, for photographs or simulated images without a recording.

    Parameters
    ----------
    images
        [N, side, side] crops, uint8, uint16 or float counts.
    targets
        Name of a quantity to its [N] values in SI units (gaze in fractions of the field of view); `device` to [N]
        names.
    full_scale
        Largest count of the camera; 255 by default for uint8.
    split
        [N], 0 train, 1 test or 2 neither; by default all train.
    recording
        [N], number of the video each image comes from; by default 0.

    Returns
    -------
    xarray.Dataset
        With ``image``, the targets, ``split`` and ``recording`` along ``frame``.

    Raises
    ------
    InputError
        When shapes differ, a target is not finite, or the depth is unknown.
    """
    array = np.asarray(images)
    count = len(array) if array.ndim else 0
    if array.ndim != 3 or array.shape[1] != array.shape[2] or not count:
        raise InputError(f"expected square crops [N, side, side], got shape {array.shape}", where="images")
    if array.dtype.kind not in "uif":
        raise InputError(f"images of type {array.dtype} are not grey levels", where="images", remedy="give numbers")
    if full_scale is None and array.dtype != np.uint8:
        what = f"the depth of {array.dtype} images cannot be known"
        raise InputError(what, where="images", remedy="pass full_scale")
    if full_scale is not None and not 0 < full_scale < math.inf:
        raise InputError(f"must be positive and finite, is {full_scale}", where="full_scale")
    columns: dict[str, xr.Variable] = {}
    for name, values in targets.items():
        if name in _NEEDED:
            raise InputError("is the name of a variable that every set has", where=name, remedy="name the label else")
        if name == DEVICE:
            names = np.asarray(values).ravel()
            if len(names) != count or names.dtype.kind not in "UO":
                raise InputError(f"expected {count} names, got shape {names.shape}", where=name)
            nameless = next((n for n, one in enumerate(names) if not isinstance(one, str)), None)
            if nameless is not None:
                what = f"the name of image {nameless} is {names[nameless]!r}"
                raise InputError(what, where=name, remedy="give a text for every image, or leave the image out")
            columns[name] = class_variable([str(one) for one in names])
            continue
        if np.asarray(values).dtype.kind not in "buif":
            raise InputError("holds no numbers", where=name, remedy=f"give {count} numbers; names are {DEVICE!r} alone")
        column = np.asarray(values, dtype=np.float32)
        if column.shape != (count,) or not np.isfinite(column).all():
            raise InputError(f"expected {count} finite values, got shape {column.shape}", where=name)
        columns[name] = xr.Variable(("frame",), column, {"units": QUANTITIES.get(name, "1")})
    parts = _whole(split, count, np.int8, "split", "0 (train), 1 (test) or 2 (neither)", (TRAIN, TEST, EMBARGO))
    videos = _whole(recording, count, np.int32, "recording", "numbers of recordings")
    variables = {
        "image": xr.Variable(("frame", "y", "x"), array, {"units": "count"}),
        **columns,
        "split": split_variable(parts),
        "recording": xr.Variable(("frame",), videos),
    }
    scale = 255.0 if full_scale is None else float(full_scale)
    attributes = {"format": FORMAT, "version": VERSION, "full_scale": scale, "targets": list(columns)}
    return xr.Dataset(variables, attrs=attributes)


def _whole(
    values: ArrayLike | None,
    count: int,
    kind: type[np.int8] | type[np.int32],
    where: str,
    told: str,
    allowed: Sequence[int] | None = None,
) -> NDArray[Any]:
    """Whole numbers [N], zeros by default; InputError for others."""
    if values is None:
        return np.zeros(count, kind)
    array = np.asarray(values)
    fits = array.shape == (count,) and array.dtype.kind in "buif" and bool((array == np.floor(array)).all())
    if not fits or not (np.abs(array) <= np.iinfo(kind).max).all() or not np.isin(array, allowed or array).all():
        raise InputError(f"expected {count} values, {told}", where=where)
    return array.astype(kind)


def open_dataset(path: str | Path) -> xr.Dataset:
    """Open a dataset, a local folder or any address that fsspec knows; images are read when they are used.

    Returns
    -------
    xarray.Dataset
        ``image(frame, y, x)`` in counts, the labels with their ``units``, ``centre_x``, ``centre_y`` (pixels of the
        frame), ``snr``, ``quality``, ``recording``, ``time`` (s), ``frame_index``, ``label_back``, ``label_ahead`` (s,
        time span of the measurements behind a label), ``split``; where known ``gaze_x_std`` and ``gaze_y_std``, the
        standard deviations of the labels, and ``unit``, the copy of the camera; in synthesised sets also
        ``true_gaze_x`` and ``true_gaze_y``. See `DatasetAccessor`.

    Raises
    ------
    InputError
        When nothing is there, it is not a Tapetum dataset, a newer Tapetum wrote it, or parts are missing.
    """
    address = str(path)
    local = "://" not in address
    if local and not Path(address).exists():
        raise InputError("does not exist", where=address, remedy="build it with `tapetum dataset build`")
    if local and not (Path(address) / "zarr.json").is_file():
        raise InputError("is not a dataset (no zarr.json)", where=address, remedy=_BUILT)
    try:
        group = zarr.open_group(address, mode="r", zarr_format=3)
        attributes = dict(group.attrs)
    except _DAMAGED as error:
        raise InputError(f"is not a readable Zarr v3 store ({error})", where=address, remedy=_AGAIN) from error
    _check_format(attributes, address)
    try:
        # chunks=None: arrays without Dask. Counts stay counts: no masks, no scaling.
        dataset = xr.open_zarr(
            address, zarr_format=3, consolidated=False, chunks=None, mask_and_scale=False, decode_times=False
        )
        found = _faults(dataset, group, _listed(attributes), chunks=local)
    except (*_DAMAGED, MemoryError) as error:
        raise InputError(f"damaged: {error}", where=address, remedy=_AGAIN) from error
    for fault in found:
        raise InputError(f"damaged: {fault}", where=address, remedy=_AGAIN)
    dataset.encoding["source"] = address
    # Labels are read now, so that damage is reported here and not in the middle of training.
    for name, variable in dataset.data_vars.items():
        if variable.dims == ("frame",):
            dataset[name] = variable.copy(data=_read(variable, dataset))
    return dataset


def _check_format(attributes: Mapping[str, Any], address: str) -> None:
    if attributes.get("format") != FORMAT:
        what = f"is not a Tapetum dataset (format {attributes.get('format')!r})"
        raise InputError(what, where=address, remedy=_BUILT)
    version = attributes.get("version")
    if isinstance(version, bool) or not isinstance(version, int) or not 1 <= version <= VERSION:
        what = f"has version {version!r} of the format, this Tapetum reads up to {VERSION}"
        raise InputError(what, where=address, remedy="update Tapetum")
    try:
        _Attributes.model_validate(attributes)
    except ValidationError as error:
        raise InputError("damaged: no full_scale or targets", where=address, remedy=_AGAIN) from error


def _faults(dataset: xr.Dataset, group: zarr.Group, targets: Sequence[str], *, chunks: bool) -> list[str]:
    """Return what a store lacks: variables, names of classes, chunks."""
    found = []
    if missing := [name for name in (*_NEEDED, *targets) if name not in dataset]:
        found.append(f"lacks {', '.join(missing)}")
    if "split" in dataset and not np.isin(dataset["split"].values, (TRAIN, TEST, EMBARGO)).all():
        found.append("split holds other numbers than 0, 1 and 2")
    for name in targets:
        spread = dataset.get(name + STD)
        if spread is not None and bool((np.asarray(spread.values) < 0).any()):
            found.append(f"{name}{STD} holds negative deviations")
    for name in (*((DEVICE,) if DEVICE in targets else ()), UNIT):
        if name not in dataset:
            continue
        classes, numbers = dataset[name].attrs.get("classes"), np.asarray(dataset[name].values)
        known = len(classes) if isinstance(classes, list) else 0
        if not isinstance(classes, list) or (numbers.size and not 0 <= numbers.min() <= numbers.max() < known):
            found.append(f"{name} lacks names for its numbers")
    for name in dataset.variables if chunks else ():
        array = group[str(name)]
        # Zarr silently reads a missing chunk as zeros.
        if isinstance(array, zarr.Array) and array.nchunks_initialized != array.nchunks:
            lost = array.nchunks - array.nchunks_initialized
            found.append(f"{lost} of {array.nchunks} parts of {name} are missing")
    return found


def _listed(attributes: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(str(name) for name in attributes.get("targets", ()))


@xr.register_dataset_accessor("tp")
class DatasetAccessor:
    """Tapetum's properties and methods of a dataset, as ``dataset.tp``."""

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    def plot(self, count: int = 12) -> Figure:
        """Draw at most `count` crops with their labels, evenly spread over the set.

        The figure has no window: a notebook shows it, `savefig` writes it. `tapetum dataset info --sheet` draws a whole
        contact sheet.
        """
        from matplotlib.figure import Figure

        total = int(self._dataset.sizes["frame"])
        chosen = np.unique(np.linspace(0, total - 1, max(1, min(count, total))).round().astype(int)) if total else []
        few = self._dataset.isel(frame=chosen)
        images = np.concatenate([*image_batches(few), np.empty((0, self.side, self.side))])
        wide = max(1, min(6, len(images)))
        tall = max(1, -(-len(images) // wide))
        figure = Figure(figsize=(1.8 * wide, 2.1 * tall), layout="constrained")
        for n, image in enumerate(images):
            axis = figure.add_subplot(tall, wide, n + 1)
            axis.imshow(np.sqrt(image), cmap="inferno", vmin=0, vmax=self.full_scale**0.5)
            axis.set_axis_off()
            values = [(name, few[name].values[n]) for name in self.targets if name in few]
            told = [self.classes[int(one)] if name == DEVICE else f"{float(one):.3g}" for name, one in values]
            axis.set_title(", ".join(told), fontsize=7)
        return figure

    @property
    def source(self) -> str:
        """Path or address of the dataset, for messages."""
        return str(self._dataset.encoding.get("source", "dataset"))

    def _part(self, flag: int) -> xr.Dataset:
        wanted = np.flatnonzero(np.asarray(self._dataset["split"].values) == flag)
        return self._dataset.isel(frame=wanted)

    @property
    def train(self) -> xr.Dataset:
        """The frames to train with: by default the first 80 % of every video."""
        return self._part(TRAIN)

    @property
    def test(self) -> xr.Dataset:
        """The frames to test with: by default the last 20 % of every video, less an embargo."""
        return self._part(TEST)

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the labels that every frame has."""
        return _listed(self._dataset.attrs)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the numbers in `device`; empty without this label."""
        return tuple(self._dataset[DEVICE].attrs["classes"]) if DEVICE in self._dataset else ()

    @property
    def units(self) -> tuple[str, ...]:
        """Names of the units (copies of cameras) that occur; empty where the set does not distinguish them."""
        if UNIT not in self._dataset:
            return ()
        names = self._dataset[UNIT].attrs["classes"]
        return tuple(names[int(number)] for number in np.unique(np.asarray(self._dataset[UNIT].values)))

    @property
    def full_scale(self) -> float:
        """Largest count of the camera."""
        return float(self._dataset.attrs["full_scale"])

    @property
    def side(self) -> int:
        """Pixels along an edge of the crops."""
        return int(_images_of(self._dataset).sizes["x"])

    @property
    def hash(self) -> str:
        """SHA-256 of the present content: a part (``train``, ``test``) or a relabelled copy has its own.

        A stored set has digests of its images; images in memory, and sets of versions without digests, are read. See
        `content_hash`.
        """
        image, digests = _images_of(self._dataset), self._dataset.get(DIGEST)
        # Digests belong to the stored images; images in memory may have been changed.
        if digests is None or image.variable._in_memory:
            return content_hash(self._dataset)
        return _hash(self._dataset, _read(digests, self._dataset))

    @property
    def recordings(self) -> list[dict[str, Any]]:
        """Name, uuid, and counts of frames, used and left out, of each number in ``recording``."""
        return json.loads(self._dataset.attrs.get("recordings", "[]"))

    def images(self, batch: int = 64) -> Iterator[NDArray[np.generic]]:
        """Read the images in order, [n, side, side] at a time: see `image_batches`."""
        return image_batches(self._dataset, batch)

    def values(self, names: tuple[str, ...]) -> NDArray[np.float64]:
        """Return labels as [N, len(names)]; raise an InputError when one is missing."""
        for name in names:
            if name not in self.targets or name not in self._dataset:
                have = ", ".join(self.targets) or "none"
                raise InputError(f"has no label {name!r}", where=self.source, remedy=f"it has: {have}")
        return np.stack([np.asarray(self._dataset[n].values, dtype=np.float64) for n in names], axis=1)
