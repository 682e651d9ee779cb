"""How time and memory grow with the aperture (the Fresnel number) and with the batch; draws docs/images/growth.png."""

from __future__ import annotations

import math
from pathlib import Path

import torch

import tapetum as tp

from .measure import Contender, Effort, Figure, Row, in_turns
from .retroreflection import LARGE_SENSOR

TITLE = "Growth with aperture and batch: f = 100 mm, x_d = 1 m, 256 × 256 pixels, far field, error ≤ 0.001"
PEERS: tuple[str, ...] = ()
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "growth.png"

_RADII = (0.5e-3, 1e-3, 2e-3, 3e-3, 5e-3, 8e-3, 12.7e-3)
_BATCHES = (1, 4, 16, 64, 256)


def run(effort: Effort) -> list[Row]:
    """One cold image for each aperture, and batches at r = 3 mm; without `--quick` the picture as well."""
    rows: list[Row] = []
    apertures: list[tuple[float, float, float]] = []
    for radius in _RADII[: effort.of(len(_RADII), 2)]:
        scene = _scene(radius)
        contender = Contender(lambda scene=scene: tp.retroreflect(scene, device="cpu"))
        timings = in_turns({"ours": contender}, effort.of(3, 1))
        fresnel = radius**2 / (scene.illumination.wavelength * 2 * _image_distance(scene))
        seconds, memory = timings.typical("ours"), _memory(scene)
        apertures.append((fresnel, seconds, memory))
        note = f"Fresnel number r²/2λz = {fresnel:.0f}; {memory / 2**20:.0f} MiB planned"
        rows.append(Row(f"r = {radius * 1e3:g} mm, one image, cold", Figure.duration(seconds), note=note))
    batches: list[tuple[int, float]] = []
    scene = _scene(3e-3)
    for count in _BATCHES[: effort.of(len(_BATCHES), 2)]:
        angles = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
        degrees = torch.stack([angles.cos(), angles.sin()], -1)
        timings = in_turns(
            {"ours": Contender(lambda d=degrees: tp.retroreflect(scene, d, device="cpu"), work=count)}, effort.of(3, 1)
        )
        batches.append((count, timings.typical("ours")))
        rows.append(Row(f"r = 3 mm, an image of a batch of {count}", Figure.duration(timings.typical("ours"))))
    if not effort.quick:
        _draw(apertures, batches)
    return rows


def _scene(radius: float) -> tp.Scene:
    changes = ["target.object_distance=1 m", "sampling.propagation=far field", LARGE_SENSOR]
    # Half a millimetre returns nothing at 1°: half the cut-off at the most.
    degrees = min(1.0, 0.5 * math.degrees(math.atan(radius / 0.1)))
    return tp.load_scene("thin-lens", [*changes, f"target.lens.aperture_radius={radius}", f"target.rotation={degrees}"])


def _image_distance(scene: tp.Scene) -> float:
    return 1 / (1 / scene.target.lens.focal_length - 1 / scene.target.object_distance)


def _memory(scene: tp.Scene) -> float:
    sine = math.sin(math.hypot(*scene.target.rotation))
    return tp.Camera(scene, sine, device="cpu").plan.bytes_needed(1, math.prod(scene.probe.sensor.pixels))


def _draw(apertures: list[tuple[float, float, float]], batches: list[tuple[int, float]]) -> None:
    from matplotlib.figure import Figure as Canvas

    figure = Canvas(figsize=(10, 3.4), layout="constrained")
    time, memory, batch = figure.subplots(1, 3)
    numbers, seconds, bytes_ = zip(*apertures, strict=True)
    time.loglog(numbers, seconds, "o-")
    time.set(xlabel="Fresnel number r²/2λz", ylabel="seconds, one cold image", title="Time with the aperture")
    memory.loglog(numbers, [b / 2**20 for b in bytes_], "o-", color="C1")
    memory.set(xlabel="Fresnel number r²/2λz", ylabel="MiB planned", title="Memory with the aperture")
    counts, each = zip(*batches, strict=True)
    batch.loglog(counts, [1e3 * s for s in each], "o-", color="C2")
    batch.set(xlabel="gazes in the batch", ylabel="ms an image", title="Time with the batch, r = 3 mm")
    for axis in (time, memory, batch):
        axis.grid(True, which="both", alpha=0.25)
    figure.savefig(PICTURE, dpi=130)
