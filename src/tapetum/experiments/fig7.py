"""Fig. 7: samples of the Rotation and the Focusing set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label

from tapetum.bench import Scene, load_scene, with_values
from tapetum.data.crop import crop, find_centre
from tapetum.data.synth.plan import FOCUSING_SAMPLING
from tapetum.errors import InputError
from tapetum.experiments.measure import holding_diameter, mirror_error, widths
from tapetum.progress import Progress, quiet
from tapetum.simulate import Image, expose
from tapetum.simulate.gaze import largest_sine, tilt_of_gaze
from tapetum.simulate.phone import open_camera

__all__ = ["DISTANCES", "FOCAL_LENGTHS", "GAZES", "SIDE", "Fig7", "Sample", "sample", "simulate_fig7"]

# The target rotates upwards, so the probe moves down in its image. In fractions of the field.
_FEW_GAZES, _FEW_DISTANCES = (0.0, 0.16, 0.32, 0.46), (3.0, 4.0, 5.5)
GAZES = {"paper": (0.0, 0.08, 0.16, 0.24, 0.32, 0.40, 0.46), "laptop": _FEW_GAZES, "small": _FEW_GAZES}
DISTANCES = {"paper": (3.0, 3.5, 4.0, 4.5, 5.0, 5.5), "laptop": _FEW_DISTANCES, "small": _FEW_DISTANCES}
FOCAL_LENGTHS = (0.135, 0.085, 0.050)
# Object distance of the row of focal lengths, and the gaze of both rows.
AT, GAZE = 5.5, 0.03
# Prepare the lens for gazes up to here, as for a video: fits over a tiny tilt range miss its pupil's edge.
_UP_TO = 0.2
SIDE = 400
_SHARE = 0.8
# Each connected part above half the peak counts as a spot, after smoothing over so many pixels.
_SMOOTH = 1.5

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sample:
    """One image of a set: a crop of a camera frame and its measurements.

    `counts` are [400, 400] digital numbers, black where the target cannot be simulated for the reason in `refused`.
    `row` holds the measurements of the light, lengths in micrometres on the probe's sensor; `name` is what changes
    along its row.
    """

    name: str
    counts: NDArray[np.uint8 | np.uint16]
    row: dict[str, Any]
    refused: str = ""


@dataclass(frozen=True)
class Fig7:
    """The three rows of samples."""

    rotation: list[Sample]
    focusing: list[Sample]
    focal_lengths: list[Sample]
    full_scale: int
    pitch: float

    def rows(self) -> list[tuple[str, list[Sample]]]:
        """Each row with its letter."""
        return [("a", self.rotation), ("b", self.focusing), ("c", self.focal_lengths)]

    def numbers(self) -> dict[str, Any]:
        """What fig7.json holds."""
        return {
            "share_of_light": _SHARE,
            "pixels": SIDE,
            "full_scale": self.full_scale,
            "gaze": GAZE,
            "object_distance_m": AT,
            **{
                letter: [{"name": one.name, "refused": one.refused or None, **one.row} for one in samples]
                for letter, samples in self.rows()
            },
        }


def simulate_fig7(*, size: str = "paper", seed: int = 1, progress: Progress = quiet) -> Fig7:
    """Take the samples of the paper's section 4.4: size `paper`, or `laptop` or `small` for fewer."""
    # Sampled as the set, whose longest lens decides.
    rotation, focusing = load_scene("rotation"), load_scene("focusing", FOCUSING_SAMPLING)
    cases = [("a", f"{gaze:g}", rotation, (0.0, gaze)) for gaze in GAZES[size]]
    for letter, focal_length, x_d, name in (
        *(("b", FOCAL_LENGTHS[0], x_d, f"{x_d:g} m") for x_d in DISTANCES[size]),
        *(("c", focal_length, AT, f"{1e3 * focal_length:g} mm") for focal_length in FOCAL_LENGTHS),
    ):
        values = {"target.lens.focal_length": focal_length, "target.object_distance": x_d}
        cases.append((letter, name, with_values(focusing, values), (0.0, GAZE)))
    found: dict[str, list[Sample]] = {"a": [], "b": [], "c": []}
    kept: dict[str, Sample] = {}
    for number, (letter, name, scene, gaze) in enumerate(progress(cases, "fig7", total=len(cases))):
        # One row's farthest focus is the same image as the next row's longest lens.
        key = f"{scene.target!r} {gaze}"
        if key not in kept:
            kept[key] = sample(name, scene, gaze, seed=seed + number)
        found[letter].append(Sample(name, kept[key].counts, kept[key].row, kept[key].refused))
    sensor = rotation.probe.sensor
    return Fig7(found["a"], found["b"], found["c"], 2**sensor.bits - 1, sensor.pitch)


def sample(name: str, scene: Scene, gaze: tuple[float, float], *, seed: int) -> Sample:
    """Take one frame of a scene at a gaze, and cut it out as a dataset does; measure the light in the crop."""
    sines, farthest = tilt_of_gaze(scene, torch.tensor([gaze, (0.0, _UP_TO)], dtype=torch.float64))[:, None]
    try:
        camera = open_camera(scene, max(largest_sine(sines), largest_sine(farthest)))
        light = camera(sines)
    except InputError as error:
        return Sample(name, np.zeros((SIDE, SIDE), np.uint8), {}, str(error))
    taken = expose(
        Image(light, scene.probe.sensor.pitch, {"wavelength": scene.illumination.wavelength}), scene.probe, seed
    )
    claimed = camera.metadata()["expected_error"]
    counts, row = measured(taken[0], light[0].double().cpu().numpy(), scene)
    return Sample(
        name, counts, {"tilt_deg": float(np.degrees(np.arcsin(largest_sine(sines)))), **row, "error": claimed}
    )


def measured(frame: NDArray[Any], light: Array, scene: Scene) -> tuple[NDArray[Any], dict[str, Any]]:
    """A frame's crop about its brightest place, and sizes, symmetry and spots of the light in it."""
    sensor, centre = scene.probe.sensor, find_centre(frame)
    counts, clean = crop(frame, centre, SIDE), np.asarray(crop(light, centre, SIDE), np.float64)
    wide, tall = widths(clean, sensor.pitch, _SHARE)
    smooth = gaussian_filter(clean, _SMOOTH)
    marked: Any = label(smooth > smooth.max() / 2)
    top = 2**sensor.bits - 1
    return counts, {
        "diameter_um": 1e6 * holding_diameter(clean, sensor.pitch, _SHARE),
        "width_x_um": 1e6 * wide,
        "width_y_um": 1e6 * tall,
        "mirror_left_right": mirror_error(clean, 1),
        "mirror_up_down": mirror_error(clean, 0),
        "spots_above_half": int(marked[1]),
        "peak_over_full_scale": float(counts.max() / top),
        "saturated_pixels": int((counts == top).sum()),
    }
