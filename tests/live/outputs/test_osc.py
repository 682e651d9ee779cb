"""Open Sound Control over a real socket, read back by python-osc's own parser."""

from __future__ import annotations

import socket

import pytest
from live_messages import CAMERA, PLAIN, make_event, make_state

from tapetum.live.outputs import open_output

packets = pytest.importorskip("pythonosc.osc_packet")


def test_events_and_cameras_arrive_with_the_documented_addresses_and_types():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        server.settimeout(20)
        output = open_output(f"osc://127.0.0.1:{server.getsockname()[1]}")
        output.event(make_event(1))
        output.state(make_state(7, CAMERA, PLAIN))
        got = {}
        for _ in range(4):  # the event, the frame, and a packet of each camera
            for one in packets.OscPacket(server.recv(65536)).messages:
                got[one.message.address] = list(one.message.params)
        output.close()
    assert got["/tapetum/event"] == ["event-1", "new", "seen", "", "2026-09-21T14:13:20.123+00:00"]
    assert got["/tapetum/frame"] == [7, 2]
    assert got["/tapetum/camera/3/id"] == ["a1b2"]
    assert got["/tapetum/camera/3/place"] == [320.5, 200.25, 14.0]
    assert got["/tapetum/camera/3/gaze"] == [0.25, -0.5, 0.125, 0.375, -0.625, -0.375]
    assert got["/tapetum/camera/3/device"] == ["phone-03", 0.75]
    assert got["/tapetum/camera/3/active"] == [1] and got["/tapetum/camera/4/active"] == [-1]
    assert not {"/tapetum/camera/4/gaze", "/tapetum/camera/4/device"} & set(got)
    assert output.counts.sent == 2 and output.counts.failed == 0
