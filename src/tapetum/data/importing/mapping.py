"""What the files of an import mean: a small YAML file, checked before anything is read."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.faults import first_fault
from tapetum.bench.plain_yaml import field_paths, read_mapping
from tapetum.bench.quantity import to_si
from tapetum.bench.strict import STRICT, Share
from tapetum.data.importing.fields import Column, Images, Labels, Values
from tapetum.errors import InputError

__all__ = ["SCHEMA", "ImportMapping", "Pair", "Stack", "load_mapping", "mapping_from_dict", "mapping_from_text"]

SCHEMA = "tapetum/import/1"


@dataclass(frozen=True, config=STRICT)
class Stack:
    """Pictures with their labels.

    Parameters
    ----------
    images, labels
        The pictures and what they are labelled with.
    name
        What to call the recording; by default that of the images' file or folder.
    recording
        Which video each picture is from; by default all are from one.
    order, time
        Its place in the video and its time; by default as they come, at `rate`.
    split
        Which pictures test: rows with the value `test`, `val` or 1. By default the end of every video.
    rate
        Pictures a second where no time is given.
    """

    images: Images
    labels: Labels
    name: str = ""
    recording: Values | None = None
    order: Column | None = None
    time: Column | None = None
    split: Column | None = None
    rate: Annotated[float, Field(gt=0)] = 15.0

    @model_validator(mode="after")
    def _labelled(self) -> Stack:
        if not self.labels.given():
            raise ValueError("has no labels; give gaze_x, gaze_y, object_distance, focal_length or device")
        return self


@dataclass(frozen=True, config=STRICT)
class Pair:
    """Two videos taken together: the probe's and the target's, in which the probe's laser is seen.

    Parameters
    ----------
    probe, target
        Videos or folders of images.
    name
        What to call the recording; by default that of the probe's file.
    align
        How their clocks are brought together: `same start`, `timestamps` or `blink` (a laser seen blinking by both).
    probe_times, target_times
        For `timestamps`: a time for every frame of each.
    offset
        Seconds by which the target's clock is to be put forward, after all else.
    labels
        What is the same for the whole video: object distance, focal length, device.
    """

    probe: str
    target: str
    name: str = ""
    align: Literal["same start", "timestamps", "blink"] = "same start"
    probe_times: Column | None = None
    target_times: Column | None = None
    offset: Annotated[float, BeforeValidator(lambda value: to_si(value, "s"))] = 0.0
    labels: Labels = Labels()

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
        Pairs of videos, or pictures with labels; one of the two.
    side
        Pixels along an edge of the crops.
    centred
        Whether the pictures are crops with the RR in their middle already. Otherwise they are centred on the brightest
        point, and those without a visible RR left out.
    pad
        Whether pictures smaller than `side` may be filled up with their median.
    full_scale
        Largest count of the camera (1 for real numbers from 0 to 1); known for 8 bit pictures and image files.
    test_fraction
        Share of every video, at its end, that tests.
    embargo
        Seconds between training and test pictures of one video: as far as the labels of neighbours were smoothed
        together. Labels of pairs of videos bring their own.
    missing
        What to do with a label that is not a number: `refuse` the import, or `drop` the picture.
    """

    schema: Literal["tapetum/import/1"] = SCHEMA
    videos: tuple[Pair, ...] = ()
    stacks: tuple[Stack, ...] = ()
    side: Annotated[int, Field(ge=8, le=4096)] = 400
    centred: bool = False
    pad: bool = False
    full_scale: Annotated[int, Field(gt=0)] | None = None
    test_fraction: Share = 0.2
    embargo: Annotated[float, Field(ge=0), BeforeValidator(lambda value: to_si(value, "s"))] = 0.0
    missing: Literal["refuse", "drop"] = "refuse"

    @model_validator(mode="after")
    def _something(self) -> ImportMapping:
        if bool(self.videos) == bool(self.stacks):
            raise ValueError("needs either videos or stacks; give one of them")
        return self

    def as_dict(self) -> dict[str, Any]:
        """The mapping as nested plain values, without what is left at its default."""
        return json.loads(_adapter().dump_json(self, exclude_defaults=True))


@functools.cache
def _adapter() -> TypeAdapter[ImportMapping]:
    return TypeAdapter(ImportMapping)


@functools.cache
def _paths() -> tuple[tuple[str, ...], ...]:
    """Every field of a mapping, to guess what an unknown key meant."""
    return tuple(field_paths(ImportMapping))


def mapping_from_dict(content: Mapping[str, Any], where: str = "mapping") -> ImportMapping:
    """Build a mapping from nested values as read from YAML.

    Raises
    ------
    InputError
        Naming `where`, the field's path, its value and the remedy.
    """
    try:
        return _adapter().validate_python(dict(content))
    except ValidationError as error:
        raise first_fault(error, where, _paths()) from error


def load_mapping(path: str | os.PathLike[str]) -> ImportMapping:
    """Read a mapping from a YAML file.

    Raises
    ------
    InputError
        When the file is missing, no YAML, of another schema, or holds an unknown key or a wrong value.
    """
    file = Path(path)
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read as text ({error})", where=file, remedy="give a YAML file") from error
    return mapping_from_text(text, str(file))


def mapping_from_text(text: str, where: str) -> ImportMapping:
    """Read a mapping from YAML text; see `load_mapping`."""
    return mapping_from_dict(read_mapping(text, SCHEMA, where), where)
