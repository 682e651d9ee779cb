"""Scenes, lenses, sensors and phones, as frozen dataclasses read from YAML."""

from tapetum.bench.copies import draw_unit
from tapetum.bench.layers import Diffuse, Layer, Microlens, PixelArray, SensorMask, at_wavelength
from tapetum.bench.load import (
    as_scene,
    field_path,
    load_scene,
    scene_dict,
    scene_from_dict,
    scene_names,
    scene_schema,
    scene_yaml,
    with_values,
)
from tapetum.bench.phone import CameraUnit, Dots, Phone, load_phone, phone_names
from tapetum.bench.prescription import PrescriptionLens, lens_names, load_lens
from tapetum.bench.scene import (
    Illumination,
    Line,
    PhoneTarget,
    Probe,
    ProbeSensor,
    Sampling,
    Scene,
    SecondBeam,
    Target,
    TargetSensor,
    ThinLens,
    outside_of_model,
)
from tapetum.bench.tolerances import Tolerances, load_tolerances, tolerance_names

__all__ = [
    "CameraUnit",
    "Diffuse",
    "Dots",
    "Illumination",
    "Layer",
    "Line",
    "Microlens",
    "Phone",
    "PhoneTarget",
    "PixelArray",
    "PrescriptionLens",
    "Probe",
    "ProbeSensor",
    "Sampling",
    "Scene",
    "SecondBeam",
    "SensorMask",
    "Target",
    "TargetSensor",
    "ThinLens",
    "Tolerances",
    "as_scene",
    "at_wavelength",
    "draw_unit",
    "field_path",
    "lens_names",
    "load_lens",
    "load_phone",
    "load_scene",
    "load_tolerances",
    "outside_of_model",
    "phone_names",
    "scene_dict",
    "scene_from_dict",
    "scene_names",
    "scene_schema",
    "scene_yaml",
    "tolerance_names",
    "with_values",
]
