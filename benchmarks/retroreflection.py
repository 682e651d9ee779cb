"""One retro-reflection from a round table, beside LightPipes' propagation on a fixed grid."""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

import tapetum as tp
from tapetum.optics.grid import Grid

from .measure import Contender, Effort, Figure, Row, in_turns, wait

TITLE = "Retro-reflection: r = 3 mm, f = 100 mm, 1° of rotation, x_d = 1 m, 256 × 256 probe pixels"
PEERS = ("LightPipes",)

# A sensor that holds every spot: one that its edge cuts is computed another way.
LARGE_SENSOR = "target.sensor.pixels=[9000, 9000]"
_CHANGES = ["target.object_distance=1 m", "target.rotation=1 deg", "sampling.accuracy=0.001", LARGE_SENSOR]
_GAZES = 64
_PEER = Path(__file__).parents[1] / "tests" / "references" / "make_lightpipes.py"


def run(effort: Effort) -> list[Row]:
    """Ours cold with planning, ours in a batch, and LightPipes, in turns; then frames for training."""
    scene, peer = tp.load_scene("thin-lens", _CHANGES), _lightpipes()
    angles = 2 * math.pi * torch.arange(_GAZES) / _GAZES
    degrees = torch.stack([angles.cos(), angles.sin()], -1).double()
    contenders = {
        "cold": Contender(lambda: tp.retroreflect(scene, device="cpu"), repeats=effort.of(15, 1)),
        "batch": Contender(lambda: tp.retroreflect(scene, degrees, device="cpu"), work=_GAZES, repeats=effort.of(5, 1)),
        # Nothing in it gets faster by being run before, and it takes long.
        "peer": Contender(lambda: peer.retro_reflection(1.0, 1.0), warm_up=False),
    }
    # Five rounds of a peer that takes many seconds each tell enough.
    timings = in_turns(contenders, min(effort.rounds, 5))
    theirs = Figure.duration(timings.typical("peer"))
    name = f"LightPipes Forvard, N = {peer.SAMPLES}"
    metadata = tp.retroreflect(scene, device="cpu").metadata
    plan, stated = metadata["sampling"], metadata["expected_error"]
    apart = _difference(scene, peer)
    rows = [
        Row(
            "one image, cold, with planning",
            Figure.duration(timings.typical("cold")),
            name,
            theirs,
            timings.speed_up("cold", "peer"),
            f"{plan['columns']} × {plan['rows']} samples over the pupil; stated error {stated:.2g} of the peak; "
            f"{apart:.1g} from LightPipes with its ragged pupil",
        ),
        Row(
            f"an image in a batch of {_GAZES} gazes, planning included",
            Figure.duration(timings.typical("batch")),
            name,
            theirs,
            timings.speed_up("batch", "peer"),
        ),
    ]
    return [*rows, _full_aperture(effort), _training_frames(effort), _share_of_ceiling(effort)]


_WHOLE_LENS = [*_CHANGES, "target.lens.aperture_radius=12.7 mm", "sampling.propagation=far field"]
# A process of its own: this one has LightPipes' grids in it. What getrusage tells a child counts its parent in.
_ALONE = """
import pathlib, re, sys
import tapetum as tp
from tapetum.memory import keep_big_blocks

keep_big_blocks()
tp.retroreflect(tp.load_scene("thin-lens", sys.argv[1:]), device="cpu")
status = pathlib.Path("/proc/self/status")
print(re.search(r"VmHWM:\\s+(\\d+)", status.read_text())[1] if status.exists() else "")
"""


def _full_aperture(effort: Effort) -> Row:
    """The paper's whole lens: LightPipes would need more than ten thousand samples a side."""
    scene = tp.load_scene("thin-lens", _WHOLE_LENS)
    timings = in_turns({"ours": Contender(lambda: tp.retroreflect(scene, device="cpu"))}, effort.of(5, 1))
    plan = tp.retroreflect(scene, device="cpu").metadata["sampling"]
    command = [sys.executable, "-c", _ALONE, *_WHOLE_LENS]
    peak = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    memory = f"; alone in a process {int(peak) * 1024 / 1e9:.2f} GB, torch included" if peak else ""
    return Row(
        "the whole LA1509 lens, r = 12.7 mm, far field, cold",
        Figure.duration(timings.typical("ours")),
        note=f"{plan['columns']} × {plan['rows']} samples{memory}",
    )


def _training_frames(effort: Effort) -> Row:
    """Exposed frames of 400 x 400 pixels, as a data set of simulated images needs them: no peer makes them."""
    changes = [*_CHANGES[:1], "probe.sensor.pixels=[400, 400]", "sampling.accuracy=0.01"]
    scene, count = tp.load_scene("thin-lens", changes), effort.of(64, 4)
    gazes = torch.rand(count, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5

    def frames() -> Any:
        return tp.expose(tp.retroreflect(scene, gazes, device="cpu"), scene.probe, seed=1)

    timings = in_turns({"ours": Contender(frames, work=count)}, effort.rounds)
    return Row(
        "training frames, 400 × 400, gazes within ±0.5°, with noise, error ≤ 0.01",
        Figure.rate(timings.typical("ours"), "frames"),
    )


def _share_of_ceiling(effort: Effort) -> Row:
    """The hot loop beside the products that a plain matrix transform would do."""
    sine, batch = math.sin(math.radians(1.0)), effort.of(8, 2)
    camera = tp.Camera(tp.load_scene("thin-lens", _CHANGES), sine, device="cpu")
    sines = torch.zeros(batch, 2, dtype=torch.float64)
    sines[:, 1] = sine
    case = "hot loop, an image, camera held, in operations of the plain matrix transform"
    note = "the machine's own rate; the loop, look-ups and all, does the same work by fewer products"
    return share_of_ceiling(camera, sines, effort, case, note)


def share_of_ceiling(camera: tp.Camera, sines: torch.Tensor, effort: Effort, case: str, note: str) -> Row:
    """A camera's images of tilts [B, 2], in operations of the plain matrix transform, beside that transform alone."""
    out, plan, device = camera.output, camera.plan, sines.device
    generator = torch.Generator(device).manual_seed(0)

    def matrix(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.complex64, device=device, generator=generator)

    pupil = matrix(len(sines), plan.rows, plan.columns)
    across, down = matrix(plan.columns, out.columns), matrix(out.rows, plan.rows)
    repeats = effort.of(5, 1)
    timings = in_turns(
        {
            "ours": Contender(lambda: wait(camera(sines)), work=len(sines), repeats=repeats),
            "peer": Contender(lambda: wait(down @ (pupil @ across)), work=len(sines), repeats=repeats),
        },
        effort.rounds,
    )
    multiplications = plan.rows * plan.columns * out.columns + out.rows * plan.rows * out.columns
    # A complex multiplication with its addition counts as eight operations.
    giga = 8 * multiplications / 1e9
    return Row(
        case,
        Figure(giga / timings.typical("ours"), "GFLOP/s"),
        "that transform alone, complex64",
        Figure(giga / timings.typical("peer"), "GFLOP/s"),
        timings.speed_up("ours", "peer"),
        note,
    )


def _lightpipes() -> ModuleType:
    """The script that makes the tests' reference: one model of the peer, for both."""
    spec = importlib.util.spec_from_file_location("make_lightpipes", _PEER)
    if spec is None or spec.loader is None:
        raise FileNotFoundError(_PEER)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _difference(scene: tp.Scene, peer: ModuleType) -> float:
    """Largest difference from the peer's image on the peer's own pixels, in fractions of the peak, each of power 1."""
    theirs = torch.from_numpy(peer.retro_reflection(1.0, 1.0))[1:, 1:].double()
    side, pitch = theirs.shape[0], peer.WAVELENGTH * peer.PROBE_FOCAL / peer.SIZE
    sine = math.sin(math.radians(1.0))
    camera = tp.Camera(scene, sine, output=Grid(side, side, pitch), device="cpu")
    image = camera(torch.tensor([[sine, 0.0]], dtype=torch.float64))[0].double()
    ours, theirs = image / image.sum(), theirs / theirs.sum()
    return min(float((ours - one).abs().max() / theirs.max()) for one in (theirs, theirs.T))
