"""Measure which frames the bundled model answers, and how well where the camera looks nearly straight at the probe.

    .venv/bin/python scripts/measure_domain.py SEED

Frames of the virtual bench at gazes drawn over the field's middle (0.35 of the field to each side), first of the
model's own scene, then with one value changed; further copies of the camera; and its own camera within rings about the
axis.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
import numpy.typing as npt
import torch

from tapetum.bench import Scene, draw_unit, load_scene, with_values
from tapetum.data import crop, find_centre
from tapetum.experiments.pretrain import CROP, NAME, SCENE
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


def main(seed: int) -> None:
    """Print both tables."""
    own, rng = load_scene(SCENE), np.random.default_rng(seed)
    print("| one thing changed | answered |\n|---|--:|")
    for name, values in CHANGES.items():
        found = seen(with_values(own, values), rng.uniform(-REACH, REACH, (FRAMES, 2)), seed)
        print(f"| {name} | {found.applies.mean():.0%} |", flush=True)
    shares = [
        seen(draw_unit(own, None, seed * 1000 + k), rng.uniform(-REACH, REACH, (FRAMES // 3, 2)), seed).applies.mean()
        for k in range(COPIES)
    ]
    print(f"| {COPIES} further copies | {np.mean(shares):.0%} ({min(shares):.0%} to {max(shares):.0%}) |")
    print("\n| gaze from the axis, of the field | answered | MAE x / y | 90 % intervals hold, x / y |")
    print("|---|--:|---|---|")
    for low, high in RINGS:
        angle, radius = rng.uniform(0, 2 * math.pi, FRAMES), np.sqrt(rng.uniform(low**2, high**2, FRAMES))
        gaze = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
        found = seen(own, gaze, seed)
        error, half = np.abs(found.value - gaze), (found.upper - found.lower) / 2
        (x, y), held = error.mean(0), (error <= half).mean(0)
        print(f"| {low} to {high} | {found.applies.mean():.0%} | {x:.4f} / {y:.4f} | {held[0]:.0%} / {held[1]:.0%} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seed", type=int)
    torch.set_num_threads(1)
    main(parser.parse_args().seed)
