"""Events and states for the tests of outputs, and waiting for a thread without a clock's judgement."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

from tapetum.live import CameraState, Event, Health, State

UTC = 1_790_000_000_123_456_789

CAMERA = CameraState(
    id="a1b2",
    track=3,
    x=320.5,
    y=200.25,
    diameter=14.0,
    seen=True,
    since_utc_ns=UTC - 10**9,
    seen_utc_ns=UTC,
    snr=21.5,
    active=True,
    device="phone-03",
    device_probability=0.75,
    gaze_x=(0.25, 0.125, 0.375),
    gaze_y=(-0.5, -0.625, -0.375),
    regions=("door",),
)
PLAIN = replace(
    CAMERA, id="c3d4", track=4, snr=None, active=None, device=None, device_probability=None, gaze_x=None, gaze_y=None
)


def make_event(number: int = 0, kind: str = "seen") -> Event:
    """The event of that number."""
    return Event(f"event-{number}", "new", kind, UTC, "", None, CAMERA)


def make_state(number: int = 0, *cameras: CameraState, **more: object) -> State:
    """The state after a frame, a tenth of a second after the one before."""
    utc = UTC + number * 10**8
    seen = tuple(replace(one, seen_utc_ns=utc) for one in cameras)
    return State("room", number, utc, (640, 480), seen, Health(rate=10.0, connected=True), **more)  # pyright: ignore


def until(true: Callable[[], bool], seconds: float = 20.0) -> None:
    """Wait for what another thread does; fail when it never does."""
    for _ in range(round(seconds * 200)):
        if true():
            return
        threading.Event().wait(0.005)
    raise AssertionError("waited in vain")
