"""`tapetum plan`: the expected performance of a scene, before it is simulated or built."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from tapetum.bench import Target, ThinLens, load_scene
from tapetum.cli.options import AsJson, Changes, SceneName, option
from tapetum.errors import InputError
from tapetum.progress import bar, quiet


def plan(
    scene: SceneName,
    changes: Changes = None,
    parameters: Annotated[
        str | None,
        option(
            "NAMES",
            "What is to be estimated from one frame, all together: gaze_x, gaze_y, object_distance, focal_length, "
            "distance, power where left out; place_x and place_y, where on the probe's sensor the RR lies, besides.",
            "--target-parameters",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Plan a bench: its geometry, link budget, sampling, Cramér-Rao limits of one frame, and eye safety.

    Nothing is written. No unbiased estimate from one frame has a smaller standard deviation than the limits.

    JSON, in SI units: "scene"; "geometry"; "link_budget", a list, one entry a wavelength; "sampling" with "plan",
    "expected_error", "memory_bytes", "propagation" and "reason"; "limit" with "parameters", "units", "bounds" (all
    others unknown), "alone" (all others known), "left_out" (and why) and "information", the Fisher matrix; "labels"
    with "rms_error", of a hand-held target's gaze labels by the rate of its own camera; "eye_safety"
    with "computed", "reason" (why it was not), "laser_class", "at", "emission", "limits", "nohd", "aided_nohd" and
    "notice". null stands for what is infinite (a limit: the frame holds no information; a nohd: the hazard has no end;
    an expected error: no claim is made) and for what was not computed or is not there.
    """
    names = None if parameters is None else [name.strip() for name in parameters.split(",")]
    if names is not None and not all(names):
        remedy = "write names with commas between, such as gaze_x,gaze_y"
        raise InputError(f"{parameters!r} has an empty name", where="--target-parameters", remedy=remedy)
    known = load_scene(scene, changes or ())
    # Torch takes a second to import.
    from tapetum.simulate.planning import label_lines, plan_bench

    # A thin lens is planned at once.
    thin = isinstance(known.target, Target) and isinstance(known.target.lens, ThinLens)
    planned = plan_bench(known, names, progress=quiet if thin else bar)
    if as_json:
        typer.echo(json.dumps({"scene": scene, **planned.as_dict()}, allow_nan=False))
    else:
        lines = planned.lines()
        before = lines.index("Eye safety")
        typer.echo("\n".join([*lines[:before], *label_lines(), *lines[before:]]))
