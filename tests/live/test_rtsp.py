"""`tapetum serve rtsp://…` from end to end, with a camera that demands a password, goes and returns."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from typing import Any

import numpy as np
import pytest
from tests.live.rtsp_server import RtspCamera, encoded

from tapetum.errors import InputError
from tapetum.record.frames import open_frames

# FFmpeg watches twenty frames before it gives the first.
RATE = 50


def _picture(k: int) -> np.ndarray:
    """A dark bench with one return, which sways."""
    image = np.random.default_rng(k).normal(12, 1, (240, 320)).clip(0, 255).astype(np.uint8)
    x = round(160 + 20 * np.sin(2 * np.pi * k / 100))
    image[110:122, x : x + 12] = 210
    return image


@pytest.fixture(scope="module")
def film() -> list[list[bytes]]:
    return encoded((_picture(k) for k in range(100)), RATE)


def test_an_rtsp_camera_is_watched_lost_and_found_again(film: list[list[bytes]]) -> None:
    camera = RtspCamera(film, RATE)
    address = f"rtsp://user:secret@127.0.0.1:{camera.port}/live?key=hidden"
    command = [sys.executable, "-m", "tapetum", "serve", address, "--detector", "spots", "--port", "0"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"}
    )
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    assert process.stdout is not None and process.stderr is not None
    try:
        line = process.stdout.readline()
        found = re.fullmatch(r"watching (rtsp://127\.0\.0\.1:\d+/live): (http://\S+)\n", line)
        assert found, line + process.stderr.read()

        def asked(path: str) -> Any:
            with opener.open(found[2] + path, timeout=30) as answer:
                return json.load(answer)

        def until(kind: str, count: int) -> list[dict[str, Any]]:
            end = time.monotonic() + 30
            while True:
                events = asked("api/events")
                if sum(one["kind"] == kind for one in events) >= count:
                    return events
                assert time.monotonic() < end, [one["kind"] for one in events]
                time.sleep(0.1)

        seen = until("seen", 1)[0]
        assert abs(seen["after"]["x"] - 165) < 30 and abs(seen["after"]["y"] - 115) < 4
        state = asked("api/state")
        assert state["health"]["connected"] and state["size"] == [320, 240] and state["health"]["fault"] == ""
        assert "secret" not in json.dumps(state) and "hidden" not in json.dumps(state)
        camera.off()
        lost = next(one for one in until("source lost", 1) if one["kind"] == "source lost")
        assert "secret" not in lost["detail"]
        time.sleep(0.7)
        camera.on()
        back = next(one for one in until("source returned", 1) if one["kind"] == "source returned")
        end = time.monotonic() + 30
        while not any(one["seen_utc_ns"] > back["utc_ns"] for one in asked("api/state")["cameras"]):
            assert time.monotonic() < end, "the camera's return is not seen again"
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0 and process.stderr.read() == ""
    finally:
        process.kill()
        process.wait()
        camera.off()
    # Each time it was asked without a password first, refused that, and took the one of the address.
    assert camera.refused >= 2 and camera.asked.count("PLAY") >= 2


def test_a_wrong_password_is_one_line(film: list[list[bytes]]) -> None:
    camera = RtspCamera(film, RATE)
    with pytest.raises(InputError, match=r"cannot be watched .*check address, user and password") as raised:
        open_frames(f"rtsp://user:guess@127.0.0.1:{camera.port}/live")
    camera.off()
    assert "guess" not in str(raised.value)
