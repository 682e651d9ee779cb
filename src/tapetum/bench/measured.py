"""What a calibration measured of a probe, as files that a scene names in place of the values.

`probe.sensor: my-sensor.yaml` takes the sensor that `tapetum calibrate probe` wrote, and `illumination.second_beam:
my-ghost.yaml` the beam of `tapetum calibrate ghost`. Paths start from the current folder, as those of lenses do.
"""

from __future__ import annotations

import os
from typing import Any

from tapetum.bench.plain_yaml import read_mapping
from tapetum.errors import InputError
from tapetum.files import read_text

__all__ = ["GHOST_SCHEMA", "SENSOR_SCHEMA", "beam_values", "read_measured", "sensor_values"]

SENSOR_SCHEMA = "tapetum/probe-sensor/1"
GHOST_SCHEMA = "tapetum/ghost/1"


def read_measured(path: str | os.PathLike[str], schema: str, command: str) -> dict[str, Any]:
    """Return what a file of a calibration holds; raise an InputError with the command that makes one otherwise."""
    return read_mapping(read_text(path, f"give a file that `tapetum {command}` wrote"), schema, str(path))


def _part(path: str, schema: str, command: str, key: str) -> dict[str, Any]:
    part = read_measured(path, schema, command).get(key)
    if not isinstance(part, dict):
        raise InputError(f"has no {key}", where=path, remedy=f"make it again by `tapetum {command}`")
    return part


def sensor_values(given: object) -> object:
    """Return a probe's sensor as its fields where a file is named; anything else as it is.

    Raises
    ------
    InputError
        When the file is missing or none of a calibrated sensor, or states no pixel pitch: no frame shows it.
    """
    if not isinstance(given, str):
        return given
    values = _part(given, SENSOR_SCHEMA, "calibrate probe", "sensor")
    if "pitch" not in values:
        remedy = "add 'pitch: 3.45 um' under 'sensor', as the camera's data sheet has it"
        raise InputError("states no pixel pitch", where=given, remedy=remedy)
    return values


def beam_values(given: object) -> object:
    """Return a second beam as its fields where a file is named; anything else as it is.

    Raises
    ------
    InputError
        When the file is missing or none of a calibrated ghost, or states no angle.
    """
    if not isinstance(given, str):
        return given
    return _part(given, GHOST_SCHEMA, "calibrate ghost --focal-length F --pitch P", "second_beam")
