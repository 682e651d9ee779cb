"""Phones: several cameras on one back plate, each with its lens, its filter and its sensor, and a dot projector."""

from __future__ import annotations

import functools
import itertools
import math
from typing import Annotated

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.catalogue import Catalogue
from tapetum.bench.faults import build
from tapetum.bench.prescription import PrescriptionLens, check_layers
from tapetum.bench.quantity import Angle, Length, Power, Time
from tapetum.bench.sensors import TargetSensor
from tapetum.bench.strict import STRICT
from tapetum.bench.surfaces import SmallTilt

__all__ = ["PHONE_SCHEMA", "CameraUnit", "Dots", "Phone", "load_phone", "phone_names"]

PHONE_SCHEMA = "tapetum/phone/1"
_PHONES = Catalogue("phone", PHONE_SCHEMA, "phones")
Place = Annotated[Length, Field(gt=-0.1, lt=0.1)]
Wide = Annotated[Angle, Field(gt=0, lt=math.pi)]
# Two camera modules cannot stand nearer to each other, centre to centre, in metres.
_NEAREST = 4e-3


@dataclass(frozen=True, config=STRICT)
class CameraUnit:
    """One of a phone's cameras.

    Parameters
    ----------
    name, position
        Its purpose (`main`, `wide`, `tele`, `macro`), and where its optical axis is on the back plate, (x, y) in
        metres: x right and y down as the probe sees it.
    lens, sensor
        Its optics. The filter is the first of the sensor's layers.
    axis
        Where its lens looks against the plate's normal, as a rotation (x, y) in radians: modules are mounted askew.
    """

    name: str
    position: tuple[Place, Place]
    lens: PrescriptionLens
    sensor: TargetSensor
    axis: tuple[SmallTilt, SmallTilt] = (0.0, 0.0)

    @model_validator(mode="after")
    def _fits_together(self) -> CameraUnit:
        check_layers(self.lens, self.sensor.layers, math.inf)
        return self


@dataclass(frozen=True, config=STRICT)
class Dots:
    """A LiDAR's dot projector: pulses of light in a grid of narrow beams.

    Parameters
    ----------
    position, wavelength
        On the back plate, as a camera's; in metres.
    power, period, pulse
        Of all beams together while a pulse lasts, in watts; from one pulse to the next, and how long one lasts, in
        seconds.
    columns, rows, field, tilt
        Of the grid, the full angles that it spans, and that of its rows against the plate's x, in radians.
    """

    position: tuple[Place, Place]
    power: Power
    period: Time
    pulse: Time
    columns: Annotated[int, Field(ge=1, le=1000)]
    rows: Annotated[int, Field(ge=1, le=1000)]
    field: tuple[Wide, Wide]
    wavelength: Annotated[Length, Field(ge=200e-9, le=2e-6)] = 940e-9
    tilt: Angle = 0.0

    @model_validator(mode="after")
    def _pulses_end(self) -> Dots:
        if self.pulse > self.period:
            raise ValueError(f"a pulse of {self.pulse:g} s outlasts the period of {self.period:g} s; shorten it")
        return self


@dataclass(frozen=True, config=STRICT)
class Phone:
    """A model of phone as a probe meets it: its back.

    Parameters
    ----------
    name, assumed
        A neutral one; what no source says, and what kind of source the rest has.
    cameras, dots
        One to six, whose positions count from wherever their file says; and the dot projector, if there is one.
    """

    name: str
    cameras: Annotated[tuple[CameraUnit, ...], Field(min_length=1, max_length=6)]
    dots: Dots | None = None
    assumed: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _has_room(self) -> Phone:
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names):
            raise ValueError(f"two cameras share a name, {', '.join(names)}; give each its own")
        for one, other in itertools.combinations(self.cameras, 2):
            apart = math.dist(one.position, other.position)
            if apart < _NEAREST:
                raise ValueError(f"{one.name} and {other.name} are {apart:g} m apart; place them 4 mm apart or more")
        return self


def phone_names() -> list[str]:
    """Names of the phones that come with the package."""
    return list(_PHONES.names)


def load_phone(source: str) -> Phone:
    """A phone by its name in the catalogue, or from a YAML file.

    Raises
    ------
    InputError
        For an unknown name (with the nearest ones), a file that cannot be read, and a phone that cannot be: with the
        field's path and the remedy.
    """
    return _bundled(source) if source in _PHONES.names else build(Phone, _PHONES.read(source), source)


@functools.cache
def _bundled(name: str) -> Phone:
    return build(Phone, _PHONES.read(name), name)
