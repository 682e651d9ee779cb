"""The mapping of an import, a small YAML file that says what files mean; checked before anything is read."""

from __future__ import annotations

import dataclasses
import functools
import json
import os
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.faults import first_fault, refuse_truths
from tapetum.bench.plain_yaml import field_paths, read_mapping
from tapetum.bench.quantity import to_si
from tapetum.bench.strict import STRICT, Share
from tapetum.files import read_text

__all__ = [
    "SCHEMA",
    "Column",
    "ImagesEntry",
    "ImportMapping",
    "LabelsEntry",
    "Pair",
    "Stack",
    "load_mapping",
    "mapping_from_dict",
    "mapping_from_text",
]

SCHEMA = "tapetum/import/1"
AXES = ("frame", "y", "x", "channel")
Seconds = Annotated[float, BeforeValidator(lambda value: to_si(value, "s"))]


def _name_or_number(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise ValueError(f"must be a column's name or its number from 0, is {value!r}; write for example 'gaze_x' or 0")
    return value


def _constant(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError(f"must be one value, is {value!r}; write for example '3 m' or 'phone-01'")
    return value


def _whole(value: object) -> object:
    """Accept `3 m` in place of a mapping as one value for every frame."""
    if isinstance(value, list | tuple | bool):
        raise ValueError(f"must be one value or a mapping, is {value!r}; write '3 m', or file, column and unit")
    return {"value": value} if isinstance(value, str | int | float) else value


def _axes(value: object) -> object:
    words = value.replace(",", " ").split() if isinstance(value, str) else value
    if not isinstance(words, list | tuple) or sorted(map(str, words)) not in (sorted(AXES), sorted(AXES[:3])):
        raise ValueError(f"must name frame, y, x (and channel) once each, is {value!r}; write for example 'frame y x'")
    return tuple(words)


@dataclass(frozen=True, config=STRICT)
class Column:
    """Source and unit of one value per frame."""

    # A table (.csv, .tsv, .txt) or a file of arrays, by default that of the images; the array's name in it.
    file: str | None = None
    array: str | None = None
    # A table's column by name, or a column of a table without names or of a two-dimensional array by number from 0.
    column: Annotated[Any, BeforeValidator(_name_or_number)] | None = None
    # One value for all frames, in place of a file.
    value: Annotated[Any, BeforeValidator(_constant)] | None = None
    # Any unit of length (default m) or time (s); of gaze `fraction` of the field (default) or `px`.
    unit: str | None = None
    # Where gaze is 0: the frame's centre (by default for fractions) or its upper left corner (for pixels).
    origin: Literal["centre", "corner"] | None = None
    # Of gaze in pixels: pixels of the target's frame along this axis.
    size: Annotated[float, Field(gt=0)] | None = None
    # Whether the file's gaze has the opposite sign of ours (x right, y down).
    flip: bool = False
    # Of a device given by numbers: the name of each number, from 0.
    names: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _one_source(self) -> Column:
        if self.value is not None and any(one is not None for one in (self.file, self.array, self.column)):
            raise ValueError("has a value and a file as well; leave one of them out")
        if self.value is None and all(one is None for one in (self.file, self.array, self.column)):
            raise ValueError("does not say where the values are; add 'file', 'array', 'column' or 'value'")
        return self


Values = Annotated[Column, BeforeValidator(_whole)]


@dataclass(frozen=True, config=STRICT)
class LabelsEntry:
    """Labels of every frame; at least one is given."""

    gaze_x: Values | None = None
    gaze_y: Values | None = None
    object_distance: Values | None = None
    focal_length: Values | None = None
    device: Values | None = None

    def given(self) -> dict[str, Column]:
        """Return the given labels, by name."""
        found = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: column for name, column in found.items() if column is not None}


@dataclass(frozen=True, config=STRICT)
class ImagesEntry:
    """Where the images are."""

    # A file of arrays, a video, or one image of several pages.
    file: str | None = None
    # Name of the array in a file with several, and what each of its axes is, in the order of its shape.
    array: str | None = None
    axes: Annotated[Any, BeforeValidator(_axes)] = ("frame", "y", "x")
    # A folder of image files, in natural order or in that of the column that names them, relative to the folder.
    folder: str | None = None
    names: Column | None = None

    @model_validator(mode="after")
    def _one_source(self) -> ImagesEntry:
        if (self.file is None) == (self.folder is None):
            raise ValueError("needs either a file or a folder; give one of them")
        if self.folder is None and self.names is not None:
            raise ValueError("names are those of the images of a folder; give 'folder' or leave them out")
        return self


@dataclass(frozen=True, config=STRICT)
class Stack:
    """Images with their labels."""

    images: ImagesEntry
    labels: LabelsEntry
    # Of the recording; by default that of the images' file or folder.
    name: str = ""
    # Which video each image is from; by default all are from one.
    recording: Values | None = None
    # An image's place in the video and its time; by default in their order, `rate` per second.
    order: Column | None = None
    time: Column | None = None
    rate: Annotated[float, Field(gt=0)] = 15.0
    # Which images test: rows with the value `test`, `val` or 1. By default the end of every video.
    split: Column | None = None

    @model_validator(mode="after")
    def _labelled(self) -> Stack:
        if not self.labels.given():
            raise ValueError("has no labels; give gaze_x, gaze_y, object_distance, focal_length or device")
        return self


@dataclass(frozen=True, config=STRICT)
class Pair:
    """Two videos, or folders of images, recorded together: the probe's, and the target's, which shows the probe's
    laser.
    """

    probe: str
    target: str
    # Of the recording; by default that of the probe's file.
    name: str = ""
    # How their clocks are aligned. `timestamps`: by a time for every frame of each; `blink`: a laser that both see.
    align: Literal["same start", "timestamps", "blink"] = "same start"
    probe_times: Column | None = None
    target_times: Column | None = None
    # Seconds by which the target's clock is to be put forward, after all else.
    offset: Seconds = 0.0
    # What is constant within the video: object distance, focal length, device.
    labels: LabelsEntry = LabelsEntry()

    @model_validator(mode="after")
    def _aligned(self) -> Pair:
        times = self.probe_times is not None and self.target_times is not None
        if (self.align == "timestamps") != times:
            raise ValueError("probe_times and target_times belong to align 'timestamps'; give both of them with it")
        for name, column in self.labels.given().items():
            if name.startswith("gaze") or column.value is None:
                raise ValueError(f"{name} of a whole video must be one value and no gaze; write for example '3 m'")
        return self


@dataclass(frozen=True, config=STRICT)
class ImportMapping:
    """An import: where everything is, and how crops are cut.

    Parameters
    ----------
    videos, stacks
        Pairs of videos, or images with labels; one of the two.
    side
        Pixels along an edge of the crops.
    centred
        Whether the images are crops with the RR already in their middle. Otherwise they are centred on the brightest
        point, and those without a visible RR left out.
    pad
        Whether images smaller than `side` may be padded with their median.
    full_scale
        Largest count of the camera (1 for real numbers from 0 to 1); known for 8-bit images and image files.
    test_fraction
        Share of every video, at its end, that tests.
    embargo
        Seconds between training and test images of one video: the range over which labels were smoothed. Labels of
        pairs of videos bring their own.
    missing
        What to do with a label that is not a number: `refuse` the import, or `drop` the image.
    """

    schema: Literal["tapetum/import/1"] = SCHEMA
    videos: tuple[Pair, ...] = ()
    stacks: tuple[Stack, ...] = ()
    side: Annotated[int, Field(ge=8, le=4096)] = 400
    centred: bool = False
    pad: bool = False
    full_scale: Annotated[int, Field(gt=0)] | None = None
    test_fraction: Share = 0.2
    embargo: Annotated[Seconds, Field(ge=0)] = 0.0
    missing: Literal["refuse", "drop"] = "refuse"

    @model_validator(mode="after")
    def _something(self) -> ImportMapping:
        if bool(self.videos) == bool(self.stacks):
            raise ValueError("needs either videos or stacks; give one of them")
        return self

    def as_dict(self) -> dict[str, Any]:
        """Return the mapping as nested plain values, without defaults."""
        return json.loads(_adapter().dump_json(self, exclude_defaults=True))


@functools.cache
def _adapter() -> TypeAdapter[ImportMapping]:
    return TypeAdapter(ImportMapping)


def mapping_from_dict(content: Mapping[str, Any], where: str = "mapping") -> ImportMapping:
    """Build a mapping from nested values as read from YAML; an InputError names `where` and the field's path."""
    try:
        mapping = _adapter().validate_python(dict(content))
    except ValidationError as error:
        raise first_fault(error, where, tuple(field_paths(ImportMapping))) from error
    refuse_truths(content, mapping, where)
    return mapping


def load_mapping(path: str | os.PathLike[str]) -> ImportMapping:
    """Read a mapping from a YAML file.

    Raises
    ------
    InputError
        When the file is missing, no YAML, of another schema, or holds an unknown key or a wrong value.
    """
    return mapping_from_text(read_text(path, "give a YAML file"), str(path))


def mapping_from_text(text: str, where: str) -> ImportMapping:
    """Read a mapping from YAML text; see `load_mapping`."""
    return mapping_from_dict(read_mapping(text, SCHEMA, where), where)
