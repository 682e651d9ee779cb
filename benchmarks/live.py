"""The live watch: frames of five megapixels at 30 a second, with its page's socket read by other processes.

Frames are those of the tracking benchmark: drifting Gaussian spots, from memory. The model is the bundled ResNet-18 on
ONNX Runtime. The delay counts from a frame's arrival to the state that is published of it. There is no peer.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import uvicorn

from tapetum.live.app import make_app
from tapetum.live.events import Event
from tapetum.live.loop import Watch
from tapetum.live.state import State
from tapetum.models import NetworkEstimator, pretrained
from tapetum.models.fast import FastResNet18
from tapetum.record.source import Frame

from .measure import Effort, Figure, Row
from .tracking import made

TITLE = "The live watch: frames of 2592 × 1944 pixels, 30 a second, page open"
PEERS = ()
_RATE = 30.0
_WARM = 3.0

# Reads what the page reads, and leaves out the drawing.
_CLIENT = """
import asyncio, sys
from websockets.asyncio.client import connect
async def one():
    async with connect(sys.argv[1], max_size=None) as socket:
        async for _ in socket: pass
async def all(): await asyncio.gather(*(one() for _ in range(int(sys.argv[2]))))
asyncio.run(all())
"""

# The page itself, in a browser without a window. Chromium's sandbox refuses root.
_CHROMIUM = shutil.which("chromium")
_BROWSER = """
import os, sys, time
from playwright.sync_api import sync_playwright
with sync_playwright() as play:
    browser = play.chromium.launch(executable_path=sys.argv[2], args=["--no-sandbox"] if os.geteuid() == 0 else [])
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.goto(sys.argv[1])
    time.sleep(3600)
"""


class _Filmed:
    """The frames over and over, each at its time, until `close`; those whose time has passed are lost."""

    live, count, name, full_scale, rate = True, None, "made", 255, _RATE

    def __init__(self, frames: Sequence[Frame]) -> None:
        self.frames, self.over = frames, threading.Event()

    @property
    def hardware(self) -> dict[str, Any]:
        return {}

    def first(self) -> Frame:
        return self.frames[0]

    def __len__(self) -> int:
        raise TypeError("has no end")

    def close(self) -> None:
        self.over.set()

    def __iter__(self) -> Iterator[Frame]:
        start, number, before = time.monotonic_ns(), -1, -1
        # Forth and back, so that no spot leaps.
        rounds = [*self.frames, *self.frames[-2:0:-1]]
        while True:
            number = max(number + 1, int((time.monotonic_ns() - start) * _RATE / 1e9))
            moment = start + round(number / _RATE * 1e9)
            if self.over.wait(max(0.0, (moment - time.monotonic_ns()) / 1e9)):
                return
            image = rounds[number % len(rounds)].image
            yield Frame(number, number / _RATE, image, monotonic_ns=moment, lost=number - before - 1)
            before = number


class _Stamps:
    """Delays of the states, in seconds."""

    def __init__(self) -> None:
        self.delays: list[float] = []
        self.cameras: list[int] = []

    def event(self, event: Event) -> None:
        return

    def state(self, state: State) -> None:
        self.delays.append((time.monotonic_ns() - (state.monotonic_ns or 0)) / 1e9)
        self.cameras.append(len(state.cameras))

    def close(self) -> None:
        return


def watched(
    targets: int, model: Any, clients: int | None, seconds: float, budget: float | None = None
) -> tuple[float, float, float, float]:
    """Watch made frames, models by turns within a budget where one is given, for so many clients or a browser (None).

    Return seconds a frame, median and 99th percentile of the delay, and cameras a frame.
    """
    source, stamps = _Filmed(made(targets, 40)), _Stamps()
    models = [] if model is None else [model]
    watch = Watch(lambda: source, detector="spots", models=models, listeners=[stamps], budget=budget)
    server = uvicorn.Server(uvicorn.Config(make_app(watch), port=0, log_level="error", ws="websockets-sansio"))
    thread = threading.Thread(target=server.run)
    watch.start()
    thread.start()
    while not server.started:
        time.sleep(0.05)
    port = server.servers[0].sockets[0].getsockname()[1]
    if clients is None:
        assert _CHROMIUM is not None
        command = [sys.executable, "-c", _BROWSER, f"http://127.0.0.1:{port}/", _CHROMIUM]
    else:
        command = [sys.executable, "-c", _CLIENT, f"ws://127.0.0.1:{port}/ws", str(clients)]
    # A browser's own processes end with their group.
    readers = subprocess.Popen(command, start_new_session=True)
    try:
        time.sleep(_WARM if clients is not None else 4 * _WARM)
        begun, first = time.monotonic(), len(stamps.delays)
        time.sleep(seconds)
        delays, spent = stamps.delays[first:], time.monotonic() - begun
        assert readers.poll() is None, "the clients ended"
    finally:
        os.killpg(readers.pid, signal.SIGKILL)
        readers.wait()
        server.should_exit = True
        thread.join()
    return spent / len(delays), *np.quantile(delays, [0.5, 0.99]), float(np.mean(stamps.cameras[first:]))


def run(effort: Effort) -> list[Row]:
    """Three and thirty cameras with ResNet-18 on each, fifty clients, and a browser where there is one."""
    trained = pretrained()
    assert isinstance(trained, NetworkEstimator)
    network = FastResNet18(trained)
    seconds = effort.of(20, 2)
    rows = []
    for case, targets, model, clients, budget in (
        ("3 cameras, no model, 1 client", 3, None, 1, None),
        ("3 cameras, ResNet-18 on each, 1 client", 3, network, 1, None),
        ("3 cameras, ResNet-18 by turns in 20 ms, 1 client", 3, network, 1, 0.02),
        ("30 cameras, ResNet-18 on each, 1 client", 30, network, 1, None),
        ("30 cameras, ResNet-18 by turns in 20 ms, 1 client", 30, network, 1, 0.02),
        ("3 cameras, no model, 50 clients", 3, None, 50, None),
        ("3 cameras, ResNet-18 on each, the page open in Chromium here", 3, network, None, None),
        ("30 cameras, ResNet-18 by turns in 20 ms, the page open in Chromium here", 30, network, None, 0.02),
    ):
        if clients is None and _CHROMIUM is None:
            continue
        mean, middle, late, cameras = watched(targets, model, clients, seconds, budget)
        note = f"delay {middle * 1e3:.0f} ms, p99 {late * 1e3:.0f} ms; {cameras:.1f} cameras a frame"
        rows.append(Row(case, Figure.rate(mean, "frames"), note=note))
    return rows
