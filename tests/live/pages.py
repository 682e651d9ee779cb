"""A page served to a real Chromium, for the tests of the pages."""

from __future__ import annotations

import contextlib
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import uvicorn

from tapetum.live.app import make_app
from tapetum.live.loop import Watch
from tapetum.live.modes import Modes
from tapetum.live.modes.router import LARGEST, modes_router
from tapetum.record.drawn_room import DrawnRoom
from tapetum.record.hand import Aim

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)
WAIT = 60_000  # ms, at most: a busy machine shows a frame or two a second


def slow_room() -> DrawnRoom:
    """The drawn room at a rate whose search leaves the browser time."""
    return DrawnRoom(rate=8.0)


@contextlib.contextmanager
def serving(
    port: int,
    watch: Watch,
    modes: Callable[[Watch], Modes] = Modes,
    aim: Aim | None = None,
) -> Iterator[str]:
    """Serve a watch with its modes; yield the page's address."""
    board = modes(watch)
    watch.start()
    app = make_app(watch, routers=[modes_router(board, aim)], pushed=board.text, largest=LARGEST)
    settings = uvicorn.Config(app, port=port, log_level="error", ws="websockets-sansio", timeout_graceful_shutdown=1)
    server = uvicorn.Server(settings)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive(), "the server did not start"
            time.sleep(0.05)
        yield f"http://127.0.0.1:{port}/"
    finally:
        server.should_exit = True
        thread.join(20)


def until(page: Any, expression: str, given: Any = None) -> None:
    """Wait until an expression of the page holds: Playwright's own wait evaluates text, which the policy forbids."""
    end = time.monotonic() + WAIT / 1000
    while not page.evaluate(expression, given):
        assert time.monotonic() < end, f"never: {expression}"
        time.sleep(0.05)


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]
