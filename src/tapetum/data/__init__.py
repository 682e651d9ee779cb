"""Datasets of retro-reflections: crops, labels and splits, from recordings to an xarray Dataset."""

from tapetum.data.build import build_dataset
from tapetum.data.crop import Peak, crop, crop_batch, find_centre, find_peak
from tapetum.data.dataset import (
    DatasetAccessor,
    class_variable,
    content_hash,
    dataset_from_arrays,
    image_batches,
    open_dataset,
)
from tapetum.data.units import split_by

__all__ = [
    "DatasetAccessor",
    "Peak",
    "build_dataset",
    "class_variable",
    "content_hash",
    "crop",
    "crop_batch",
    "dataset_from_arrays",
    "find_centre",
    "find_peak",
    "image_batches",
    "open_dataset",
    "split_by",
]
