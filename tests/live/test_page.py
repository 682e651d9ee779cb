"""The page in a real Chromium, on the drawn room."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from playwright.sync_api import sync_playwright

from tapetum.live.app import make_app
from tapetum.live.log import Log
from tapetum.live.loop import Watch
from tapetum.record.drawn_room import DrawnRoom

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)
pytestmark = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed: apt install chromium")
WAIT = 30_000  # ms, at most


@contextlib.contextmanager
def serving(port: int, log: Path) -> Iterator[str]:
    """Serve the drawn room; yield the page's address."""
    watch = Watch(DrawnRoom, name="demo", log=Log(log))
    watch.start()
    settings = uvicorn.Config(
        make_app(watch), port=port, log_level="error", ws="websockets-sansio", timeout_graceful_shutdown=1
    )
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


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with sync_playwright() as play:
        # Its sandbox refuses root.
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = play.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield browser
        browser.close()


@pytest.mark.parametrize("width", [400, 1400])
def test_the_page_shows_cameras_ignores_one_and_returns_after_a_restart(
    chromium: Any, tmp_path: Path, width: int
) -> None:
    faults: list[str] = []
    page = chromium.new_page(viewport={"width": width, "height": 900})
    page.on("pageerror", lambda error: faults.append(str(error)))
    # Nothing that the strict policy forbids is tried.
    page.on("console", lambda message: faults.append(message.text) if "Content Security" in message.text else None)
    port, log = free_port(), tmp_path / "log.db"
    with serving(port, log) as address:
        page.goto(address)
        until(page, "document.querySelectorAll('.camera').length >= 2")
        page.wait_for_selector("#connected:text('live')", timeout=WAIT)
        assert page.locator(".event").count() >= 2
        # The picture moves: its marks are drawn where the cameras are now.
        before = page.evaluate("document.getElementById('view').toDataURL()")
        until(page, "b => document.getElementById('view').toDataURL() !== b", before)
        assert page.evaluate("document.getElementById('view').width") == 640
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "the page is wider than the window"
        # By keyboard: choose the second camera and ignore it as one of ours.
        page.keyboard.press("ArrowDown")
        until(page, "document.activeElement.classList.contains('name')")
        chosen = page.locator(".camera.chosen").get_attribute("data-id")
        page.keyboard.press("i")
        page.wait_for_selector("#ignored:text('1 of ours')", timeout=WAIT)
        page.wait_for_selector(f".camera[data-id='{chosen}']", state="detached", timeout=WAIT)
        page.wait_for_selector(".event:has-text('is gone')", timeout=WAIT)
    page.wait_for_selector("#connected:text('does not answer')", timeout=WAIT)
    known = page.locator(".event").count()
    with serving(port, log):
        page.wait_for_selector("#connected:text('live')", timeout=WAIT)
        # Its numbers go on with the log's: what happens is added to what was shown.
        until(page, "n => document.querySelectorAll('.event').length > n", known)
    page.close()
    assert not faults
