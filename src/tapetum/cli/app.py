"""The command `tapetum`: one thin module a command, one line for bad input."""

from __future__ import annotations

import importlib.metadata
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import typer
from typer.core import TyperGroup

from tapetum.cli import dataset, demo, evaluate, export, fuse, paper, plan, record, simulate, track, train
from tapetum.cli.memory import keep_big_blocks
from tapetum.errors import InputError, StoppedError, TapetumError

__all__ = ["app", "main"]

# Typer raises the errors of Click, which newer versions of it carry inside and older ones import: its own public
# error leads to the classes of both.
_UsageError: type[Exception] = typer.BadParameter.__bases__[0]
_ClickException: type[Exception] = _UsageError.__bases__[0]
_INTERRUPTED = 130


class _AsAdded(TyperGroup):
    """Lists the commands in the order in which a person needs them."""

    def list_commands(self, ctx: typer.Context) -> list[str]:  # pyright: ignore[reportIncompatibleMethodOverride]
        del ctx
        order = (
            "demo",
            "simulate",
            "plan",
            "record",
            "dataset",
            "train",
            "evaluate",
            "export",
            "track",
            "fuse",
            "paper",
        )
        return sorted(self.commands, key=lambda name: order.index(name) if name in order else len(order))


app = typer.Typer(
    cls=_AsAdded,
    help="Turn the light a camera throws back into knowledge of that camera. Begin with: tapetum demo",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_COMMANDS = (
    ("demo", "The main job end to end, with a report.", demo.demo, "--out demo-out"),
    (
        "simulate",
        "Retro-reflections of a scene, and sweeps.",
        simulate.simulate,
        "thin-lens --sweep rotation=0,0.5,1 -o sweep.png",
    ),
    ("plan", "What a scene would give: budget, limits, eye safety.", plan.plan, "thin-lens --set object_distance=2.5"),
    ("record", "Film a scene, or record real cameras.", record.record, "hand-held -o hand.rec --seconds 20 --seed 7"),
    ("train", "Fit a model to a dataset.", train.train, "hand.zarr --model zernike --target gaze -o my-model"),
    ("evaluate", "A model's errors on a dataset.", evaluate.evaluate, "my-model hand.zarr -o report"),
    ("export", "A trained network as one ONNX file.", export.export, "thin-lens-gaze -o gaze.onnx"),
    ("track", "Find, follow and read retro-reflections.", track.track, "hand.rec --model my-model -o tracks.csv"),
    (
        "fuse",
        "One track of what several probes say.",
        fuse.fuse,
        "left.parquet right.parquet --place 0.24,0 --distance 5.5 --field 3.3,2.4 -o both.parquet",
    ),
    ("paper", "The paper's figures and tables, reproduced.", paper.paper, "fig4 fig5 -o figures"),
)
for _name, _short, _function, _example in _COMMANDS:
    app.command(_name, short_help=_short, epilog=f"Example: tapetum {_name} {_example}")(_function)
app.add_typer(dataset.app, name="dataset", short_help="Build, import and film datasets, and look into them.")


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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line: 0 done, 1 a check said no, 2 bad input, 130 interrupted."""
    keep_big_blocks()
    code, line = _run(arguments)
    # Only now, when the error and the frames it held are gone, is a bar that it cut short off the screen.
    if line:
        typer.echo(line, err=True)
    return code


def _run(arguments: Sequence[str] | None) -> tuple[int, str]:
    """Run a command; return its exit code and what to say of an error."""
    try:
        result = app(
            args=list(arguments) if arguments is not None else None, prog_name="tapetum", standalone_mode=False
        )
        code = result if isinstance(result, int) else 0
        # Typer may turn Ctrl-C into this code by itself.
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
        # Whoever read our output has left (`tapetum ... | head`): nothing to say, and nowhere to flush it to.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1, ""
    except OSError as error:
        # A file that the system would not read or write; errors without a file's name are ours to mend.
        if error.filename is None:
            raise
        return 2, f"error: {error.filename}: {error.strerror or error}; check the path and its permissions"
    except _ClickException as error:
        return 2, _usage(error)


def _usage(error: Exception) -> str:
    """What Click says of a command line that it cannot read."""
    context = getattr(error, "ctx", None)
    command = "tapetum" if context is None else context.command_path
    if type(error).__name__ == "NoArgsIsHelpError":
        return str(error)
    message = " ".join(str(getattr(error, "format_message", error.__str__)()).split())
    return f"error: {message.rstrip('.?')}; see {command} --help"


if __name__ == "__main__":
    sys.exit(main())
