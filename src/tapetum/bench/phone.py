"""Phones: several cameras with lens, filter and sensor on one back plate, and a dot projector."""

from __future__ import annotations

import functools
import itertools
import math
from typing import Annotated

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.catalogue import Catalogue
from tapetum.bench.faults import build
from tapetum.bench.layers import SmallTilt
from tapetum.bench.prescription import PrescriptionLens, check_layers
from tapetum.bench.quantity import Angle, Length, Power, Time
from tapetum.bench.sensors import TargetSensor
from tapetum.bench.strict import STRICT

__all__ = ["PHONE_SCHEMA", "CameraUnit", "Dots", "Phone", "load_phone", "phone_names"]

PHONE_SCHEMA = "tapetum/phone/1"
_PHONES = Catalogue("phone", PHONE_SCHEMA, "phones")
Place = Annotated[Length, Field(gt=-0.1, lt=0.1)]
Wide = Annotated[Angle, Field(gt=0, lt=math.pi)]
# Smallest distance of two camera modules, centre to centre, in metres.
_NEAREST = 4e-3


@dataclass(frozen=True, config=STRICT)
class CameraUnit:
    """One of a phone's cameras.

    Parameters
    ----------
    name, position
        Its purpose (`main`, `wide`, `tele`, `macro`), and the place of its optical axis on the back plate, (x, y) in
        metres: x right and y down as the probe sees it.
    lens, sensor
        Its optics. The filter is the first of the sensor's layers.
    axis
        Misalignment of its optical axis from the plate's normal, as a rotation (x, y) in radians.
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
        Power of all beams together during a pulse, in watts; repetition period and pulse duration, in seconds.
    columns, rows, field, tilt
        Of the grid, the full angles that it spans, and the angle of its rows to the plate's x axis, in radians.
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
    """The back of a phone model, as seen by a probe.

    Parameters
    ----------
    name, assumed
        A neutral name; the values that no source states, and the kind of source of the others.
    cameras, dots
        One to six cameras, positions from an origin of the file's choice; and the dot projector, if there is one.
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
    """Load a phone by its name in the catalogue, or from a YAML file.

    Raises
    ------
    InputError
        For an unknown name (with the nearest ones), an unreadable file, or an impossible phone: with the field's path
        and the remedy.
    """
    return _bundled(source) if source in _PHONES.names else build(Phone, _PHONES.read(source), source)


@functools.cache
def _bundled(name: str) -> Phone:
    return build(Phone, _PHONES.read(name), name)
