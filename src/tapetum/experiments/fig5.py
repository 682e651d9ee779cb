"""Fig. 5: a head-on retro-reflection in diverging light, against the distance."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tapetum.bench import Scene, load_scene, with_values
from tapetum.experiments.measure import PowerLaw, holding_diameter, power_law
from tapetum.progress import Progress, quiet
from tapetum.simulate import Image, retroreflect
from tapetum.simulate.exposure import count_moments, digitise, gain_of
from tapetum.simulate.radiometry import beam_radius, dark_electrons, photoelectrons

__all__ = ["DISTANCES", "LENS", "LIGHT", "STRIPS", "Fig5", "Strip", "simulate_fig5"]

DISTANCES = tuple(0.5 * n for n in range(1, 11))
# In place of the paper's Fujinon DV3.4x3.8SA-1, at its widest: f = 3.8 mm, f/1.4.
LENS = {"kind": "thin", "focal_length": 3.8e-3, "aperture_radius": 3.8e-3 / 1.4 / 2}
LIGHT = {"mode": "diverging", "divergence": math.radians(0.5), "wavelength": 640e-9, "power": 1e-3}
# Name, object distance (None: the probe's own), and vergence of the light in place of 1/d.
STRIPS: tuple[tuple[str, float | None, float | None], ...] = (
    ("focused on the probe", None, None),
    ("focus left at 5 m", 5.0, None),
    ("focus left at 5 m, flat wave", 5.0, 0.0),
)
# 680 of the bench's pixels.
_WINDOW = 680 * 2.2e-6
_SHARE, _FILL, _SIGMAS, _FRAMES = 0.8, 0.8, 5.0, 4
# Background and offset of a dim room's frame: assumed. Full well, read noise and bits: the bench's, see ProbeSensor.
_SENSOR = {"bits": 12, "background": 10.0, "offset": 64.0}

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Strip:
    """One way of focusing and illuminating the target, over N distances.

    `frames` are [N, H, W] mean frames without the dark level, in electrons, all with the same `exposure` (seconds);
    `fill` is the largest expected charge of a pixel over the full well, `floor` the noise floor above the dark level.
    `signal` and `total` are [N] the sum of the pixels above the floor and all light in the window, in electrons;
    `diameter` [N] that of the circle with 80 % of the light, in metres. `measured` and `without_floor` are the power
    laws of signal and total.
    """

    name: str
    frames: Array
    exposure: float
    fill: float
    floor: float
    signal: Array
    total: Array
    diameter: Array
    measured: PowerLaw
    without_floor: PowerLaw


@dataclass(frozen=True)
class Fig5:
    """All strips; `window` is an image's width and `beam_area` [N] the illuminated disc's area, in metres and m²."""

    distances: tuple[float, ...]
    strips: list[Strip]
    window: float
    beam_area: Array
    expected_error: float

    def numbers(self) -> dict[str, Any]:
        """What fig5.json holds."""
        return {
            "distances_m": list(self.distances),
            "beam_area_m2": self.beam_area.tolist(),
            "divergence_full_angle_deg": math.degrees(LIGHT["divergence"]),  # type: ignore[arg-type]
            "power_w": LIGHT["power"],
            "share_of_light": _SHARE,
            "frames_averaged": _FRAMES,
            "floor_in_standard_deviations": _SIGMAS,
            "expected_error": self.expected_error,
            "strips": [
                {
                    "name": strip.name,
                    "exposure_s": strip.exposure,
                    "largest_charge_over_full_well": strip.fill,
                    "noise_floor_electrons": strip.floor,
                    "sum_above_floor_electrons": strip.signal.tolist(),
                    "all_light_electrons": strip.total.tolist(),
                    "diameter_mm": (1e3 * strip.diameter).tolist(),
                    "fit_above_floor": asdict(strip.measured),
                    "fit_all_light": asdict(strip.without_floor),
                }
                for strip in self.strips
            ],
        }


def simulate_fig5(
    *,
    distances: tuple[float, ...] = DISTANCES,
    pixels: int = 680,
    accuracy: float = 1e-3,
    seed: int = 1,
    progress: Progress = quiet,
) -> Fig5:
    """Simulate and measure the paper's section 4.2 at three or more distances from probe to target, in metres.

    Frames have `pixels` a side over a window of 1.5 mm: 680 give the bench's pixels of 2.2 µm. The planner's `accuracy`
    is in fractions of the peak; `seed` is that of the noise.
    """
    jobs = [(strip, d) for strip in range(len(STRIPS)) for d in distances]
    light: list[Image] = []
    scenes: list[Scene] = []
    for strip, d in progress(jobs, "fig5", total=len(jobs)):
        _, x_d, vergence = STRIPS[strip]
        illumination = LIGHT if vergence is None else {**LIGHT, "vergence": vergence}
        scene = with_values(
            load_scene("thin-lens"),
            {
                "distance": d,
                "illumination": illumination,
                "target.lens": LENS,
                "target.object_distance": d if x_d is None else x_d,
                "probe.sensor": {"pixels": [pixels, pixels], "pitch": _WINDOW / pixels, **_SENSOR},
                "sampling.accuracy": accuracy,
            },
        )
        scenes.append(scene)
        light.append(retroreflect(scene))
    count, rng = len(distances), np.random.default_rng(seed)
    strips: list[Strip] = []
    for index, (name, _, _) in enumerate(STRIPS):
        part = slice(index * count, (index + 1) * count)
        strips.append(_expose(name, torch.cat([one.light for one in light[part]]), scenes[part], rng))
    area = np.array([math.pi * beam_radius(scene) ** 2 for scene in scenes[:count]])
    return Fig5(distances, strips, _WINDOW, area, max(one.metadata["expected_error"] for one in light))


def _expose(name: str, light: torch.Tensor, scenes: list[Scene], rng: np.random.Generator) -> Strip:
    """Choose one exposure for all distances, film, and measure."""
    sensor, wavelength = scenes[0].probe.sensor, scenes[0].illumination.wavelength
    distances = [scene.distance for scene in scenes]
    per_second = photoelectrons(light, sensor, wavelength).double() / sensor.exposure
    exposure = (_FILL * sensor.full_well - sensor.background) / float(per_second.max())
    charge = per_second * exposure
    dark = dark_electrons(sensor)
    level, variance = count_moments(torch.tensor(dark, dtype=torch.float64), sensor)
    gain = gain_of(sensor)
    mean = charge + dark
    frames = np.zeros(tuple(mean.shape))
    for _ in range(_FRAMES):
        frames += digitise(mean, sensor, rng) / _FRAMES
    clean = (frames - float(level)) / gain
    floor = _SIGMAS * math.sqrt(float(variance) / _FRAMES) / gain
    signal = np.where(clean > floor, clean, 0.0).sum(axis=(1, 2))
    total = charge.sum(dim=(1, 2)).numpy()
    diameter = np.array([holding_diameter(one.numpy(), sensor.pitch, _SHARE) for one in charge])
    return Strip(
        name=name,
        frames=clean,
        exposure=exposure,
        fill=float(mean.max()) / sensor.full_well,
        floor=floor,
        signal=signal,
        total=total,
        diameter=diameter,
        measured=power_law(distances, signal),
        without_floor=power_law(distances, total),
    )
