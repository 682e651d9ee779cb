"""The playground: what a moved slider takes, until all that the page draws is there."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import torch

from tapetum.bench import Scene, load_scene
from tapetum.live.playground import Playground, apply
from tapetum.live.playground.wire import limit_json, result_json
from tapetum.simulate import expose, retroreflect
from tapetum.simulate.planning import plan_bench

from .measure import Contender, Effort, Figure, Row, in_turns

TITLE = "The playground: a moved slider, until picture, frame, budget, eye safety and rays are there"
PEERS = ()

_LENS = {"lens": "cmount-12mm-f1.4", "f_number": 4.0, "gaze_x": 0.1, "photosites": "square", "photosite_pitch": 2.2}
_ZOOM = {"lens": "zoom-18-140mm", "f_number": 8.0}
# What is moved, the value of its nth step, the settings beside it, and the limit promised, in milliseconds.
_CASES: tuple[tuple[str, str, dict[str, Any], float, float, int], ...] = (
    ("thin lens, gaze", "gaze_x", {"gaze_y": 0.05}, 0.05, 1e-4, 100),
    ("thin lens, focus", "focus", {}, 4.0, 1e-3, 100),
    ("thin lens, tilt of the sensor", "tilt_y", {"gaze_x": 0.1}, 0.2, 1e-4, 100),
    ("thin lens, power", "power", {}, 1.0, 1e-3, 100),
    ("cmount-12mm-f1.4, gaze", "gaze_y", _LENS, 0.05, -1e-4, 300),
    ("cmount-12mm-f1.4, focus", "focus", _LENS, 4.0, 1e-3, 300),
    ("cmount-12mm-f1.4, tilt of the sensor", "tilt_y", _LENS, 0.2, 1e-4, 300),
    ("cmount-12mm-f1.4, distance", "distance", _LENS, 5.0, 1e-3, 300),
    ("zoom-18-140mm, focus", "focus", _ZOOM, 4.0, 1e-3, 300),
)


def run(effort: Effort) -> list[Row]:
    """Time each case beside the commands `plan` and `simulate`, which prepare everything again."""
    threads = torch.get_num_threads()
    # As the server computes.
    torch.set_num_threads(1)
    try:
        return [_row(effort, *case) for case in _CASES]
    finally:
        torch.set_num_threads(threads)


def _row(
    effort: Effort, name: str, setting: str, others: dict[str, Any], first: float, step: float, promised: int
) -> Row:
    base = load_scene("thin-lens")
    values = ({**others, setting: first + k * step} for k in itertools.count())
    traced, ground = "lens" in others, Playground()
    ground.result(apply(base, next(values)))
    draft = ground.first(base, next(values))[1].draft
    timings = in_turns(
        {
            "ours": Contender(_shown(ground, base, values), repeats=effort.of(5, 1)),
            "peer": Contender(_anew(base, values), repeats=1),
            "rest": Contender(_followed(ground, base, values, traced), repeats=1),
        },
        effort.rounds,
    )
    limit = timings.typical("rest") * 1e3
    follows = f"the limit {limit:.0f} ms later"
    if draft:
        said = "as of a thin lens" if draft == "thin lens" else "on few samples"
        follows = f"a first picture, {said}; the full one and the limit {limit:.0f} ms later"
    return Row(
        name,
        Figure(timings.typical("ours") * 1e3, "ms"),
        "tapetum plan and simulate",
        Figure(timings.typical("peer") * 1e3, "ms"),
        timings.speed_up("ours", "peer"),
        f"promised {promised} ms; {follows}",
    )


def _shown(ground: Playground, base: Scene, values: Iterator[dict[str, Any]]) -> Callable[[], object]:
    def once() -> object:
        return result_json(*ground.first(base, next(values)))

    return once


def _followed(ground: Playground, base: Scene, values: Iterator[dict[str, Any]], traced: bool) -> Callable[[], object]:
    """The full picture where a first one came before, and the limit."""

    def once() -> object:
        scene = apply(base, next(values))
        full = result_json(scene, ground.result(scene)) if traced else None
        return full, limit_json(ground.limit(scene))

    return once


def _anew(base: Scene, values: Iterator[dict[str, Any]]) -> Callable[[], object]:
    def once() -> object:
        scene = apply(base, next(values))
        image = retroreflect(scene, device="cpu")
        return plan_bench(scene), expose(image, scene)

    return once
