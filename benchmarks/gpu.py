"""Frames on a GPU: beside the CPU of the same machine, and beside the plain products that the GPU can do."""

from __future__ import annotations

import math

import numpy as np
import torch

import tapetum as tp
from tapetum.simulate.exposure import digitise
from tapetum.simulate.radiometry import electrons

from .measure import Contender, Effort, Figure, Row, in_turns, wait
from .retroreflection import share_of_ceiling

TITLE = "On a GPU: frames of 400 × 400 pixels, error ≤ 0.01 of the peak"
PEERS = ()
_PIXELS = ["probe.sensor.pixels=[400, 400]", "sampling.accuracy=0.01"]
_SCENES = {
    "thin-lens": ["target.object_distance=1 m", *_PIXELS],
    "rotation": _PIXELS,
}
_ONE_BEAM = {"thin-lens": [], "rotation": ["illumination.second_beam.ratio=0"]}
_NAMES = {"thin-lens": "a thin lens", "rotation": "the Rotation set's lens, traced"}
_SINE = math.sin(math.radians(0.5))
# Pictures that a camera is planned for.
_MANY = 10_000


def run(effort: Effort) -> list[Row]:
    """Batches of frames on GPU and CPU in turns, then the hot loops beside their products; nothing without a GPU."""
    if not torch.cuda.is_available():
        return []
    rows = [_frames("thin-lens", effort), _frames("rotation", effort), _frames("rotation", effort, noise=True)]
    return [*rows, *(_share_of_ceiling(scene, effort) for scene in _SCENES)]


def _frames(scene: str, effort: Effort, *, noise: bool = False) -> Row:
    """Images of a batch of gazes, the camera held; with `noise` as a sensor takes them, in the CPU's memory."""
    gazes, few = _gazes(effort.of(2048, 8)).cuda(), _gazes(effort.of(32, 2))
    held = tp.load_scene(scene, _SCENES[scene])
    cameras = {name: tp.Camera(held, _SINE, pictures=_MANY, device=name) for name in ("cuda", "cpu")}
    sensor, wavelength, dice = held.probe.sensor, held.illumination.wavelength, np.random.default_rng(0)

    def taken(name: str, tilts: torch.Tensor) -> None:
        image = cameras[name](tilts)
        if noise:
            digitise(electrons(image, sensor, wavelength), sensor, dice)
        else:
            wait(image)

    contenders = {
        "cuda": Contender(lambda: taken("cuda", gazes), work=len(gazes), repeats=effort.of(3, 1)),
        "cpu": Contender(lambda: taken("cpu", few), work=len(few)),
    }
    timings = in_turns(contenders, effort.rounds)
    one, other = (cameras[name](few.to(name)).double().cpu() for name in ("cuda", "cpu"))
    return Row(
        f"{_NAMES[scene]}, {'with noise, ' if noise else ''}batches of {len(gazes)} gazes within ±0.5°",
        Figure.rate(timings.typical("cuda"), "frames"),
        f"the same on {torch.get_num_threads()} CPU threads",
        Figure.rate(timings.typical("cpu"), "frames"),
        timings.speed_up("cuda", "cpu"),
        f"without noise the two differ by {float((one - other).abs().max() / other.max()):.1g} of the peak",
    )


def _share_of_ceiling(scene: str, effort: Effort) -> Row:
    camera = tp.Camera(tp.load_scene(scene, [*_SCENES[scene], *_ONE_BEAM[scene]]), _SINE, pictures=_MANY, device="cuda")
    case = f"hot loop of {_NAMES[scene]}, one beam, in operations of the plain matrix transform"
    note = f"{camera.plan.columns} × {camera.plan.rows} samples over the pupil"
    return share_of_ceiling(camera, _gazes(effort.of(2048, 8)).cuda(), effort, case, note)


def _gazes(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return (2 * torch.rand(count, 2, dtype=torch.float64, generator=generator) - 1) * _SINE / math.sqrt(2)
