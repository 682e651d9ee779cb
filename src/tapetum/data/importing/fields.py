"""The parts of a mapping that say where pictures and values are."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.strict import STRICT

__all__ = ["AXES", "Column", "Images", "Labels", "Values"]

AXES = ("frame", "y", "x", "channel")


def _name_or_number(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise ValueError(f"must be a column's name or its number from 0, is {value!r}; write for example 'gaze_x' or 0")
    return value


def _constant(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError(f"must be one value, is {value!r}; write for example '3 m' or 'phone-01'")
    return value


def _whole(value: object) -> object:
    """`3 m` in place of a mapping is one value for every frame."""
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
    """Where one value for every frame comes from, and what it is measured in.

    Parameters
    ----------
    file
        A table (.csv, .tsv, .txt) or a file of arrays; by default the file of the images.
    array
        Name of the array in a file with several.
    column
        A table's column by name, or a column of a table without names or of a two-dimensional array by number from 0.
    value
        One value for all frames, in place of a file.
    unit
        Of lengths: any length (by default m). Of times: any time (s). Of gaze: `fraction` of the field (by default) or
        `px`.
    origin
        Of gaze: where it is 0, the frame's `centre` (by default for fractions) or its upper left `corner` (for pixels).
    size
        Of gaze in pixels: pixels of the target's frame along this axis.
    flip
        Of gaze: whether the file counts against ours (x right, y down).
    names
        Of a device given by numbers: the name of each number, from 0.
    """

    file: str | None = None
    array: str | None = None
    column: Annotated[Any, BeforeValidator(_name_or_number)] | None = None
    value: Annotated[Any, BeforeValidator(_constant)] | None = None
    unit: str | None = None
    origin: Literal["centre", "corner"] | None = None
    size: Annotated[float, Field(gt=0)] | None = None
    flip: bool = False
    names: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _one_source(self) -> Column:
        if self.value is not None and any(one is not None for one in (self.file, self.array, self.column)):
            raise ValueError("has a value and a file as well; leave one of them out")
        if self.value is None and all(one is None for one in (self.file, self.array, self.column)):
            raise ValueError("says not where the values are; add 'file', 'array', 'column' or 'value'")
        return self


Values = Annotated[Column, BeforeValidator(_whole)]


@dataclass(frozen=True, config=STRICT)
class Labels:
    """What every frame is labelled with: at least one of these."""

    gaze_x: Values | None = None
    gaze_y: Values | None = None
    object_distance: Values | None = None
    focal_length: Values | None = None
    device: Values | None = None

    def given(self) -> dict[str, Column]:
        """The labels that are given, by name."""
        found = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: column for name, column in found.items() if column is not None}


@dataclass(frozen=True, config=STRICT)
class Images:
    """Where the pictures are.

    Parameters
    ----------
    file
        A file of arrays, a video, or one image of several pages.
    array
        Name of the array in a file with several.
    axes
        What each axis of the array is, in the order in which `tapetum dataset import` lists the array's shape.
    folder
        A folder of image files, in natural order unless `names` says which.
    names
        The column with each image's file name, relative to the folder.
    """

    file: str | None = None
    array: str | None = None
    axes: Annotated[Any, BeforeValidator(_axes)] = ("frame", "y", "x")
    folder: str | None = None
    names: Column | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Images:
        if (self.file is None) == (self.folder is None):
            raise ValueError("needs either a file or a folder; give one of them")
        if self.folder is None and self.names is not None:
            raise ValueError("names are those of the images of a folder; give 'folder' or leave them out")
        return self
