"""`tapetum serve`: watch a source, and show it on a page."""

from __future__ import annotations

import contextlib
import socket
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tapetum.cli.models import find_model, warn_of_intervals
from tapetum.cli.options import Device, Models, WhoseIntervals, option
from tapetum.durable import sole_writer
from tapetum.errors import InputError, one_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tapetum.live.doors import Doors
    from tapetum.live.outputs import Queued
    from tapetum.models import Predictor

_PORT = 8750


def serve(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="demo, a room without hardware; hand or hand:3, simulated visitors; bench, to play with; camera:0, "
            "rtsp://…, video, folder, recording, bench:SCENE.",
        ),
    ],
    models: Models = None,
    detector: Annotated[
        str | None,
        option("NAME", "What finds them: cameras, in a room (default), or spots, in the beam of a dark bench."),
    ] = None,
    activity: Annotated[
        bool, typer.Option("--activity", help="Say of each camera if it images: of phones (see track --activity).")
    ] = False,
    budget: Annotated[
        float,
        option(
            "S",
            "Seconds a frame for all models; many cameras are estimated by turns. 0: all in each.",
            "--model-time",
            min=0,
        ),
    ] = 0.02,
    log: Annotated[
        Path | None, option("FILE", "Keep events and their pictures here, NAME.db; else they end with the command.")
    ] = None,
    days: Annotated[float, option("N", "Days that events are kept.", "--keep-days", min=0.01)] = 30.0,
    picture_days: Annotated[
        float, option("N", "Days that pictures of events are kept.", "--keep-picture-days", min=0.01)
    ] = 7.0,
    folder: Annotated[
        Path | None, option("DIR", "Where the page's recordings, votes and calibration go; else it keeps none.")
    ] = None,
    outputs: Annotated[
        list[str] | None,
        option(
            "TEXT",
            "Send events and states to a receiver: osc://…, mqtt://…, https://…, lsl:NAME, FILE.parquet; repeatable.",
            "--to",
        ),
    ] = None,
    rules: Annotated[
        Path | None, option("FILE", "Rules of a guard, YAML: when an alert is raised, and who gets it.")
    ] = None,
    every: Annotated[
        bool, typer.Option("--every-frame", help="Leave none of a stored source's frames out; else real time.")
    ] = False,
    repeat: Annotated[bool, typer.Option("--repeat", help="Begin a stored source again at its end.")] = False,
    rate: Annotated[
        float | None, option("HZ", "Frames a second asked of a camera, or of images.", min=0.1, max=1e5)
    ] = None,
    stream: Annotated[str, option("NAME", "Which stream of a recording.")] = "probe",
    address: Annotated[
        str, option("ADDRESS", "Where the page is served; others than this machine's own demand a token.")
    ] = "127.0.0.1",
    port: Annotated[int, option("N", "Port of the page; 0: a free one.", min=0, max=65535)] = _PORT,
    names: Annotated[
        list[str] | None,
        option("NAME", "A further name under which browsers ask for the page; several times.", "--host-name"),
    ] = None,
    token: Annotated[
        str | None,
        option("TEXT", "What browsers must bring, 16 characters or more; random where one is needed."),
    ] = None,
    browse: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
    unit: WhoseIntervals = None,
    device: Device = "auto",
) -> None:
    """Watch a source live: find cameras, follow them, and show them, with what happens, on a page.

    Ends with Ctrl-C; the page stays after a stored source's end. SOURCE bench shows the virtual bench with sliders.
    """
    # Before the imports, which take seconds: who forgot a watch that still runs is told at once.
    if token is not None and len(token) < 16:
        raise InputError(f"has {len(token)} characters", where="--token", remedy="give 16 or more, or leave it out")
    bound = _bound(address, port)
    from tapetum.live.app import make_app
    from tapetum.live.doors import is_loopback, make_token
    from tapetum.live.log import Log
    from tapetum.live.loop import Watch
    from tapetum.live.modes import Modes
    from tapetum.live.modes.router import LARGEST, modes_router
    from tapetum.record.frames import is_hands, open_frames
    from tapetum.record.hand import Aim, Hands, how_many
    from tapetum.record.network import is_network, without_password
    from tapetum.track.detector import DETECTORS
    from tapetum.track.pipeline import unsure_of

    # An address may hold a password.
    shown = without_password(source) if is_network(source) else source
    hands = is_hands(source) and not Path(source).exists()
    if hands and detector is None and not models:
        # What they are made for.
        detector, models = "spots", ["thin-lens-gaze"]
    detector = one_of(detector or "cameras", tuple(DETECTORS), "--detector")
    if token is None and not is_loopback(address):
        token = make_token()
    if source == "bench" and not Path(source).exists():
        from tapetum.live.doors import Doors
        from tapetum.live.playground.router import make_play_app

        _run(Doors(make_play_app(), _hosts(address, names), token), bound, token, "the playground", browse)
        return
    # Two watches would give the events of one log the same numbers. Without its folder the log itself is refused.
    with sole_writer(log) if log is not None and log.parent.is_dir() else contextlib.nullcontext():
        guard = None
        if rules is not None:
            from tapetum.live.guard import Guard
            from tapetum.live.rules import load_rules

            guard = Guard(load_rules(rules))
        listeners = _opened(outputs or ())
        aim = Aim() if hands else None
        watch = Watch(
            lambda: open_frames(source, stream, rate=rate) if aim is None else Hands(source, aim, rate),
            name=shown,
            detector=detector,
            models=[_quick(find_model(name, device, unit), device) for name in models or ()],
            mode="all" if every else "newest",
            repeat=repeat,
            log=Log(":memory:" if log is None else log, days=days, picture_days=picture_days),
            listeners=listeners,
            guard=guard,
            activity=activity,
            budget=budget or None,
        )
        try:
            modes = Modes(watch, folder, how_many(source) if hands else 0)
            if guard is not None:
                guard.rules.check_outputs({one.name for one in listeners}, str(rules))
                known = {name for model in watch.models for name in model.target_names}
                guard.rules.check_abilities(activity, known, str(rules))
            watch.start()
        except InputError:
            for one in listeners:
                one.close()
            raise
        warn_of_intervals(models or (), unsure_of(watch.models, watch.acquisition))
        app = make_app(
            watch,
            _hosts(address, names),
            token,
            [modes_router(modes, aim)],
            pushed=modes.text,
            largest=LARGEST,
        )
        _run(app, bound, token, f"watching {shown}", browse)


def _quick(model: Predictor, device: str) -> Predictor:
    """Return a network on ONNX Runtime where it computes on the processor and the extra `fast` is installed."""
    import importlib.util

    from tapetum.models import NetworkEstimator

    if not isinstance(model, NetworkEstimator) or importlib.util.find_spec("onnxruntime") is None:
        return model
    import torch

    if device not in ("auto", "cpu") or (device == "auto" and torch.cuda.is_available()):
        return model
    from tapetum.models.fast import FastResNet18

    fast = FastResNet18(model)
    fast.whose = model.whose
    return fast


def _opened(texts: Sequence[str]) -> list[Queued]:
    """Open the receivers; where one cannot be, those before it are closed."""
    from tapetum.live.outputs import open_output

    opened: list[Queued] = []
    try:
        for text in texts:
            opened.append(open_output(text))  # noqa: PERF401
    except InputError:
        for one in opened:
            one.close()
        raise
    return opened


def _hosts(address: str, names: list[str] | None) -> tuple[str, ...]:
    """Return the names under which browsers may ask."""
    own = () if address in ("0.0.0.0", "::") else (address.lower(),)
    return ("127.0.0.1", "localhost", "::1", *own, *(name.lower() for name in names or ()))


def _bound(address: str, port: int) -> socket.socket:
    """Return a socket at an address; InputError where there is none to be had."""
    try:
        family, *_, where = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)[0]
        bound = socket.socket(family, socket.SOCK_STREAM)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(where)
        # Who opens the printed address at once waits, and is not refused.
        bound.listen(128)
    except OSError as error:
        what = f"{address} port {port} cannot be used ({error.strerror or error})"
        raise InputError(what, where="--address, --port", remedy="give another port, or 0 for a free one") from error
    return bound


def _run(app: Doors, bound: socket.socket, token: str | None, doing: str, browse: bool) -> None:
    """Serve until Ctrl-C or SIGTERM."""
    from tapetum.errors import need

    uvicorn = need("uvicorn", "live")
    host, port = bound.getsockname()[:2]
    shown = "127.0.0.1" if host in ("0.0.0.0", "::") else host
    place = f"http://{f'[{shown}]' if ':' in shown else shown}:{port}/{f'?token={token}' if token else ''}"
    typer.echo(f"{doing}: {place}\nCtrl-C ends it.")
    if browse:
        threading.Timer(0.5, webbrowser.open, (place,)).start()
    settings = uvicorn.Config(
        app, log_level="warning", ws="websockets-sansio", ws_max_size=65536, timeout_graceful_shutdown=2, lifespan="on"
    )
    server = uvicorn.Server(settings)
    # uvicorn raises the signal again when it is done, which is no fault here.
    with contextlib.suppress(KeyboardInterrupt):
        server.run(sockets=[bound])
