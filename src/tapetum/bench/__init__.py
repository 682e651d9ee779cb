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
    Probe,
    ProbeSensor,
    Sampling,
    Scene,
    SecondBeam,
    Target,
    TargetSensor,
    ThinLens,
)

__all__ = [
    "Illumination",
    "Probe",
    "ProbeSensor",
    "Sampling",
    "Scene",
    "SecondBeam",
    "Target",
    "TargetSensor",
    "ThinLens",
    "field_path",
    "load_scene",
    "scene_dict",
    "scene_from_dict",
    "scene_names",
    "scene_schema",
    "scene_yaml",
    "with_values",
]
