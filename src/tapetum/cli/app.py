"""The command `tapetum`: one thin module a command, one line for bad input."""

from __future__ import annotations

import errno
import functools
import importlib.metadata
import os
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from tapetum.cli.adapt import adapt
from tapetum.cli.calibrate import ghost, probe, sync
from tapetum.cli.calibrate_units import units
from tapetum.cli.cameras import cameras
from tapetum.cli.dataset import build, info, synth
from tapetum.cli.dataset_import import import_data
from tapetum.cli.demo import demo
from tapetum.cli.detect import detect
from tapetum.cli.evaluate import evaluate
from tapetum.cli.export import export
from tapetum.cli.fuse import fuse
from tapetum.cli.options import Command
from tapetum.cli.paper import paper
from tapetum.cli.plan import plan
from tapetum.cli.record import record
from tapetum.cli.serve import serve
from tapetum.cli.simulate import simulate
from tapetum.cli.track import track
from tapetum.cli.train import train
from tapetum.cli.twin import twin
from tapetum.errors import InputError, StoppedError, TapetumError
from tapetum.memory import keep_big_blocks

__all__ = ["app", "main", "root_command"]

# Typer raises Click's errors, from its own copy of Click in newer versions: take the classes from its public error.
_UsageError: type[Exception] = typer.BadParameter.__bases__[0]
_ClickException: type[Exception] = _UsageError.__bases__[0]
_INTERRUPTED = 130


# By command: the function, its line in the list of commands, and an example for its help.
_COMMANDS: dict[str, tuple[Callable[..., None], str, str]] = {
    "demo": (demo, "From film to trained model and tracks, with a report.", "--out demo-out"),
    "simulate": (
        simulate,
        "Retro-reflections of a scene, and sweeps.",
        "thin-lens --sweep rotation=0,0.5,1 -o sweep.png",
    ),
    "plan": (plan, "What to expect of a scene: budget, limits, eye safety.", "thin-lens --set object_distance=2.5"),
    "cameras": (cameras, "List the cameras that are plugged in, and their modes.", "--json"),
    "record": (record, "Film a scene, or record real cameras.", "hand-held -o hand.rec --seconds 20 --seed 7"),
    "calibrate probe": (
        probe,
        "Gain, read noise, full well and pattern of a sensor.",
        "dark flat-1ms flat-2ms flat-4ms flat-8ms flat-16ms -o my-sensor.yaml",
    ),
    "calibrate ghost": (
        ghost,
        "Offset and brightness of the beam splitter's ghost.",
        "alone.rec -o my-ghost.yaml --focal-length '200 mm' --pitch '2.2 um'",
    ),
    "calibrate sync": (sync, "Lag and drift between the two cameras.", "walk.rec -o my-sync.yaml"),
    "calibrate units": (
        units,
        "How far a model errs on copies of its camera.",
        "my-model copies.zarr -o my-model-for-copies",
    ),
    "twin": (twin, "The scene that explains a recording.", "hand.rec --scene hand-held -o twin.yaml"),
    "dataset build": (build, "Cut crops out of labelled recordings.", "hand.rec -o hand.zarr"),
    "dataset info": (info, "What a dataset holds, and what is wrong with it.", "hand.zarr --sheet hand.png"),
    "dataset synth": (synth, "Film the paper's three sets.", "rotation --size small -o rotation.zarr"),
    "dataset import": (
        import_data,
        "Make a dataset of data taken elsewhere.",
        "theirs --mapping map.yaml -o theirs.zarr",
    ),
    "train": (train, "Fit a model to a dataset.", "hand.zarr --kind zernike --label gaze -o my-model"),
    "adapt": (
        adapt,
        "Fit a trained network to one camera, on seconds of film.",
        "thin-lens-gaze mine.rec -o mine --seconds 10",
    ),
    "evaluate": (evaluate, "A model's errors on a dataset.", "my-model hand.zarr -o report"),
    "export": (export, "A trained network as one ONNX file.", "thin-lens-gaze -o gaze.onnx"),
    "detect": (
        detect,
        "Find cameras in a photograph, or in a lit and a dark one.",
        "lit.png --dark dark.png -o found.csv",
    ),
    "track": (track, "Find, follow and read retro-reflections.", "hand.rec --model my-model -o tracks.csv"),
    "serve": (serve, "Watch a source live, on a page.", "demo"),
    "fuse": (
        fuse,
        "Fuse the tracks of several probes into one.",
        "left.parquet right.parquet --place 0.24,0 --distance 5.5 --field 3.3,2.4 -o both.parquet",
    ),
    "paper": (paper, "The paper's figures and tables, reproduced.", "fig4 fig5 -o figures"),
}


class _InOrder(TyperGroup):
    """Lists the commands in the order of a typical session; Typer would list groups first."""

    def list_commands(self, ctx: typer.Context) -> list[str]:  # pyright: ignore[reportIncompatibleMethodOverride]
        order = [words.split()[0] for words in _COMMANDS]
        return sorted(super().list_commands(ctx), key=lambda name: order.index(name) if name in order else len(order))


app = typer.Typer(
    cls=_InOrder,
    help="Turn the light a camera throws back into knowledge of that camera. Begin with: tapetum demo",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
# Groups of commands: help of their own, and the line in the list of commands.
_GROUPS: dict[str, tuple[str, str]] = {
    "dataset": (
        "Build datasets from recordings, and look into them.",
        "Build, import and film datasets, and look into them.",
    ),
    "calibrate": (
        "Measure what must be known of a real probe, and of a model's errors on further cameras.",
        "A real probe's sensor, ghost and clocks; a model on copies.",
    ),
}
_groups = {
    name: typer.Typer(help=told, no_args_is_help=True, rich_markup_mode=None) for name, (told, _) in _GROUPS.items()
}
for _words, (_function, _short, _example) in _COMMANDS.items():
    _group, _, _name = _words.rpartition(" ")
    (_groups[_group] if _group else app).command(
        _name, cls=Command, short_help=_short, epilog=f"Example: tapetum {_words} {_example}"
    )(_function)
for _name, _typer in _groups.items():
    app.add_typer(_typer, name=_name, short_help=_GROUPS[_name][1])


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(importlib.metadata.version("tapetum"))
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    del version


@functools.cache
def root_command() -> Any:
    """Return all commands as Click knows them; Typer would put them together again for each call."""
    return typer.main.get_command(app)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return 0 for success, 1 for a failed check, 2 for bad input, 130 when interrupted."""
    keep_big_blocks()
    code, line = _run(arguments)
    # An interrupted progress bar leaves the screen only once the error and its stack frames are released.
    if line:
        typer.echo(line, err=True)
    return code


def _run(arguments: Sequence[str] | None) -> tuple[int, str]:
    """Run a command; return its exit code and what to say of an error."""
    try:
        result = root_command()(
            args=list(arguments) if arguments is not None else None, prog_name="tapetum", standalone_mode=False
        )
        code = result if isinstance(result, int) else 0
        # Typer may return this code for Ctrl-C itself.
        return code, "interrupted" if code == _INTERRUPTED else ""
    except InputError as error:
        return 2, f"error: {error}"
    except StoppedError as error:
        return _INTERRUPTED, f"interrupted: {error}"
    except TapetumError as error:
        return 1, f"error: {error}"
    except (KeyboardInterrupt, typer.Abort):
        return _INTERRUPTED, "interrupted"
    except BrokenPipeError:
        # The reader of the output has closed it (`tapetum ... | head`): neither report nor flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1, ""
    except OSError as error:
        # A file that cannot be read or written; the output itself has no name, another error without one is a bug.
        if error.filename is None and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 2, f"error: standard output: cannot be written ({error.strerror}); direct it elsewhere"
        if error.filename is None:
            raise
        return 2, f"error: {error.filename}: {error.strerror or error}; check the path and its permissions"
    except _ClickException as error:
        return 2, _usage(error)


def _usage(error: Exception) -> str:
    """Click's message about an invalid command line."""
    context = getattr(error, "ctx", None)
    command = "tapetum" if context is None else context.command_path
    if type(error).__name__ == "NoArgsIsHelpError":
        return str(error)
    message = " ".join(str(getattr(error, "format_message", error.__str__)()).split())
    return f"error: {message.rstrip('.?')}; see {command} --help"


if __name__ == "__main__":
    sys.exit(main())
