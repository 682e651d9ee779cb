"""Measure which frames the bundled model answers, and how well where the camera looks nearly straight at the probe.

    .venv/bin/python scripts/measure_domain.py SEED

Frames of the virtual bench at gazes drawn over the field's middle (0.35 of the field to each side), first of the
model's own scene, then with one value changed; further copies of the camera; and its own camera within rings about the
axis. The numbers go to docs/numbers/domain.json, or -o.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from tapetum.bench import Scene, draw_unit, load_scene, with_values
from tapetum.data import crop, find_centre
from tapetum.experiments.pretrain import CROP, NAME, SCENE
from tapetum.files import atomic_file
from tapetum.models import Prediction, pretrained
from tapetum.record.shot import probe_frames

Array = npt.NDArray[np.float64]
FRAMES, REACH = 60, 0.35
CHANGES: dict[str, dict[str, str | float | list[str]]] = {
    "its own camera": {},
    "2.5 m away and focused there": {"distance": "2.5 m", "target.object_distance": "2.5 m"},
    "4 m": {"distance": "4 m", "target.object_distance": "4 m"},
    "6.5 m": {"distance": "6.5 m", "target.object_distance": "6.5 m"},
    "8 m": {"distance": "8 m", "target.object_distance": "8 m"},
    "focused at 3 m": {"target.object_distance": "3 m"},
    "focused at 4.5 m": {"target.object_distance": "4.5 m"},
    "focused at 5 m": {"target.object_distance": "5 m"},
    "focused at 8 m": {"target.object_distance": "8 m"},
    "aperture radius 2 mm for 4": {"target.lens.aperture_radius": "2 mm"},
    "3 mm": {"target.lens.aperture_radius": "3 mm"},
    "3.6 mm": {"target.lens.aperture_radius": "3.6 mm"},
    "5 mm": {"target.lens.aperture_radius": "5 mm"},
    "second beam 5 % for 10 %": {"illumination.second_beam.ratio": 0.05},
    "sensor tilted by 0.3°, −0.2°": {"target.sensor.tilt": ["0.3 deg", "-0.2 deg"]},
    "decentred by 0.1, −0.08 mm": {"target.sensor.decentre": ["0.1 mm", "-0.08 mm"]},
}
COPIES = 20
RINGS = ((0.0, 0.02), (0.02, 0.04), (0.04, 0.06), (0.06, 0.08), (0.08, 0.12), (0.2, 0.3), (0.4, 0.48))


def seen(scene: Scene, gaze: Array, seed: int) -> Prediction:
    """What the model says of frames at gazes [N, 2], refused ones too."""
    frames = probe_frames(scene, gaze, np.zeros_like(gaze), seed)
    crops = np.stack([crop(frame, find_centre(frame), CROP) for frame in frames])
    return pretrained(NAME).predict(crops, anyway=True, unit="own")


def told(found: Prediction, gaze: Array) -> dict[str, Any]:
    """Share of frames that are answered, MAE [2] of all, and what the narrow 90 % intervals hold [2]."""
    held = (found.lower <= gaze) & (gaze <= found.upper)
    mae = np.abs(found.value - gaze).mean(0)
    return {"answered": float(found.applies.mean()), "mae": mae.tolist(), "held": held.mean(0).tolist()}


def measured(seed: int) -> dict[str, Any]:
    """Return the numbers, and print each when it is there."""
    own, rng = load_scene(SCENE), np.random.default_rng(seed)
    changes: list[dict[str, Any]] = []
    for name, values in CHANGES.items():
        gaze = rng.uniform(-REACH, REACH, (FRAMES, 2))
        changes.append({"changed": name, **told(seen(with_values(own, values), gaze, seed), gaze)})
        print(json.dumps(changes[-1]), flush=True)
    copies = [
        float(
            seen(
                draw_unit(own, None, seed * 1000 + k), rng.uniform(-REACH, REACH, (FRAMES // 3, 2)), seed
            ).applies.mean()
        )
        for k in range(COPIES)
    ]
    print(json.dumps(copies), flush=True)
    rings: list[dict[str, Any]] = []
    for low, high in RINGS:
        angle, radius = rng.uniform(0, 2 * math.pi, FRAMES), np.sqrt(rng.uniform(low**2, high**2, FRAMES))
        gaze = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
        rings.append({"from": low, "to": high, **told(seen(own, gaze, seed), gaze)})
        print(json.dumps(rings[-1]), flush=True)
    return {"seed": seed, "frames": FRAMES, "changes": changes, "answered_of_copies": copies, "rings": rings}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seed", type=int, help="of all gazes, copies and noise; 9103 to 9105 have been drawn")
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/numbers/domain.json"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    found = measured(given.seed)
    with atomic_file(given.out) as part:
        part.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
