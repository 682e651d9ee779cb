"""Frames on a GPU: beside the CPU of the same machine, and beside the plain products that the GPU can do."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch

import tapetum as tp

from .measure import Contender, Effort, Figure, Row, in_turns

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
    gazes, few = _gazes(effort.of(512, 8)), _gazes(effort.of(32, 2))
    cameras = {name: tp.Camera(tp.load_scene(scene, _SCENES[scene]), _SINE, device=name) for name in ("cuda", "cpu")}
    contenders = {
        "cuda": Contender(_waited(lambda: cameras["cuda"](gazes.cuda())), work=len(gazes), repeats=effort.of(3, 1)),
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
    """The hot loop in operations of the plain matrix transform, beside that transform alone."""
    camera = tp.Camera(tp.load_scene("thin-lens", _SCENES["thin-lens"]), _SINE, device="cuda")
    out, plan = camera.output, camera.plan
    gazes = _gazes(effort.of(512, 8)).cuda()
    generator = torch.Generator("cuda").manual_seed(0)

    def matrix(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.complex64, device="cuda", generator=generator)

    pupil = matrix(len(gazes), plan.rows, plan.columns)
    across, down = matrix(plan.columns, out.columns), matrix(out.rows, plan.rows)
    contenders = {
        "ours": Contender(_waited(lambda: camera(gazes)), work=len(gazes), repeats=effort.of(3, 1)),
        "peer": Contender(_waited(lambda: down @ (pupil @ across)), work=len(gazes), repeats=effort.of(3, 1)),
    }
    timings = in_turns(contenders, effort.rounds)
    # A complex multiplication with its addition counts as eight operations.
    giga = 8 * (plan.rows * plan.columns * out.columns + out.rows * plan.rows * out.columns) / 1e9
    return Row(
        "hot loop of the thin lens, in operations of the plain matrix transform",
        Figure(giga / timings.typical("ours"), "GFLOP/s"),
        "that transform alone, complex64",
        Figure(giga / timings.typical("peer"), "GFLOP/s"),
        timings.speed_up("ours", "peer"),
        f"{plan.columns} × {plan.rows} samples over the pupil; {torch.cuda.get_device_name()}",
    )


def _gazes(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return (2 * torch.rand(count, 2, dtype=torch.float64, generator=generator) - 1) * _SINE / math.sqrt(2)


def _waited(work: Callable[[], Any]) -> Callable[[], None]:
    """The work, done when it returns: a GPU's calls return before."""

    def done() -> None:
        work()
        torch.cuda.synchronize()

    return done
