"""Frames on a GPU: beside the CPU of the same machine, and beside the plain products that the GPU can do."""

from __future__ import annotations

import math

import torch

import tapetum as tp

from .measure import Contender, Effort, Figure, Row, in_turns, wait
from .retroreflection import share_of_ceiling

TITLE = "On a GPU: frames of 400 × 400 pixels, error ≤ 0.01 of the peak"
PEERS = ()
_PIXELS = ["probe.sensor.pixels=[400, 400]", "sampling.accuracy=0.01"]
_SCENES = {
    "thin-lens": ["target.object_distance=1 m", *_PIXELS],
    "rotation": _PIXELS,
}
_SINE = math.sin(math.radians(0.5))


def run(effort: Effort) -> list[Row]:
    """Batches of frames on GPU and CPU in turns, then the hot loop beside its products; nothing without a GPU."""
    if not torch.cuda.is_available():
        return []
    rows = [_frames("thin-lens", "a thin lens", effort), _frames("rotation", "the Rotation set's lens, traced", effort)]
    return [*rows, _share_of_ceiling(effort)]


def _frames(scene: str, what: str, effort: Effort) -> Row:
    """Images of a batch of gazes, the camera held."""
    gazes, few = _gazes(effort.of(512, 8)).cuda(), _gazes(effort.of(32, 2))
    cameras = {name: tp.Camera(tp.load_scene(scene, _SCENES[scene]), _SINE, device=name) for name in ("cuda", "cpu")}
    contenders = {
        "cuda": Contender(lambda: wait(cameras["cuda"](gazes)), work=len(gazes), repeats=effort.of(3, 1)),
        "cpu": Contender(lambda: cameras["cpu"](few), work=len(few)),
    }
    timings = in_turns(contenders, effort.rounds)
    one, other = (cameras[name](few.to(name)).double().cpu() for name in ("cuda", "cpu"))
    return Row(
        f"{what}, batches of {len(gazes)} gazes within ±0.5°",
        Figure.rate(timings.typical("cuda"), "frames"),
        f"the same on {torch.get_num_threads()} CPU threads",
        Figure.rate(timings.typical("cpu"), "frames"),
        timings.speed_up("cuda", "cpu"),
        f"the two differ by {float((one - other).abs().max() / other.max()):.1g} of the peak",
    )


def _share_of_ceiling(effort: Effort) -> Row:
    camera = tp.Camera(tp.load_scene("thin-lens", _SCENES["thin-lens"]), _SINE, device="cuda")
    case = "hot loop of the thin lens, in operations of the plain matrix transform"
    note = f"{camera.plan.columns} × {camera.plan.rows} samples over the pupil"
    return share_of_ceiling(camera, _gazes(effort.of(512, 8)).cuda(), effort, case, note)


def _gazes(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return (2 * torch.rand(count, 2, dtype=torch.float64, generator=generator) - 1) * _SINE / math.sqrt(2)
