"""The specular spot of a phone whose camera app opens."""

from __future__ import annotations

import torch

from tapetum.bench import load_scene, scene_from_dict, with_values
from tapetum.bench.load import scene_dict
from tapetum.optics.grid import Grid
from tapetum.simulate.phone import PhoneCamera


def test_the_flash_of_a_phone_that_opens_its_camera() -> None:
    """A sensor answers while it images; what its filter returns is the same light bit for bit."""
    short = {"wavelength": 640e-9, "coherence_length": 1e-4, "second_beam": None}
    content = scene_dict(load_scene("phones"))
    content["illumination"] |= short
    scenes = [with_values(scene_from_dict(content), {"target.imaging": imaging}) for imaging in (True, False)]
    sines, output = torch.zeros(1, 2, dtype=torch.float64), Grid(31, 31, 4 * 2.2e-6)
    cameras = [PhoneCamera(scene, 1e-3, output=output, accuracy=0.3) for scene in scenes]
    (_, _), (opened, closed) = cameras, (camera.units[0][0]._lines[0] for camera in cameras)
    # Planes come by their distance, the sensor first: only while its camera images.
    assert (len(opened.passes), len(closed.passes)) == (2, 1)
    assert torch.equal(opened.passes[1](sines, None), closed.passes[0](sines, None))
    assert opened.scatterers == closed.scatterers
    with_spot, without = (camera(sines)[0].double() for camera in cameras)
    flash = with_spot - without
    assert float(flash.max()) > 3 * float(without.max()) and float(flash.min()) > -1e-6 * float(flash.max())
