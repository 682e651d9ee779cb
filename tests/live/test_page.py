"""The page in a real Chromium, on the drawn room."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from tests.live.pages import CHROMIUM, WAIT, free_port, serving, slow_room, until

from tapetum.live.log import Log
from tapetum.live.loop import Watch

pytestmark = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed: apt install chromium")


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
    with serving(port, Watch(slow_room, name="demo", log=Log(log))) as address:
        page.goto(address)
        until(page, "document.querySelectorAll('.camera').length >= 2")
        page.wait_for_selector("#connected:text('live')", timeout=WAIT)
        # Events follow the state that they led to, by a message of their own each.
        until(page, "document.querySelectorAll('.event').length >= 2")
        # The picture moves: its marks are drawn where the cameras are now.
        before = page.evaluate("document.getElementById('view').toDataURL()")
        until(page, "b => document.getElementById('view').toDataURL() !== b", before)
        until(page, "document.getElementById('view').width === 640")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "the page is wider than the window"
        # By keyboard: choose the second camera and ignore it as one of ours.
        chosen = ignore_next(page)
        assert "1 of ours" in page.locator("#ignored").inner_text()
        page.wait_for_selector(f".camera[data-id='{chosen}']", state="detached", timeout=WAIT)
        assert page.locator("#ours-list li:has-text('pixels of')").count() == 1
        page.wait_for_selector(".event:has-text('is gone')", timeout=WAIT)
    page.wait_for_selector("#connected:text('does not answer')", timeout=WAIT)
    known = page.locator(".event").count()
    with serving(port, Watch(slow_room, name="demo", log=Log(log))):
        page.wait_for_selector("#connected:text('live')", timeout=WAIT)
        # Its numbers go on with the log's: what happens is added to what was shown.
        until(page, "n => document.querySelectorAll('.event').length > n", known)
    page.close()
    assert not faults


def test_keys_hold_for_cameras_that_come_and_go_between_two_drawings(chromium: Any) -> None:
    page = chromium.new_page()
    # Within one step of the script nothing is drawn and no frame of the watch comes between.
    step = """async () => {
        const { flood, now } = await import('/static/socket.js');
        const press = (key) => document.body.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true }));
        const here = (...cameras) => flood({ ...now.state, cameras });
        const one = { id: 'first', x: 100, y: 100, diameter: 9, seen: true, since_utc_ns: now.state.utc_ns,
            gaze_x: null, gaze_y: null, regions: [], active: null, device: null }, other = { ...one, id: 'second' };
        document.activeElement.blur();
        here(one);
        press('ArrowDown');
        const focused = document.activeElement.closest('.camera')?.dataset.id;
        here(other);
        press('i');
        return [focused, document.getElementById('refused').textContent];
    }"""
    with serving(free_port(), Watch(slow_room)) as address:
        page.goto(address)
        until(page, "document.querySelectorAll('.camera').length >= 1")
        focused, refused = page.evaluate(step)
    page.close()
    assert focused == "first"
    assert "no longer here" in refused


def ignore_next(page: Any) -> str:
    """Choose the next camera by keyboard and ignore it; again where a busy machine's watch loses it in between."""
    end = time.monotonic() + WAIT / 1000
    while time.monotonic() < end:
        page.keyboard.press("ArrowDown")
        chosen = page.evaluate("document.activeElement.closest('.camera.chosen')?.dataset.id")
        if chosen:
            # What an earlier key was told must not answer this one.
            page.evaluate("document.getElementById('refused').hidden = true")
            page.keyboard.press("i")
            until(page, "!['ours', 'refused'].every(id => document.getElementById(id).hidden)")
            if page.locator("#ours").is_visible():
                return chosen
    raise AssertionError("no camera could be ignored by keyboard")
