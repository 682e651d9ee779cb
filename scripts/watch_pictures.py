"""The pictures of the live watch in the documents, taken in Chromium: run it on a machine without other work.

.venv/bin/python scripts/watch_pictures.py [watch] [gaze] [exhibit] [vote] [guard] [scan]
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
from PIL import Image
from playwright.sync_api import sync_playwright

from tapetum.record.drawn_room import DrawnRoom

IMAGES = Path(__file__).parents[1] / "docs" / "images"
RULES = """schema: tapetum/rules/1
time_zone: Europe/Berlin
quiet: [{from: "08:00", to: "18:00", days: [mon, tue, wed, thu, fri]}]
regions: {model: [-0.2, -0.1, 0.2, 0.1]}
rules:
  - {name: a camera is here, hold: 1 s, quiet: []}
  - {name: it looks at the model, when: {looks_at: model}, cooldown: 20 s}
"""


def exhibit(page: Any, folder: Path) -> None:
    """Calibrate with nine marks, then draw an arc by the mouse."""
    page.wait_for_selector("#self-line", state="visible")
    page.click("#calibrate button[type=submit]")
    page.wait_for_selector("#step:text('Mark')")
    page.wait_for_selector("#step:text('Calibrated')")
    box = page.locator("#stage").bounding_box()
    for k in range(24):
        x, y = 0.5 + 0.3 * math.cos(k / 5), 0.5 + 0.32 * math.sin(k / 5)
        page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
        time.sleep(0.2)


def vote(page: Any, folder: Path) -> None:
    """Ask a question of three answers."""
    for name, text in (("question", "Which picture shall be shown next?"), ("answers", "The sea\nThe city\nThe wood")):
        page.fill(f"#{name}", text)
    page.click("#vote button[type=submit]")
    time.sleep(14)


def guard(page: Any, folder: Path) -> None:
    """Acknowledge the first of some alerts."""
    time.sleep(14)
    page.locator(".alert-row button").last.click()
    time.sleep(1)


def scan(page: Any, folder: Path) -> None:
    """Search a pair of pictures of the room, and begin a walk."""
    page.click("#walk")
    for name, lit in (("lit", True), ("dark", False)):
        cv2.imwrite(str(folder / f"{name}.jpg"), DrawnRoom().picture(10.0, lit=lit))
        page.set_input_files(f"#{name}", folder / f"{name}.jpg")
    page.click("#send")
    page.wait_for_selector(".tile")
    time.sleep(3)


BENCH = ["bench:hand-held", "--repeat", "--detector", "spots", "--model", "thin-lens-gaze"]
SHOTS: dict[str, tuple[str, list[str], str, int, Callable[[Any, Path], None]]] = {
    "watch": ("watch", ["demo"], "watch", 1172, lambda page, folder: time.sleep(12)),
    "gaze": ("watch-gaze", BENCH, "watch", 1017, lambda page, folder: time.sleep(12)),
    "exhibit": ("watch-exhibit", ["hand", "--folder", "kept"], "exhibit", 760, exhibit),
    "vote": ("watch-vote", ["hand:3"], "vote", 760, vote),
    "guard": ("watch-guard", ["demo", "--rules", "guard.yaml"], "guard", 520, guard),
    "scan": ("watch-scan", ["demo"], "scan", 1150, scan),
}
"""By name: the picture, what is served, the view, the window's height, and what is done in it."""


def shot(browser: Any, name: str, folder: Path) -> None:
    """Serve, open the view, act, and keep the picture."""
    picture, words, view, height, act = SHOTS[name]
    (folder / "guard.yaml").write_text(RULES, encoding="utf-8")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "tapetum", "serve", *words, "--port", str(port)]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL)
    try:
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        for _ in range(120):
            time.sleep(0.5)
            try:
                opener.open(f"http://127.0.0.1:{port}/api/state", timeout=5).close()
                break
            except OSError:
                continue
        page = browser.new_page(viewport={"width": 1400, "height": height}, color_scheme="light")
        page.set_default_timeout(120_000)
        page.goto(f"http://127.0.0.1:{port}/#{view}")
        act(page, folder)
        page.screenshot(path=folder / "shot.png")
        page.close()
    finally:
        process.terminate()
        process.wait(30)
    with Image.open(folder / "shot.png") as whole:
        small = whole.convert("RGB").resize((1050, round(whole.height * 0.75)), Image.Resampling.LANCZOS)
    small.quantize(160, dither=Image.Dither.NONE).save(IMAGES / f"{picture}.png", optimize=True)
    print(IMAGES / f"{picture}.png", flush=True)


def main() -> None:
    """Take the pictures that are named, or all."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shots", nargs="*", metavar="SHOT", help=f"of {', '.join(SHOTS)}; all by default")
    options = parser.parse_args()
    if unknown := set(options.shots) - set(SHOTS):
        parser.error(f"{', '.join(sorted(unknown))}: no such picture; choose of {', '.join(SHOTS)}")
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as play, tempfile.TemporaryDirectory() as folder:
        browser = play.chromium.launch(executable_path=chromium, args=arguments)
        for name in options.shots or SHOTS:
            shot(browser, name, Path(folder))


if __name__ == "__main__":
    main()
