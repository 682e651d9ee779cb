"""What a page, its clients and long watches may not do to a watch."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import psutil
import pytest
from tests.live.conftest import Scripted
from tests.live.pages import free_port, serving, slow_room

from tapetum.live.loop import Watch
from tapetum.live.modes import Modes
from tapetum.record.drawn_room import DrawnRoom
from tapetum.record.source import Frame


def _connect(port: int) -> socket.socket:
    """A WebSocket's client that shakes hands and reads nothing more."""
    one = socket.create_connection(("127.0.0.1", port))
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    one.sendall(
        b"GET /ws HTTP/1.1\r\nhost: 127.0.0.1\r\nupgrade: websocket\r\nconnection: Upgrade\r\n"
        b"sec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==\r\nsec-websocket-version: 13\r\n\r\n"
    )
    assert b"101" in one.recv(64)
    return one


def test_clients_that_stop_reading_cost_the_watch_no_frame_and_others_nothing() -> None:
    from websockets.sync.client import connect

    port = free_port()
    watch = Watch(DrawnRoom)
    with serving(port, watch):
        dead = [_connect(port) for _ in range(10)]
        with connect(f"ws://127.0.0.1:{port}/ws?pictures=false", max_size=None) as alive:
            end, seen, frames = time.monotonic() + 3, 0, watch.state.health.frames
            while time.monotonic() < end:
                alive.recv(timeout=5)
                seen += 1
        made = watch.state.health.frames - frames
        for one in dead:
            one.close()
    # It goes on, and who reads gets what there is.
    assert made >= 5 and seen >= made * 0.5
    assert watch.state.health.fault == ""


HOUR = 54_000  # frames of an hour at 15 a second


class _Fast(Scripted):
    """Frames over and over, as fast as they are taken."""

    total = 0

    def __iter__(self) -> Iterator[Frame]:
        for k in range(self.total):
            one = self.frames[k % len(self.frames)]
            yield Frame(k, k / 15, one.image)


def _bright(k: int) -> Frame:
    image = np.random.default_rng(k).normal(8, 1, (120, 160)).clip(0, 255).astype(np.uint8)
    # A camera that is there for a while, and gone for a while.
    image[50:58, 60 + k % 5 : 68 + k % 5] = 200
    if k % 40 < 25:
        image[80:88, 120:128] = 180
    return Frame(k, k / 15, image)


@pytest.mark.slow
def test_an_hour_of_frames_leaves_memory_flat() -> None:
    frames = [_bright(k) for k in range(40)]
    source = _Fast(frames)
    source.total = HOUR
    # Somebody comes and goes every 40 frames: that is two events each time.
    timing = {"confirm": 0.2, "gone": 0.3}
    watch = Watch(lambda: source, detector="spots", mode="all", timing=timing)
    modes = Modes(watch)
    modes.scan.start()
    process, sizes = psutil.Process(), []
    over = threading.Event()

    def look() -> None:
        while not over.wait(0.2):
            modes.text()
            watch.picture()
            sizes.append((watch.state.health.frames, process.memory_info().rss))

    thread = threading.Thread(target=look)
    thread.start()
    watch.start()
    try:
        assert watch.join(1500), "it took too long"
    finally:
        over.set()
        thread.join()
    assert watch.state.health.frames == HOUR and watch.log.newest > HOUR / 50
    warm = [size for count, size in sizes if 0.2 < count / HOUR < 0.4]
    late = [size for count, size in sizes if count / HOUR > 0.8]
    share = float(np.median(late) / np.median(warm))
    print(f"memory after a fifth of the hour to that at its end: 1 to {share:.3f}; {np.median(late) / 2**20:.0f} MB")
    assert share <= 1.05
    watch.close()


def test_the_page_keeps_no_memory_of_long_watches(chromium: Any) -> None:
    """Thousands of messages, cameras and pictures come; what the page holds stays bounded."""
    with serving(free_port(), Watch(slow_room)) as address:
        page = chromium.new_page(viewport={"width": 1000, "height": 800})
        page.goto(address)
        page.wait_for_selector(".camera", timeout=30_000)
        client = page.context.new_cdp_session(page)

        def held() -> int:
            client.send("HeapProfiler.collectGarbage")
            return int(client.send("Runtime.getHeapUsage")["usedSize"])

        # The page's own functions, with what a busy watch would send in hours.
        flood = """async ([from, to]) => {
            const { flood } = await import('/static/socket.js');
            for (let k = from; k < to; k++) {
                const camera = { id: `c${Math.floor(k / 20)}`, x: 100, y: 100, diameter: 9, seen: true,
                    since_utc_ns: k * 66e6, gaze_x: [0, -0.1, 0.1], gaze_y: [0, -0.1, 0.1], regions: [],
                    active: null, device: null };
                const health = { rate: 15, delay: 0.1, frames: k, lost: 0, refused: 0, connected: true,
                    ended: false, fault: '', receivers: [] };
                flood({ type: 'state', source: 'x', frame: 1e6 + k, utc_ns: 1e18 + k * 66e6, size: [640, 480],
                    cameras: [camera], health });
                flood({ type: 'event', event: { number: 1e6 + k, id: camera.id, kind: 'seen', utc_ns: 1e18,
                    detail: '', picture: false } });
                if (k % 200 === 0) await new Promise((done) => setTimeout(done, 0));
            }
        }"""
        page.evaluate(flood, [0, 1500])
        first = held()
        page.evaluate(flood, [1500, 4500])
        last = held()
        assert page.locator("#events li").count() <= 100
        page.close()
    assert last <= 1.025 * first + 150_000, (first, last)
