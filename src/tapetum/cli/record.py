"""`tapetum record`: a recording, from the virtual bench or from real cameras and files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tapetum.bench import load_scene, scene_names
from tapetum.cli.inputs import check_replaceable, says_what_is_kept
from tapetum.errors import InputError
from tapetum.progress import bar

if TYPE_CHECKING:
    from tapetum.bench import Scene
    from tapetum.record import Recording, Session

_SCENE_MARK = "tapetum/scene/"


@dataclass(frozen=True)
class _Bench:
    """What a person asks of the virtual bench; None and False for what was not asked for."""

    seed: int | None
    changes: list[str] | None
    roll: float | None
    walk: tuple[float, float] | None
    blink: int | None
    clutter: int | None
    stray: bool

    def given(self) -> str | None:
        """The first option of these that was given."""
        names = {"changes": "set"}
        found = (name for name, value in vars(self).items() if value is not None and value is not False)
        return next((f"--{names.get(name, name)}" for name in found), None)

    def session(self, scene: Scene, seconds: float, rate: float) -> Session:
        """The take that it asks for."""
        from tapetum.record import BlinkCode, HandMotion, Session, draw_clutter, draw_stray

        seed = self.seed or 0
        return Session(
            seconds,
            rate,
            seed,
            motion=HandMotion(roll=math.radians(self.roll or 0.0), walk=self.walk),
            code=None if self.blink is None else BlinkCode(seed=self.blink),
            clutter=draw_clutter(scene, seed, self.clutter or 0),
            stray=draw_stray(scene, seed) if self.stray else (),
        )


def record(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SCENE_OR_PROBE",
            help="A scene for the virtual bench (hand-held, or a YAML file); or the probe's camera:0, video or images.",
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="REC", help="The recording's folder, NAME.rec.")],
    target: Annotated[
        str | None,
        typer.Option(metavar="TARGET", help="The target's camera:1, video file or folder of images."),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(metavar="S", help="Length; a scene's is 60, real sources run to their end or Ctrl-C.", min=0.1),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Frames a second: of a scene or of images (15), or asked of cameras.", min=0.1),
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Of everything random in a scene (0).", min=0)] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change any field of the scene; may be repeated."),
    ] = None,
    roll: Annotated[
        float | None,
        typer.Option(metavar="DEG", help="Turn the scene's hand-held target about its axis, RMS (0).", min=0),
    ] = None,
    walk: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="M M", help="Carry it from one distance to another during the recording, in metres."),
    ] = None,
    blink: Annotated[
        int | None,
        typer.Option(metavar="N", help="Blink the laser at the start, by the code of this number.", min=0),
    ] = None,
    clutter: Annotated[
        int | None,
        typer.Option(metavar="N", help="Add so many glints, lamps and tapes to the probe's picture.", min=0, max=100),
    ] = None,
    stray: Annotated[
        bool, typer.Option("--stray", help="Add a dim room, a gradient and the sensor's own pattern.")
    ] = False,
    no_labels: Annotated[bool, typer.Option("--no-labels", help="Do not look for the laser afterwards.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a recording of this name.")] = False,
) -> None:
    """Record probe and target, and label every frame by the laser in the target's own video.

    The virtual bench films a scene's hand-held target; --seed, --set, --roll, --walk, --blink, --clutter and --stray
    are its own. Real sources (--target) are read both at once until they end.
    """
    bench = _Bench(seed, changes, roll, walk, blink, clutter, stray)
    for name, value in (("--seconds", seconds), ("--rate", rate), ("--roll", roll)):
        if value is not None and not math.isfinite(value):
            raise InputError(f"must be finite, is {value}", where=name, remedy="give a number")
    if not _is_real(source):
        if target is not None and source not in scene_names() and not Path(source).exists():
            remedy = "give the probe's camera:0, video file or folder of images"
            raise InputError("does not exist", where=source, remedy=remedy)
        if target is not None:
            remedy = "leave --target away, or give the probe's camera:0, video or folder (./NAME) in the scene's place"
            raise InputError("is a scene of the virtual bench, which films its own target", where=source, remedy=remedy)
        _film(source, out, seconds or 60.0, rate or 15.0, bench, no_labels, overwrite)
        return
    option = bench.given()
    if option is not None:
        what = f"belongs to scenes of the virtual bench; {source} is a real source"
        raise InputError(what, where=option, remedy="leave it away")
    if target is not None and not _is_real(target):
        what = "is no camera, video or folder of images"
        if target in scene_names() or Path(target).exists():
            what = "is a scene of the virtual bench, not a real target"
        raise InputError(what, where=f"--target {target}", remedy="give camera:1, a video file or a folder of images")
    _capture(source, target, out, seconds, rate, no_labels, overwrite)


def _is_real(source: str) -> bool:
    """Whether a source is a camera or frames on disk; anything else is a scene, or nothing."""
    from tapetum.record.camera import is_camera

    if is_camera(source):
        return True
    path = Path(source)
    if source in scene_names() or not path.exists():
        return False
    if path.is_dir():
        return True
    if path.suffix.lower() in (".yaml", ".yml"):
        return False
    with path.open("rb") as stream:
        return _SCENE_MARK.encode() not in stream.read(4096)


def _film(
    source: str,
    out: Path,
    seconds: float,
    rate: float,
    bench: _Bench,
    no_labels: bool,
    overwrite: bool,
) -> None:
    try:
        scene = load_scene(source, bench.changes or ())
    except InputError as error:
        if error.what != "no such scene":
            raise
        remedy = f"{error.remedy}; or the probe's camera:0, video file or folder of images"
        raise InputError("no such scene, file or folder", where=source, remedy=remedy) from error
    from tapetum.record import film

    session = bench.session(scene, seconds, rate)
    with says_what_is_kept("film it again for a whole one"):
        recording = film(scene, out, session, progress=bar, overwrite=overwrite)
    typer.echo(f"{out}: {seconds:g} s, {len(recording.frames('probe'))} probe frames, seed {session.seed}")
    if not no_labels:
        _label(recording)


def _label(recording: Recording) -> None:
    """Label a recording that is whole already."""
    from tapetum.record import label_recording

    try:
        summary = label_recording(recording, bar)
    except (InputError, KeyboardInterrupt) as error:
        error.add_note(f"the recording is kept in {recording.path}, without labels")
        with says_what_is_kept("label it by tapetum.record.label_recording"):
            raise
    typer.echo(f"labelled {summary.labelled} of {summary.n} frames")


def _same(probe: str, target: str) -> bool:
    """Whether two sources are one; a recording holds both streams."""
    if Path(probe).exists() and Path(target).exists():
        return Path(probe).samefile(target) and not (Path(probe) / "recording.json").exists()
    return probe == target


def _capture(
    probe: str,
    target: str | None,
    out: Path,
    seconds: float | None,
    rate: float | None,
    no_labels: bool,
    overwrite: bool,
) -> None:
    if target is not None and _same(probe, target):
        raise InputError("is both probe and target", where=probe, remedy="give two sources")
    check_replaceable(out, overwrite, "recording.json", "tapetum-recording")
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
    with says_what_is_kept():
        told = capture(sources, out, seconds=seconds, progress=bar, overwrite=overwrite)
    counts = ", ".join(f"{one.frames} {name} frames ({one.lost} lost)" for name, one in told.items())
    typer.echo(f"{out}: {counts}")
    for name, one in told.items():
        if one.fault is not None:
            typer.echo(f"{name} ended early: {one.fault}", err=True)
    if no_labels or not all(one.frames for one in told.values()):
        return
    if target is None:
        typer.echo("no target was recorded: no labels")
        return
    _label(open_recording(out))
