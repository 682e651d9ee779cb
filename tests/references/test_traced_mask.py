"""A mask from a file behind a traced lens, as complex fields against the judge's plain sums over rays and mask."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tapetum.bench.load import scene_from_dict
from tapetum.simulate import Camera
from tapetum.simulate.faint import FaintPass
from tapetum.simulate.traced_plan import TracedGroup

from .judge import pixel_places, planes_of
from .thin import Beam, Effort
from .traced import traced_amplitudes
from .way import Probe

SECTION = "Traced lenses"
WAVELENGTH, PROBE_FOCAL, SIDE, ACCURACY = 640e-9, 0.1, 9, 3e-3
# Of SIDE² pixels, the middle one among them: each costs the judge a bundle of rays.
PIXELS = np.array([40, 22, 74])
# Finer sums change no field of these by more than 3e-4 of its peak.
JUDGE = Effort(1.0, 0.8)


def pattern(count: int = 24) -> np.ndarray:
    """Amplitudes and phases alike in no direction; the phase is steep enough to leave no bright mirror's return."""
    x, y = np.meshgrid(np.arange(count), np.arange(count))
    size = 0.55 + 0.3 * np.cos(0.5 * x + 0.3 * y + 1) + 0.1 * np.cos(0.9 * y)
    return size * np.exp(2.4j * np.sin(0.35 * y - 0.2 * x + 0.5))


@pytest.mark.parametrize(
    ("name", "f_number", "distance", "rotation"),
    [
        pytest.param("phone-d", 8.0, 2.0, (0.0, 0.0), marks=pytest.mark.slow),
        ("phone-d", 8.0, 2.0, (0.004, 0.011)),
        pytest.param("phone-d", 8.0, 0.15, (-0.013, 0.002), marks=pytest.mark.slow),
        pytest.param("compact-6mm-f1.9", 8.0, 2.0, (-0.009, 0.003), marks=pytest.mark.slow),
        ("compact-6mm-f1.9", 8.0, 0.4, (0.005, -0.006)),
    ],
)
def test_fields_against_plain_sums(
    name: str, f_number: float, distance: float, rotation: tuple[float, float], tmp_path: Path, validated: Any
) -> None:
    file = tmp_path / "mask.npy"
    np.save(file, pattern())
    angle = 4 * WAVELENGTH * f_number / 4e-3
    scene = scene_from_dict(
        {
            "schema": "tapetum/scene/1",
            "distance": 5.0,
            "illumination": {"mode": "collimated", "wavelength": WAVELENGTH, "power": 1e-3, "diameter": 0.02},
            "target": {
                "lens": {"kind": "prescription", "name": name, "f_number": f_number},
                "object_distance": distance,
                "rotation": list(rotation),
                "sensor": {
                    "reflectance": 0.3,
                    "pixels": [2000, 1500],
                    "pitch": 2.2e-6,
                    "mask": {"file": str(file), "pitch": WAVELENGTH * f_number},
                },
            },
            "probe": {
                "lens": {"focal_length": PROBE_FOCAL, "aperture_radius": 0.025},
                "sensor": {"pixels": [SIDE, SIDE], "pitch": 2 * PROBE_FOCAL * angle / SIDE},
            },
            "sampling": {"accuracy": ACCURACY},
        }
    )
    sines = torch.sin(torch.tensor([rotation], dtype=torch.float64))
    camera = Camera(scene, max(float(sines.norm()), 0.005), dtype=torch.complex128, device="cpu")
    (one,) = camera._lines[0].passes
    assert isinstance(one, FaintPass)
    assert isinstance(one._usual, TracedGroup)
    ours = one._usual.field(sines)[0].numpy().ravel()[PIXELS]
    pixels = pixel_places(PIXELS % SIDE, PIXELS // SIDE, (SIDE, SIDE), scene.probe.sensor.pitch)
    beam = Beam(WAVELENGTH, (float(sines[0, 0]), float(sines[0, 1])), 0.0, 0.01)
    (plane,) = planes_of(scene, WAVELENGTH)
    want = traced_amplitudes(scene, beam, plane, Probe(PROBE_FOCAL), pixels, JUDGE)
    # One common phase, that of the path through the lens, is counted from other places.
    turn = np.vdot(want, ours)
    error = float(np.abs(ours * abs(turn) / turn - want).max() / np.abs(want).max())
    what = f"field of a mask behind {name}, f/{f_number:g}, x_d = {distance:g} m, rotation {rotation} rad"
    validated(SECTION, what, error, ACCURACY, "the judge's sum over rays and mask, phase and all")
