"""Tolerances: how far the copies of one camera model differ, with the source of each number; read from YAML."""

from __future__ import annotations

from typing import Annotated, TypeVar

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.catalogue import Catalogue
from tapetum.bench.faults import build
from tapetum.bench.quantity import Angle, Length
from tapetum.bench.strict import STRICT

__all__ = [
    "TOLERANCES_SCHEMA",
    "AngleTolerance",
    "LengthTolerance",
    "ShareTolerance",
    "Tolerances",
    "load_tolerances",
    "tolerance_names",
]

TOLERANCES_SCHEMA = "tapetum/tolerances/1"
_FILES = Catalogue("set of tolerances", TOLERANCES_SCHEMA, "tolerances")
Source = Annotated[str, Field(min_length=3)]
SomeTolerance = TypeVar("SomeTolerance", bound="AngleTolerance | LengthTolerance | ShareTolerance")


@dataclass(frozen=True, config=STRICT)
class AngleTolerance:
    """A normal distribution of standard deviation `spread`, cut off at ±`limit`, in radians, and its `source`."""

    spread: Annotated[Angle, Field(gt=0, le=0.1)]
    limit: Annotated[Angle, Field(gt=0, le=0.1)]
    source: Source

    @model_validator(mode="after")
    def _is_wide_enough(self) -> AngleTolerance:
        return _checked(self)


@dataclass(frozen=True, config=STRICT)
class LengthTolerance:
    """As `AngleTolerance`, in metres."""

    spread: Annotated[Length, Field(gt=0, le=0.01)]
    limit: Annotated[Length, Field(gt=0, le=0.01)]
    source: Source

    @model_validator(mode="after")
    def _is_wide_enough(self) -> LengthTolerance:
        return _checked(self)


@dataclass(frozen=True, config=STRICT)
class ShareTolerance:
    """As `AngleTolerance`, in fractions."""

    spread: Annotated[float, Field(gt=0, lt=1)]
    limit: Annotated[float, Field(gt=0, lt=1)]
    source: Source

    @model_validator(mode="after")
    def _is_wide_enough(self) -> ShareTolerance:
        return _checked(self)


def _checked(tolerance: SomeTolerance) -> SomeTolerance:
    if tolerance.limit < tolerance.spread:
        what = f"limit {tolerance.limit:g} is below the standard deviation {tolerance.spread:g}"
        raise ValueError(f"{what}; raise it or lower spread")
    return tolerance


@dataclass(frozen=True, config=STRICT)
class Tolerances:
    """How copies of a camera and its probe differ; what is None does not.

    Parameters
    ----------
    sensor_tilt, decentre
        Of `TargetSensor`, each axis, about 0: in place of what the scene says, which is one copy's.
    focus
        Place of the sensor along the axis, in fractions of the depth of focus, F-number times pitch of the photosites.
    focal_length, aperture
        Of the lens, in fractions. A lens that is wide open is only stopped down; a zoom stays within its range.
    reflectance, coating
        Of the sensor and of the lens's surfaces, in fractions.
    filter_tilt, filter_depth
        Of each layer before the sensor: its tilt about 0, and its depth.
    microlens_shift
        In fractions of the nominal one.
    axis
        Of each camera of a phone against the plate's normal, about 0.
    beam_ratio, beam_angle
        Of the probe's second beam, in fractions.
    """

    sensor_tilt: AngleTolerance | None = None
    decentre: LengthTolerance | None = None
    focus: ShareTolerance | None = None
    focal_length: ShareTolerance | None = None
    aperture: ShareTolerance | None = None
    reflectance: ShareTolerance | None = None
    coating: ShareTolerance | None = None
    filter_tilt: AngleTolerance | None = None
    filter_depth: LengthTolerance | None = None
    microlens_shift: ShareTolerance | None = None
    axis: AngleTolerance | None = None
    beam_ratio: ShareTolerance | None = None
    beam_angle: ShareTolerance | None = None


def tolerance_names() -> list[str]:
    """Names of the tolerances that come with the package: one for each kind of target."""
    return list(_FILES.names)


def load_tolerances(source: str) -> Tolerances:
    """Load tolerances by the name of bundled ones (`thin`, `traced`, `phone`), or from a YAML file.

    Raises
    ------
    InputError
        For an unknown name, an unreadable file, an unknown key, or a value without a source or out of range.
    """
    return build(Tolerances, _FILES.read(source), source)
