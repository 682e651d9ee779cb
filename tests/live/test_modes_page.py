"""The views of the modes in a real Chromium: calibrate, vote, alert, scan, record."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import pytest
from tests.live.pages import CHROMIUM, WAIT, free_port, serving, slow_room, until

from tapetum.live import guide
from tapetum.live.guard import Guard
from tapetum.live.loop import Watch
from tapetum.live.modes import Modes
from tapetum.live.rules import rules_from_text
from tapetum.record.drawn_room import DrawnRoom
from tapetum.record.hand import Aim, Hands
from tapetum.record.recording import open_recording

pytestmark = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed: apt install chromium")


@contextmanager
def opened(chromium: Any, address: str, width: int = 1400) -> Iterator[Any]:
    """A page that fails the test where it raises, breaks its policy or is wider than its window."""
    faults: list[str] = []
    page = chromium.new_page(viewport={"width": width, "height": 900})
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda message: faults.append(message.text) if "Content Security" in message.text else None)
    page.goto(address)
    yield page
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "the page is wider than the window"
    page.close()
    assert not faults


def test_alerts_are_shown_and_acknowledged_and_the_source_is_recorded(chromium: Any, tmp_path: Path) -> None:
    rules = "schema: tapetum/rules/1\nrules: [{name: a camera is here}, {name: it images, when: {imaging: true}}]"
    watch = Watch(slow_room, name="demo", guard=Guard(rules_from_text(rules)))
    with serving(free_port(), watch, lambda one: Modes(one, tmp_path)) as address, opened(chromium, address) as page:
        # Two cameras, or more where a busy machine's watch loses one and finds it again.
        until(page, "Number(document.getElementById('waiting').textContent) >= 2")
        page.keyboard.press("r")
        page.wait_for_selector("#record.running", timeout=WAIT)
        # A view by its key.
        page.keyboard.press("4")
        page.wait_for_selector("#view-guard:not([hidden])", timeout=WAIT)
        assert page.locator("#tab-guard").get_attribute("aria-current") == "page"
        page.wait_for_selector(".rule:has-text('on guard')", timeout=WAIT)
        assert page.locator(".rule").count() == 2
        until(page, "document.querySelector('.alert-row img')?.naturalWidth > 0")
        page.locator(".alert-row button").first.click()
        until(page, "document.querySelectorAll('.alert-row.done').length === 1")
        rows = "document.querySelectorAll('.alert-row:not(.done)').length"
        until(page, f"Number(document.getElementById('waiting').textContent) === {rows}")
        assert "a camera is here" in page.locator("#alert-now").inner_text()
        until(page, "Number(document.getElementById('record').title.match(/: (\\d+) frames/)?.[1]) >= 10")
        page.click("#record")
        page.wait_for_selector("#record:text('Record')", timeout=WAIT)
    (made,) = tmp_path.glob("*.rec")
    assert len(list(open_recording(made).source("probe"))) >= 10


def test_a_pair_of_pictures_is_searched_and_a_walk_mapped(chromium: Any, tmp_path: Path) -> None:
    room = DrawnRoom()
    for name, lit in (("lit.png", True), ("dark.jpg", False)):
        cv2.imwrite(str(tmp_path / name), room.picture(1.0, lit=lit))
    (tmp_path / "no.png").write_bytes(b"nothing")
    with serving(free_port(), Watch(slow_room, name="demo")) as address, opened(chromium, f"{address}#scan") as page:
        assert "no candidate does not mean no camera" in page.locator("#range").inner_text()
        page.set_input_files("#lit", tmp_path / "lit.png")
        page.set_input_files("#dark", tmp_path / "dark.jpg")
        page.click("#send")
        page.wait_for_selector("#found-title:text('2 worth a look')", timeout=WAIT)
        until(
            page, "[...document.querySelectorAll('.tile.likely img')].filter(one => one.naturalWidth > 0).length === 4"
        )
        until(page, "document.getElementById('found-view').width === 640")
        page.set_input_files("#lit", tmp_path / "no.png")
        page.click("#send")
        page.wait_for_selector("#upload-say:text('is no JPEG')", timeout=WAIT)
        page.click("#walk")
        page.wait_for_selector("#walk:text('End')", timeout=WAIT)
        until(page, "document.querySelectorAll('#sightings li').length >= 2")
        page.wait_for_selector("#walk-say:text('was seen for long enough')", timeout=WAIT)
        page.click("#walk")
        page.wait_for_selector("#advice:text('Ended')", timeout=WAIT)


class _Looks:
    """Stands for a model of gaze that takes no time: it reads the gaze that the simulated hand had, with noise."""

    target_names = ("gaze_x", "gaze_y")

    def __init__(self, hands: list[Hands]) -> None:
        self.hands = hands

    def predict(self, crops: Any, full_scale: float) -> Any:
        gazes = [one.latest for one in self.hands[-1]._hands][: len(crops)]

        class Said:
            def columns(self) -> dict[str, list[Any]]:
                said: dict[str, list[Any]] = {"applies": [True] * len(crops), "reason": [""] * len(crops)}
                for axis, name in enumerate(("gaze_x", "gaze_y")):
                    value = [float(gaze[axis]) for gaze in gazes]
                    ends = {"": 0.0, "_low": -0.002, "_high": 0.002}
                    said |= {f"{name}{end}": [one + by for one in value] for end, by in ends.items()}
                return said

        return Said()


@pytest.fixture(scope="module")
def exhibit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A served watch of one simulated hand, which moves on until the file's last test: no other follows these."""
    aim, hands = Aim(), []
    aim.patience = 60.0

    def opens() -> Hands:
        hands.append(Hands("hand", aim))
        return hands[-1]

    watch = Watch(opens, name="hand", detector="spots", models=[_Looks(hands)])  # pyright: ignore[reportArgumentType]
    folder = tmp_path_factory.mktemp("kept")
    with serving(free_port(), watch, lambda one: Modes(one, folder, 1), aim) as address:
        yield address


def test_a_hand_is_calibrated_by_the_page_and_points_where_the_mouse_is(
    chromium: Any, exhibit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A simulated hand is at a mark sooner than a person's, and rests there.
    monkeypatch.setattr(guide, "_SETTLE", 0.3)
    monkeypatch.setattr(guide, "_WINDOW", 0.3)
    with opened(chromium, f"{exhibit}#exhibit") as page:
        page.wait_for_selector("#self-line", state="visible", timeout=WAIT)
        page.select_option("#calibrate-marks", "4")
        page.click("#calibrate button[type=submit]")
        page.wait_for_selector("#step:text('of 4')", timeout=WAIT)
        page.wait_for_selector("#step:text('Calibrated')", timeout=WAIT)
        error = float(page.locator("#error-px").inner_text().split()[0])
        assert error < 60 and "°" in page.locator("#error-deg").inner_text()
        box = page.locator("#stage").bounding_box()
        until(page, "document.querySelectorAll('#pointing li').length === 1")

        def pointed() -> tuple[float, float]:
            x, y = (float(one.split()[0]) for one in page.locator("#pointing li span").last.inner_text().split(","))
            return x / box["width"], y / box["height"]

        end = time.monotonic() + WAIT / 1000
        there = False
        while not there and time.monotonic() < end:
            for step in (0, 1):
                page.mouse.move(box["x"] + 0.75 * box["width"] + step, box["y"] + 0.3 * box["height"])
                time.sleep(0.1)
            x, y = pointed()
            there = abs(x - 0.75) < 0.08 and abs(y - 0.3) < 0.1
        assert there, f"the hand points at {x:.2f}, {y:.2f}"
        # By keyboard, too: the hand goes to the left.
        page.focus("#stage")
        for _ in range(8):
            page.keyboard.press("ArrowLeft")
            time.sleep(0.1)
        until(
            page,
            "x => Number(document.querySelector('#pointing li span:last-child').textContent.split(',')[0]) < x",
            x * box["width"] - 100,
        )


@pytest.mark.parametrize("width", [400, 1400])
def test_a_vote_is_asked_counted_ended_and_replayed(chromium: Any, exhibit: str, width: int) -> None:
    with opened(chromium, f"{exhibit}#vote", width) as page:

        def point(x: float) -> None:
            page.evaluate(
                "x => fetch('/api/hand', {method: 'POST', headers: {'content-type': 'application/json'},"
                " body: JSON.stringify({x, y: 0.5})})",
                x,
            )

        # Who points to the left votes for the answer on the left. The hand is there before the vote begins: it
        # has another place yet where another test left it, which a slow page would have counted.
        point(0.1)
        page.fill("#question", "Tea or coffee?")
        page.fill("#answers", "Tea\nCoffee")
        page.fill("#dwell", "0.5")
        page.click("#vote button[type=submit]")
        page.wait_for_selector("#ballot-title:text('Tea or coffee?')", timeout=WAIT)
        until(page, "document.querySelector('#tally li b')?.textContent === '1'")
        point(0.9)
        until(page, "[...document.querySelectorAll('#tally b')].map(one => one.textContent).join() === '0,1'")
        page.click("#vote-end")
        page.wait_for_selector("#replay-say:text('voice 2 of 2')", timeout=WAIT)
        page.focus("#replay-at")
        page.keyboard.press("ArrowLeft")
        until(page, "[...document.querySelectorAll('#tally b')].map(one => one.textContent).join() === '1,0'")
