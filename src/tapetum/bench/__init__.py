"""What stands on the bench, as frozen dataclasses read from YAML."""

from tapetum.bench.load import (
    field_path,
    load_scene,
    scene_dict,
    scene_from_dict,
    scene_names,
    scene_schema,
    scene_yaml,
    with_values,
)
from tapetum.bench.scene import (
    Illumination,
    Line,
    Probe,
    ProbeSensor,
    Sampling,
    Scene,
    SecondBeam,
    Target,
    TargetSensor,
    ThinLens,
)
from tapetum.bench.surfaces import Diffuse, Layer, Microlens, PixelArray, SensorMask, at_wavelength

__all__ = [
    "Diffuse",
    "Illumination",
    "Layer",
    "Line",
    "Microlens",
    "PixelArray",
    "Probe",
    "ProbeSensor",
    "Sampling",
    "Scene",
    "SecondBeam",
    "SensorMask",
    "Target",
    "TargetSensor",
    "ThinLens",
    "at_wavelength",
    "field_path",
    "load_scene",
    "scene_dict",
    "scene_from_dict",
    "scene_names",
    "scene_schema",
    "scene_yaml",
    "with_values",
]
