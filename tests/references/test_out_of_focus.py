"""Traced lenses far out of focus: what their rims send to the middle of a picture head on."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from tapetum.bench import PrescriptionLens
from tapetum.bench.load import scene_from_dict
from tapetum.simulate import Camera

from .radial import middle, of_engine
from .rays import focused
from .test_traced_judge import PROBE, SECTION, WAVELENGTH

# Lens, its focal length, f-number and object distance in metres, and accuracy: 8 to 28 Fresnel zones of defocus.
_CASES = [
    ("cmount-12mm-f1.4", 3.8e-3, 2.8, 0.09, 0.03),
    # Its rim is sharp 2.5 mm behind the paraxial entrance pupil.
    ("zoom-18-140mm", 135e-3, 8.0, 4.0, 0.03),
    pytest.param("cmount-12mm-f1.4", 3.8e-3, 2.8, 0.045, 0.03, marks=pytest.mark.slow),
    pytest.param("phone-f", 4.5e-3, 2.8, 0.126, 0.03, marks=pytest.mark.slow),
    pytest.param("compact-6mm-f1.9", 6e-3, 2.8, 0.224, 0.03, marks=pytest.mark.slow),
    pytest.param("zoom-18-140mm", 85e-3, 6.3, 3.0, 0.03, marks=pytest.mark.slow),
    pytest.param("cmount-12mm-f1.4", 3.8e-3, 2.8, 0.09, 0.01, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("name", "focal_length", "f_number", "distance", "accuracy"), _CASES)
def test_the_rim_s_light_far_out_of_focus(
    name: str, focal_length: float, f_number: float, distance: float, accuracy: float, validated: Any
) -> None:
    """When the chief ray's C was that of the rim's light, pictures were off by up to 1.9 times what was stated."""
    lens: dict[str, object] = {"kind": "prescription", "name": name, "focal_length": focal_length}
    lens |= {"f_number": f_number, "design_wavelength": WAVELENGTH}
    if not name.startswith("zoom"):
        lens["focus"] = "unit"
    radius = focal_length / (2 * f_number)
    widest = 2.4 * radius / distance + 5 * WAVELENGTH / (2 * radius)
    light = {"mode": "collimated", "wavelength": WAVELENGTH, "power": 1e-3, "diameter": 4 * focal_length}
    sensor = {"reflectance": 0.3, "pixels": [2000, 1500], "pitch": 2.2e-6}
    scene = scene_from_dict(
        {
            "schema": "tapetum/scene/1",
            "distance": 2.0,
            "illumination": light,
            "target": {"lens": lens, "object_distance": distance, "sensor": sensor},
            "probe": {
                "lens": {"focal_length": PROBE, "aperture_radius": 0.01},
                "sensor": {"pixels": [33, 33], "pitch": 2 * PROBE * widest / 33},
            },
            "sampling": {"accuracy": accuracy, "propagation": "far field"},
        }
    )
    own = scene.target.lens
    assert isinstance(own, PrescriptionLens)
    camera = Camera(scene, 0.0)
    picture = camera(torch.zeros(1, 2, dtype=torch.float64))[0]
    given = of_engine(own.focused(WAVELENGTH, distance))
    if lens.get("focus"):
        given = focused(own, WAVELENGTH, distance)
    share = 0.3 * scene.probe.transmission * 1e-3 / (math.pi * (2 * focal_length) ** 2)
    error = abs(float(picture[16, 16]) - share * middle(given, WAVELENGTH, PROBE)) / float(picture.max())
    what = f"middle of a picture head on, {name} at {1e3 * focal_length:g} mm f/{f_number:g}, x_d = {distance:g} m"
    what += f", {accuracy:g} of the peak"
    validated(SECTION, what, error / camera.plan.expected_error, 1.0, "rings of rays, by the judge",
              "of the stated error")  # fmt: skip
