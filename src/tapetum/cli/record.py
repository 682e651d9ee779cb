"""`tapetum record`: a recording, from the virtual bench or from real cameras and files."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tapetum.bench import load_scene, scene_names
from tapetum.bench.quantity import to_si
from tapetum.cli.options import Changes, Force, SeedIfGiven, option
from tapetum.cli.outputs import check_output, says_what_is_kept
from tapetum.defaults import SEED
from tapetum.errors import InputError, one_of
from tapetum.progress import bar

if TYPE_CHECKING:
    from tapetum.bench import Scene
    from tapetum.record import BlinkCode, Recording, Session

EVERY = 10.041
"""Seconds from one code of the driver to the next: no whole number of frames, so that flanks fall at all phases."""
# Seconds between two clocks, at most.
_MOST_OFFSET = 1e6
_SOURCE = "A scene for the virtual bench (hand-held, or a YAML file); or the probe's camera:0, video or images."


def record(
    source: Annotated[str, typer.Argument(metavar="SCENE_OR_PROBE", help=_SOURCE)],
    out: Annotated[Path, option("REC", "The recording's folder, NAME.rec.", "-o", "--out")],
    target: Annotated[
        str | None, option("SOURCE", "The target's camera:1, video file or folder of images.", "--target-source")
    ] = None,
    seconds: Annotated[
        float | None, option("S", "Length; 60 for a scene, real sources run to their end or Ctrl-C.", min=0.1, max=1e6)
    ] = None,
    rate: Annotated[
        float | None,
        option("HZ", "Frames a second: of a scene or of images (15), or asked of cameras.", min=0.1, max=1e5),
    ] = None,
    target_rate: Annotated[
        float | None, option("HZ", "Frames a second of the scene's target camera (those of --rate).", min=0.1, max=1000)
    ] = None,
    seed: SeedIfGiven = None,
    changes: Changes = None,
    roll: Annotated[
        float | None, option("DEG", "Turn the scene's hand-held target about its axis, RMS in degrees (0).", min=0)
    ] = None,
    walk: Annotated[
        tuple[float, float] | None,
        option("M M", "Carry it from one distance to another during the recording, in metres."),
    ] = None,
    blink: Annotated[
        int | None,
        option(
            "N",
            "Blink the laser by the code of this number, any one: a scene's at the start, a real one by --blinker. "
            "`calibrate sync` wants the same.",
            min=0,
        ),
    ] = None,
    blinker: Annotated[
        str | None, option("PORT", "Of real sources: the serial port of the blink driver, /dev/ttyACM0 or COM3.")
    ] = None,
    align: Annotated[
        str | None, option("WAY", "Of real sources: how their clocks are aligned afterwards: clock (as is) or blink.")
    ] = None,
    offset: Annotated[
        str | None, option("TIME", "Of real sources: put the target's clock forward by this, such as '20 ms'.")
    ] = None,
    clutter: Annotated[
        int | None, option("N", "Add so many glints, lamps and tapes to the probe's picture.", min=0, max=100)
    ] = None,
    stray: Annotated[
        bool, typer.Option("--stray", help="Add a dim room, a gradient and the sensor's own pattern.")
    ] = False,
    guide: Annotated[
        bool, typer.Option("--guide", help="Draw afterwards which places of the target's field lack labels.")
    ] = False,
    no_labels: Annotated[bool, typer.Option("--no-labels", help="Do not look for the laser afterwards.")] = False,
    force: Force = False,
) -> None:
    """Record probe and target, and label every frame by the laser in the target's own video.

    The virtual bench films a scene's hand-held target; --seed, --set, --roll, --walk, --clutter, --stray and
    --target-rate are its own. Of real sources, the probe's and that of --target-source, both are read at once until
    they end; --align, --offset and --blinker are theirs. `tapetum cameras` lists what is plugged in.
    """
    if guide and no_labels:
        raise InputError("needs labels", where="--guide", remedy="leave --no-labels out")
    for name, value in (("--seconds", seconds), ("--rate", rate), ("--roll", roll), ("--target-rate", target_rate)):
        if value is not None and not math.isfinite(value):
            raise InputError(f"must be finite, is {value}", where=name, remedy="give a number")
    real = _is_real(source)
    if target is not None and not real:
        remedy = (
            "leave --target-source away, or give the probe's camera:0, video or folder (./NAME) in place of the scene"
        )
        if source in scene_names() or Path(source).exists():
            what = "is a scene of the virtual bench, which films its own target"
            raise InputError(what, where=source, remedy=remedy)
        raise InputError("does not exist", where=source, remedy="give the probe's camera:0, video or folder of images")
    clocks = _clocks(real, target is not None, blink, blinker, align, offset)
    own = {"seed": seed, "set": changes, "roll": roll, "walk": walk, "clutter": clutter, "target-rate": target_rate}
    for name, value in {**own, "stray": stray or None}.items():
        if real and value is not None:
            what = f"belongs to scenes of the virtual bench; {source} is a real source"
            raise InputError(what, where=f"--{name}", remedy="leave it away")
    if target is not None and not _is_real(target):
        what = "is no camera, video or folder of images"
        if target in scene_names() or Path(target).exists():
            what = "is a scene of the virtual bench, not a real target"
        where = f"--target-source {target}"
        raise InputError(what, where=where, remedy="give camera:1, a video file or a folder of images")
    if real:
        check_output(out, force, "tapetum-recording", sources=[source, *filter(None, [target])])
        recording = _capture(source, target, out, seconds, rate, force, clocks)
    else:
        scene = _scene(source, changes)
        check_output(out, force, "tapetum-recording")
        session = _session(scene, seconds or 60.0, rate or 15.0, {**own, "blink": blink}, stray)
        recording = _film(scene, session, out, force)
    if recording is not None and not no_labels:
        _label(recording)
        if guide:
            _guide(recording)


def _is_real(source: str) -> bool:
    """Whether a source is a camera or frames on disk, not a scene."""
    from tapetum.record.frames import is_device

    path = Path(source)
    if is_device(source):
        return True
    if source in scene_names() or not path.exists():
        return False
    if path.is_dir() or path.suffix.lower() in (".yaml", ".yml"):
        return path.is_dir()
    with path.open("rb") as stream:
        return b"tapetum/scene/" not in stream.read(4096)


def _scene(source: str, changes: list[str] | None) -> Scene:
    try:
        return load_scene(source, changes or ())
    except InputError as error:
        if error.what != "no such scene":
            raise
        remedy = f"{error.remedy}; or the probe's camera:0, video file or folder of images"
        raise InputError("no such scene, file or folder", where=source, remedy=remedy) from error


def _session(scene: Scene, seconds: float, rate: float, own: dict[str, Any], stray: bool) -> Session:
    """Return the session of the virtual bench with the given options."""
    from tapetum.record import BlinkCode, HandMotion, Session, draw_clutter, draw_stray

    seed = SEED if own["seed"] is None else own["seed"]
    return Session(
        seconds,
        rate,
        seed,
        motion=HandMotion(roll=math.radians(own["roll"] or 0.0), walk=own["walk"]),
        code=None if own["blink"] is None else BlinkCode(seed=own["blink"]),
        clutter=draw_clutter(scene, seed, own["clutter"] or 0),
        stray=draw_stray(scene, seed) if stray else (),
        target_rate=own["target-rate"],
    )


def _film(scene: Scene, session: Session, out: Path, force: bool) -> Recording:
    from tapetum.record import film

    with says_what_is_kept("film it again for a whole one"):
        recording = film(scene, out, session, progress=bar, overwrite=force)
    typer.echo(f"{out}: {session.seconds:g} s, {len(recording.frames('probe'))} probe frames, seed {session.seed}")
    return recording


def _label(recording: Recording) -> None:
    """Label a finished recording, which stays when that fails."""
    from tapetum.record import label_recording

    try:
        summary = label_recording(recording, bar)
    except (InputError, KeyboardInterrupt) as error:
        error.add_note(f"the recording is kept in {recording.path}, without labels")
        with says_what_is_kept("label it by tapetum.record.label_recording"):
            raise
    typer.echo(f"labelled {summary.labelled} of {summary.n} frames")


def _guide(recording: Recording) -> None:
    """Draw which places of the field the labels reach."""
    import numpy as np

    from tapetum.data.field import labels_guide

    table = recording.labels()
    assert table is not None  # it has just been labelled
    gaze = np.stack([table.column(name).to_numpy(zero_copy_only=False) for name in ("gaze_x", "gaze_y")], axis=1)
    typer.echo("labels over the target's field, as its picture shows it (# enough, + few, . none):")
    typer.echo(labels_guide(gaze.astype(float)))


def _same(probe: str, target: str) -> bool:
    """Whether two sources are the same; a recording holds both streams."""
    if Path(probe).exists() and Path(target).exists():
        return Path(probe).samefile(target) and not (Path(probe) / "recording.json").exists()
    return probe == target


@dataclass(frozen=True)
class _Clocks:
    """How the clocks of real sources are brought together."""

    code: BlinkCode | None = None
    port: str | None = None
    align: str = "clock"
    offset: float = 0.0


def _clocks(
    real: bool, two: bool, blink: int | None, port: str | None, align: str | None, offset: str | None
) -> _Clocks:
    """Check the options of clocks."""
    given = {"--blinker": port, "--align": align, "--offset": offset}
    for name, value in given.items():
        if value is not None and not real:
            raise InputError("belongs to real sources", where=name, remedy="leave it away: the bench has one clock")
        if value is not None and not two and name != "--blinker":
            raise InputError("takes two streams", where=name, remedy="give --target-source")
    one_of(align or "clock", ("clock", "blink"), "--align")
    if not real:
        return _Clocks()
    if port is not None and blink is None:
        raise InputError("has no code to blink", where="--blinker", remedy="give its number too: --blink 1")
    seconds = 0.0
    if offset is not None:
        try:
            seconds = to_si(offset, "s")
        except ValueError as error:
            what, _, remedy = str(error).partition("; ")
            raise InputError(what, where="--offset", remedy=remedy or None) from error
        if not abs(seconds) <= _MOST_OFFSET:
            what = f"{offset} is no difference of two clocks"
            raise InputError(what, where="--offset", remedy=f"give at most {_MOST_OFFSET:.0g} s")
    code = None
    if blink is not None:
        from tapetum.record import BlinkCode

        code = BlinkCode(seed=blink, start=0.0, every=None if port is None else EVERY)
    return _Clocks(code, port, align or "clock", seconds)


def _aligned(recording: Recording, clocks: _Clocks) -> Recording:
    """Bring the target's clock of a real recording to the probe's, as asked."""
    told: dict[str, Any] = {"align": clocks.align, "offset": clocks.offset}
    seconds = clocks.offset
    if clocks.align == "blink":
        from tapetum.data.importing.align import align_blink, brightness

        names = ("probe", "target")
        levels = [brightness(recording.source(name), bar, f"blinking of {name}") for name in names]
        # The levels' times count from each stream's own first frame.
        apart = float(recording.utc_ns("target")[0] - recording.utc_ns("probe")[0]) / 1e9
        found = align_blink(levels[0], (levels[1][0] + apart, levels[1][1]), where=str(recording.path))
        seconds += found.offset
        told["blink"] = vars(found)
        typer.echo(f"aligned by the blinking: {found.text}")
    if not seconds:
        return recording
    from tapetum.record.aligning import shift_stream

    return shift_stream(recording, "target", seconds, told)


def _capture(
    probe: str, target: str | None, out: Path, seconds: float | None, rate: float | None, force: bool, clocks: _Clocks
) -> Recording | None:
    """Record real sources; return the recording where it can be labelled."""
    if target is not None and _same(probe, target):
        raise InputError("is both probe and target", where=probe, remedy="give two sources")
    from tapetum.record import open_frames, open_recording
    from tapetum.record.capture import capture

    sources = {"probe": open_frames(probe, "probe", rate=rate, late=True)}
    if target is not None:
        try:
            sources["target"] = open_frames(target, "target", rate=rate, late=True)
        except InputError:
            sources["probe"].close()
            raise
    if seconds is None and any(source.live for source in sources.values()):
        typer.echo("recording until Ctrl-C", err=True)
    extra = {} if clocks.code is None else {"laser": {"code": {**vars(clocks.code), "word": list(clocks.code.sent)}}}
    with contextlib.ExitStack() as stack:
        begun = None
        try:
            if clocks.port is not None and clocks.code is not None:
                begun = _driver(stack, clocks.port, clocks.code)
        except InputError:
            for source in sources.values():
                source.close()
            raise
        with says_what_is_kept():
            told = capture(sources, out, seconds=seconds, progress=bar, overwrite=force, extra=extra, begun=begun)
    counts = ", ".join(f"{one.frames} {name} frames ({one.lost} lost)" for name, one in told.items())
    typer.echo(f"{out}: {counts}")
    for name, one in told.items():
        if one.fault is not None:
            typer.echo(f"{name} ended early: {one.fault}", err=True)
    if target is None:
        typer.echo("no target was recorded: no labels")
    if target is None or not all(one.frames for one in told.values()):
        return None
    with says_what_is_kept():
        try:
            return _aligned(open_recording(out), clocks)
        except (InputError, KeyboardInterrupt) as error:
            error.add_note(f"the recording is kept in {out}, with its clocks as they were")
            raise


def _driver(stack: contextlib.ExitStack, port: str, code: BlinkCode) -> Callable[[], None]:
    """Open the blink driver, which switches the laser off in the end; return what begins the code."""
    from tapetum.record.blinker import Blinker

    driver = stack.enter_context(Blinker(port))
    stack.callback(driver.off)
    driver.on()
    return lambda: driver.code(code)
