"""The page of the playground, in a real Chromium, behind the server's doors."""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import uvicorn
from playwright.sync_api import expect

from tapetum.bench import load_scene
from tapetum.live.doors import Doors
from tapetum.live.playground import apply
from tapetum.live.playground.router import make_play_app

WAIT = 30_000  # ms, at most


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    app = Doors(make_play_app(), ("127.0.0.1",), None)
    server = uvicorn.Server(uvicorn.Config(app, port=port, log_level="error", timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.02)
    yield f"http://127.0.0.1:{port}/"
    server.should_exit = True
    thread.join()


@pytest.fixture
def page(chromium: Any) -> Iterator[Any]:
    page = chromium.new_page(viewport={"width": 1400, "height": 1000})
    page.set_default_timeout(WAIT)
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda said: faults.append(said.text) if "Content Security" in said.text else None)
    yield page
    page.close()
    assert not faults


def test_a_slider_moves_the_picture_and_the_link_and_the_file_hold_the_scene(page, address, tmp_path):
    page.goto(address)
    took = page.locator(".took").first
    expect(took).to_contain_text("error within", timeout=WAIT)
    expect(page.locator(".bounds dd").first).to_contain_text("of field", timeout=WAIT)
    before = page.locator("canvas.image").first.screenshot()
    drawn = page.locator("html").get_attribute("data-drawn")
    slider = page.get_by_label("focused at", exact=True)
    slider.focus()
    page.keyboard.press("PageDown")
    expect(page.locator("html")).not_to_have_attribute("data-drawn", drawn, timeout=WAIT)
    assert page.locator("canvas.image").first.screenshot() != before
    link = page.url
    focus = float(re.search(r"a\.focus=([0-9.]+)", link)[1])
    assert 1 < focus < 5
    with page.expect_download() as saved:
        page.get_by_role("button", name="Save as YAML").click()
    saved.value.save_as(tmp_path / "scene.yaml")
    assert load_scene(tmp_path / "scene.yaml") == apply(load_scene("thin-lens"), {"focus": focus})


def test_what_the_engine_refuses_is_said_and_the_last_picture_dimmed(page, address):
    page.goto(f"{address}#a=thin-lens&a.focal_length=50")
    expect(page.locator(".took").first).to_contain_text("error within", timeout=WAIT)
    page.goto(f"{address}#a=thin-lens&a.focal_length=300&a.focus=0.25")
    expect(page.get_by_role("alert")).to_contain_text("focus farther away", timeout=WAIT)
    expect(page.locator(".side").first).to_have_class(re.compile("stale"))
    page.get_by_role("button", name="Reset").click()
    expect(page.locator(".side").first).not_to_have_class(re.compile("stale"), timeout=WAIT)


def test_two_scenes_stand_side_by_side_on_a_wide_page_and_below_on_a_narrow_one(page, address):
    # Stopped down, a traced lens takes a second or two and not five, which would go on under the tests after this one.
    page.goto(f"{address}#a=thin-lens&b=thin-lens&b.lens=cmount-12mm-f1.4&b.f_number=8&b.gaze_x=0.1")
    # `all` does not wait for a page that has not drawn its scenes yet.
    expect(page.locator(".took")).to_have_count(2, timeout=WAIT)
    for one in page.locator(".took").all():
        expect(one).to_contain_text("error within", timeout=WAIT)
    first, second = (one.bounding_box() for one in page.locator(".side").all())
    assert second["x"] > first["x"] + first["width"] - 1
    page.set_viewport_size({"width": 400, "height": 800})
    first, second = (one.bounding_box() for one in page.locator(".pictures").all())
    assert second["y"] >= first["y"] + first["height"] - 1
    # Nothing is wider than the page.
    assert page.locator("body").bounding_box()["width"] <= 400
