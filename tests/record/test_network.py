"""Cameras of a network: a small server of MJPEG stands for one."""

from __future__ import annotations

import http.server
import itertools
import threading
import time
from collections.abc import Iterator
from typing import ClassVar

import cv2
import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.live.loop import Watch
from tapetum.record.drawn_room import DrawnRoom
from tapetum.record.frames import is_device, open_frames
from tapetum.record.network import NetworkCamera, is_network, without_password

ROOM = [cv2.imencode(".jpg", DrawnRoom().picture(k / 10, lit=True))[1].tobytes() for k in range(10)]


class _Camera(http.server.BaseHTTPRequestHandler):
    frames: ClassVar[int] = 12
    asked: ClassVar[list[str]] = []

    def do_GET(self) -> None:
        self.asked.append(self.path)
        if self.path.startswith("/list"):
            self.send_response(200)
            self.send_header("content-type", "application/vnd.apple.mpegurl")
            self.end_headers()
            self.wfile.write(b"#EXTM3U\n#EXTINF:1,\nfile:///etc/hostname\n")
            return
        if self.path.startswith("/file"):
            self.send_response(302)
            self.send_header("location", "file:///etc/hostname")
            self.end_headers()
            return
        self.send_response(200)
        self.send_header("content-type", "multipart/x-mixed-replace; boundary=next")
        self.end_headers()
        for k in range(self.frames):
            body = ROOM[k % len(ROOM)]
            self.wfile.write(b"--next\r\ncontent-type: image/jpeg\r\ncontent-length: %d\r\n\r\n" % len(body))
            self.wfile.write(body + b"\r\n")
            time.sleep(0.04)

    def log_message(self, format: str, *args: object) -> None:
        return


@pytest.fixture
def camera() -> Iterator[str]:
    _Camera.asked.clear()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), _Camera)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def test_frames_come_until_the_camera_goes(camera: str) -> None:
    source = open_frames(f"{camera}/video")
    assert isinstance(source, NetworkCamera) and source.live and source.count is None
    assert source.first().image.shape == (480, 640)
    frames = []
    with pytest.raises(InputError, match="gives no more pictures"):
        for one in source:
            frames.append(one)  # noqa: PERF402
    source.close()
    assert len(frames) >= 6 and all(one.image.dtype == np.uint8 for one in frames)
    assert all(a.time < b.time for a, b in itertools.pairwise(frames))


def test_a_watch_connects_again(camera: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tapetum.live.acquire._RETRY", (0.01, 0.02))
    watch = Watch(lambda: open_frames(f"{camera}/video"))
    watch.start()
    end = time.monotonic() + 20
    while not any(one["kind"] == "source returned" for one in watch.log.events()):
        assert time.monotonic() < end, "it did not connect again"
        time.sleep(0.05)
    watch.close()
    assert _Camera.asked.count("/video") >= 2


@pytest.mark.parametrize("path", ["list", "file"])
def test_neither_play_lists_nor_redirections_lead_to_files(camera: str, path: str) -> None:
    with pytest.raises(InputError, match="cannot be watched"):
        open_frames(f"{camera}/{path}")


def test_passwords_are_not_shown_and_what_is_not_there_is_an_error() -> None:
    with pytest.raises(InputError, match=r"rtsp://127\.0\.0\.1:9/live: cannot be watched") as caught:
        open_frames("rtsp://user:secret@127.0.0.1:9/live?key=hidden")
    assert "secret" not in str(caught.value) and "hidden" not in str(caught.value)
    assert without_password("https://a:b@camera.example/x@y?z=1") == "https://camera.example/x@y"
    assert is_network("RTSP://x") and not is_network("rtsp.mkv") and not is_network("file:///etc/passwd")
    assert is_device("rtsp://x")
