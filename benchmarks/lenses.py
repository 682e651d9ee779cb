"""Real lenses: rays through a prescription, and the retro-reflections of traced lenses."""

from __future__ import annotations

import itertools
import math
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import torch

import tapetum as tp
from tapetum.bench import PrescriptionLens, phone_names, with_values
from tapetum.optics.grid import Grid
from tapetum.optics.rays import trace
from tapetum.simulate import Camera
from tapetum.simulate.phone import PhoneCamera

from .measure import Contender, Effort, Figure, Row, in_turns
from .retroreflection import share_of_ceiling

TITLE = "Real lenses: tracing 29 surfaces, images of 400 × 400 pixels, and frames of a phone"
PEERS = ("torch",)
_CASES = (
    ("cmount-12mm-f1.4", "3.8 mm", 1e-2, 15.0),
    ("phone-c", None, 1e-2, 4.0),
    ("zoom-18-140mm", "50 mm", 5e-2, 3.0),
)

# Pictures that a camera is planned for where their rate is measured.
_MANY = 10_000
# A phone of three cameras, and the sine of the steepest tilt that it is planned for.
_PHONE, _STEEPEST = "phone-06", 0.12
# The same of a lens that is held by hand.
_STEEPEST_HELD = math.sin(math.radians(1.0))


def run(effort: Effort) -> list[Row]:
    """Rays a second, then images a second of three lenses beside the thin lens's engine."""
    lens = PrescriptionLens("cmount-12mm-f1.4").focused(640e-9, 5.0)
    side = effort.of(300, 30)
    line = torch.linspace(-0.5, 0.5, side, dtype=torch.float64) * lens.entrance_radius
    x, y = torch.meshgrid(line, line, indexing="xy")
    start = torch.stack([x, y, torch.full_like(x, lens.entrance_pupil)], -1).reshape(-1, 3)
    way = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(start)
    rays = in_turns({"ours": Contender(lambda: trace(lens.lens, start, way), work=len(start))}, effort.rounds)
    surfaces = len(lens.lens)
    rows = [
        Row(
            f"rays through {surfaces} surfaces, float64, with path and vignetting",
            Figure.rate(rays.typical("ours"), "rays"),
            note=f"{rays.typical('ours') / surfaces * 1e9:.0f} ns a ray and surface",
        )
    ]
    plain = tp.load_scene("thin-lens")
    output, count = Grid(400, 400, 2.2e-6), effort.of(64, 2)
    for name, focal_length, accuracy, steepest in _CASES:
        kind = {"kind": "prescription", "name": name, **({"focal_length": focal_length} if focal_length else {})}
        sines = torch.sin(torch.deg2rad(torch.linspace(0, steepest, count, dtype=torch.float64)))
        tilts = torch.stack([0.6 * sines, 0.8 * sines], -1)
        # A sensor that holds the spot of the steepest tilt, whatever the lens.
        settings = {"accuracy": accuracy, "propagation": "far field", "target.sensor.pixels": [1296, 972]}
        bench = with_values(plain, {"target.lens": kind, **settings})
        traced = Camera(bench, float(sines[-1]), output=output, pictures=_MANY)
        same = {"target.lens.focal_length": traced.scene.target.lens.focal_length}
        same["target.lens.aperture_radius"] = traced.scene.target.lens.aperture_radius
        thin = Camera(with_values(plain, {**same, **settings}), float(sines[-1]), output=output)
        timings = in_turns(
            {
                "ours": Contender(lambda camera=traced, tilts=tilts: camera(tilts), work=count),
                "peer": Contender(lambda camera=thin, tilts=tilts: camera(tilts), work=count),
            },
            effort.rounds,
        )
        rows.append(
            Row(
                f"{name}, f = {traced.scene.target.lens.focal_length * 1e3:.3g} mm, {accuracy:g} of the peak",
                Figure.rate(timings.typical("ours"), "images"),
                "our thin lens of the same f and aperture",
                Figure.rate(timings.typical("peer"), "images"),
                timings.speed_up("ours", "peer"),
                f"tilts up to {steepest:g}°; {traced.plan.columns} samples over the pupil",
            )
        )
        if name == _CASES[0][0]:
            case = "the same, camera held, in operations of the plain matrix transform from its pupil to the pixels"
            note = "the machine's own rate; the light's way in and off the sensor comes on top"
            rows.append(share_of_ceiling(traced, tilts, effort, case, note))
    return [*rows, _zoom(effort), _phone(effort), _planning(effort, 1), _planning(effort, _MANY)]


def _zoom(effort: Effort) -> Row:
    """The Focusing set's longest lens at its nearest focus: far out of focus, through the probe's aperture."""
    changes = {"target.lens.focal_length": "135 mm", "target.object_distance": "3 m", "sampling.accuracy": 0.02}
    camera = Camera(with_values(tp.load_scene("focusing"), changes), _STEEPEST_HELD, pictures=_MANY)
    count = effort.of(8, 1)
    tilts = 2 * _STEEPEST_HELD * (torch.rand(count, 2, dtype=torch.float64) - 0.5) / math.sqrt(2)
    places = torch.zeros(count, 2, dtype=torch.float64)
    timings = in_turns({"ours": Contender(lambda: camera.render(tilts, places), work=count)}, effort.rounds)
    return Row(
        f"zoom-18-140mm, f = 135 mm, focused at 3 m, {camera.accuracy:g} of the peak, through the probe's aperture",
        Figure.rate(timings.typical("ours"), "images"),
        note=f"one beam, tilts up to 1°, {camera.output.columns} × {camera.output.rows} pixels; "
        f"{camera.plan.columns} samples over the pupil, stated error {camera.plan.expected_error:.2g}",
    )


def _phone(effort: Effort) -> Row:
    """Frames of a phone as the set Phones films them, both beams, tilts up to 5°; a camera's part of each."""
    scene = with_values(tp.load_scene("phones"), {"target.name": _PHONE})
    dice = torch.Generator().manual_seed(1)
    count = effort.of(8, 2)
    tilts = _STEEPEST * (torch.rand(count, 2, generator=dice, dtype=torch.float64) - 0.5)
    places = 1e-4 * torch.randn(count, 2, generator=dice, dtype=torch.float64)
    phone = PhoneCamera(scene, _STEEPEST, pictures=_MANY)
    beam = scene.illumination.second_beam
    assert beam is not None
    settings = {"accuracy": scene.sampling.accuracy, "propagation": "far field", "target.sensor.pixels": [1296, 972]}
    settings["illumination.second_beam"] = {"ratio": beam.ratio, "angle": list(beam.angle)}
    thin: list[Camera] = []
    for camera, unit in phone.units:
        lens = unit.scene.target.lens
        same = {"target.lens.focal_length": lens.focal_length, "target.lens.aperture_radius": lens.aperture_radius}
        one = with_values(tp.load_scene("thin-lens"), {**same, **settings})
        thin.append(Camera(one, _STEEPEST, output=camera.output))
    work = count * len(thin)
    timings = in_turns(
        {
            "ours": Contender(lambda: phone(tilts, places), work=work),
            "peer": Contender(lambda: [one(tilts, places) for one in thin], work=work),
        },
        effort.rounds,
    )
    return Row(
        f"{_PHONE}, {len(thin)} cameras with filters and glints, a camera's part of a frame",
        Figure.duration(timings.typical("ours")),
        "our thin lenses of the same f and apertures",
        Figure.duration(timings.typical("peer")),
        timings.speed_up("ours", "peer"),
        f"both beams, tilts up to 5°, {phone.output.columns} × {phone.output.rows} pixels",
    )


def _planning(effort: Effort, pictures: int) -> Row:
    """Opening and planning the cameras of all phones, as processes that film a set do it, side by side."""
    names = phone_names()[: effort.of(100, 1)]
    cores = os.cpu_count() or 1
    with ProcessPoolExecutor(cores, get_context("spawn"), torch.set_num_threads, (1,)) as pool:
        # Processes that have loaded the package.
        list(pool.map(_loaded, range(cores)))
        start = time.perf_counter()
        told = list(pool.map(_planned, reversed(names), itertools.repeat(pictures)))
        seconds = time.perf_counter() - start
    cameras, work = (sum(one) for one in zip(*told, strict=True))
    asked = "one picture each" if pictures == 1 else f"{pictures} pictures each"
    return Row(
        f"planning the {cameras} cameras of {len(names)} phones by {cores} processes, for {asked}",
        Figure.duration(seconds),
        note=f"{work:.0f} s of processor time; tilts up to {math.degrees(_STEEPEST):.0f}°",
    )


def _loaded(_: int) -> None:
    """Wait until each process has its call."""
    time.sleep(1)


def _planned(name: str, pictures: int) -> tuple[int, float]:
    start = time.process_time()
    phone = PhoneCamera(with_values(tp.load_scene("phones"), {"target.name": name}), _STEEPEST, pictures=pictures)
    assert phone.plan is not None
    return len(phone.units), time.process_time() - start
