"""Scattered light behind a traced lens: as much out of focus at each wavelength as the lens itself."""

from __future__ import annotations

import math

import pytest
import torch

from tapetum.bench import PrescriptionLens, load_scene, with_values
from tapetum.simulate import Camera
from tapetum.simulate.traced_bundle import trace_bundle
from tapetum.simulate.traced_lens import TracedLens


@pytest.mark.parametrize(("name", "wavelength"), [("la1509", 450e-9), ("la1509", 785e-9), ("photo-50mm-f1.8", 785e-9)])
def test_a_thin_lens_as_much_out_of_focus_blurs_as_rays_do(name: str, wavelength: float) -> None:
    """Rays of a far point: their landing places grow with their directions by the defocus."""
    number = 16.0
    lens = PrescriptionLens(name, f_number=number, design_wavelength=587.56e-9)
    scene = with_values(
        load_scene("thin-lens"),
        {
            "target.lens": {"kind": "prescription", "name": name, "f_number": number},
            "target.object_distance": 1e6,
            "illumination.wavelength": wavelength,
            "illumination.diameter": 0.1,
        },
    )
    f = TracedLens(scene, 1e6, 0.01).thin_focal_length(wavelength)
    z = lens.focal_length
    rays = trace_bundle(lens.focused(wavelength, 1e6), torch.zeros(1, dtype=torch.float64), count=21)
    some = rays.passing[0]
    heights = rays.e[0, some].norm(dim=1)
    # A thin lens of focal length f sends a ray at x to x (1 - z/f) on a sensor at z.
    slope = float((rays.landing[0, some] * rays.e[0, some]).sum() / (heights**2).sum())
    assert 1 - z / f == pytest.approx(slope, rel=0.05, abs=2e-5)


def test_the_scattered_picture_spreads_with_the_colour() -> None:
    """In focus at the design wavelength it is a spot; at 785 nm the prescription's defocus widens it."""
    scene = with_values(
        load_scene("thin-lens"),
        {
            "target.lens": {"kind": "prescription", "name": "la1509", "f_number": 16, "design_wavelength": "640 nm"},
            "target.sensor": {"reflectance": 0.0, "diffuse": {"albedo": 0.5, "spread": 0.0}},
            "target.object_distance": 1e6,
            "illumination.diameter": 0.1,
            "probe.sensor.pixels": [64, 64],
        },
    )
    tilt = torch.zeros(1, 2, dtype=torch.float64)
    peaks = [
        float(Camera(with_values(scene, {"illumination.wavelength": one}), 0.01)(tilt).max()) * one**2
        for one in (640e-9, 785e-9)
    ]
    # 3 mm wide light comes to a focus 0.73 mm farther: 0.03 mm wide on the sensor, against 12 um of diffraction.
    assert peaks[1] < 0.6 * peaks[0] and all(math.isfinite(one) for one in peaks)
