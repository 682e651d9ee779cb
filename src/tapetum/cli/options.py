"""Options shared by several commands, and their deprecated spellings."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperCommand

from tapetum.bench import scene_names
from tapetum.defaults import SEED
from tapetum.errors import InputError, one_of


def option(metavar: str, told: str, *spellings: str, **limits: Any) -> Any:
    """Describe an option with a value: its name in the help, its effect, and its limits."""
    return typer.Option(*spellings, metavar=metavar, help=told, **limits)


WAYS = ("live", "whole")
"""What `--smooth` takes."""
SYSTEMATIC = 1.0
"""What `--systematic` is by default."""
_SCENES = f"A bundled scene ({', '.join(scene_names())}) or a YAML file."
_MODELS = "A model's folder, a network exported to NAME.onnx, a twin NAME.yaml, or the bundled thin-lens-gaze"
_SEED = option("N", f"Seed of everything random; {SEED} by default.", "--seed", min=0, max=2**63 - 1)

SceneName = Annotated[str, typer.Argument(metavar="SCENE", help=_SCENES)]
SetPath = Annotated[Path, typer.Argument(metavar="SET", help="A dataset, NAME.zarr.")]
ModelName = Annotated[str, typer.Argument(metavar="MODEL", help=f"{_MODELS}.")]
SetOut = Annotated[Path, option("SET", "The dataset to write, NAME.zarr.", "-o", "--out")]
Split = Annotated[
    str,
    option(
        "HOW",
        "Frames to test on: the end of every video (time), the units kept out of training (unit), or the end of the "
        "other units' videos (seen-unit). The last fifth of each camera's units is kept out, at least one.",
    ),
]
TracksOut = Annotated[Path, option("TRACKS", "The table to write: .parquet, .csv or .jsonl.", "-o", "--out")]
Changes = Annotated[list[str] | None, option("KEY=VALUE", "Change any field of the scene; repeatable.", "--set")]
Models = Annotated[list[str] | None, option("MODEL", f"{_MODELS}; repeatable.", "--model")]
Smooth = Annotated[str | None, option("WAY", "Smooth estimates over time: live (by earlier frames alone) or whole.")]
Systematic = Annotated[
    float,
    option("SHARE", "Share of the intervals' width that smoothing cannot reduce: 1 keeps all of it, 0 none.", min=0.0),
]
Seed = Annotated[int, _SEED]
SeedIfGiven = Annotated[int | None, _SEED]
Device = Annotated[str, option("NAME", "Where to compute: auto, cpu, cuda or cuda:1.")]
Processes = Annotated[
    str | None, option("N", "Processes on this machine; auto: one a core to film, one a GPU to train.")
]
Cluster = Annotated[str | None, option("ADDRESS", "A Dask scheduler, tcp://HOST:8786 (extra: cluster).")]
WhoseIntervals = Annotated[
    str | None,
    option(
        "WHOSE",
        "Intervals of the copy of the camera that the model was trained on (own), or of one that it has not seen "
        "(other), where it has these. By default own if the input is known to show that copy.",
        "--unit",
    ),
]
Force = Annotated[bool, typer.Option("--overwrite", help="Replace an output that exists, once the new one is whole.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]

_OLD_SPELLINGS: dict[str, dict[str, str]] = {
    "train": {"--model": "--kind", "--target": "--label"},
    "record": {"--target": "--target-source"},
    "synth": {"--workers": "--processes"},
    "paper": {"--workers": "--processes"},
}
"""Deprecated spellings by command, accepted for one release."""


class Command(TyperCommand):
    """A command that also accepts deprecated spellings of its options, hidden from its help."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Parse the command line with deprecated spellings replaced."""
        now = _OLD_SPELLINGS.get(self.name or "", {})
        end = args.index("--") if "--" in args else len(args)
        options = [arg.partition("=") for arg in args[:end]]
        return super().parse_args(
            ctx, [now.get(name, name) + sign + value for name, sign, value in options] + args[end:]
        )


def count_of(processes: str | None) -> int | Literal["auto"] | None:
    """Return the number of processes asked for; refuses anything but a positive number or auto."""
    if processes is None or processes == "auto":
        return processes
    if not (processes.isascii() and processes.isdigit() and int(processes)):
        what = f"must be a number or auto, is {processes!r}"
        raise InputError(what, where="--processes", remedy="give a number from 1, or auto")
    return int(processes)


def film_count(processes: str | None) -> int | None:
    """Return the number of processes that film; auto means the cores available to this one."""
    count = count_of(processes)
    if count != "auto":
        return count
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_smoothing(smooth: str | None, systematic: float) -> None:
    """Refuse an unknown way to smooth, and `--systematic` without one."""
    if smooth is not None:
        one_of(smooth, WAYS, "--smooth")
    elif systematic != SYSTEMATIC:
        raise InputError("is of smoothing", where="--systematic", remedy="add --smooth, or leave it out")
