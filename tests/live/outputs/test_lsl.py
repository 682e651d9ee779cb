"""Streams of the lab streaming layer, read back by an inlet in the same process."""

from __future__ import annotations

import json
import math
import uuid

import pytest
from live_messages import CAMERA, PLAIN, UTC, make_event, make_state, until

from tapetum.errors import InputError, MissingExtraError
from tapetum.live.outputs import open_output
from tapetum.live.outputs.lsl import ACTIVITY, GAZE


def test_samples_bear_the_time_of_acquisition_and_the_cameras_own_clock():
    lsl = pytest.importorskip("pylsl", reason="the extra lsl is not installed")
    name = f"test-{uuid.uuid4().hex[:8]}"
    output = open_output(f"lsl:{name}")
    inlets = {}
    for kind in ("gaze", "activity", "events"):
        found = lsl.resolve_byprop("name", f"{name}-{kind}", timeout=10)
        assert found, "no stream was found: multicast may not pass on this machine"
        inlets[kind] = lsl.StreamInlet(found[0])
        inlets[kind].open_stream(timeout=10)
    until(lambda: all(outlet.have_consumers() for outlet in (output._gaze, output._activity, output._events_outlet)))
    # A frame that was taken at 1000 s of the monotonic clock, long before it is sent, and one 0.1 s later.
    for number in range(2):
        output.state(
            make_state(number, CAMERA, PLAIN, monotonic_ns=10**12 + number * 10**8, camera_time=7.5 + number / 10)
        )
    output.event(make_event(4))
    # The end of a source repeats its last frame; nothing is sent twice.
    output.state(make_state(1, CAMERA, PLAIN, monotonic_ns=10**12 + 10**8, camera_time=7.6))
    start = 1000.0 + output._from_monotonic
    gaze = [inlets["gaze"].pull_sample(timeout=10) for _ in range(4)]
    activity = [inlets["activity"].pull_sample(timeout=10) for _ in range(4)]
    marker, moment = inlets["events"].pull_sample(timeout=10)
    until(lambda: output.counts.sent == 4)
    assert inlets["gaze"].pull_sample(timeout=0.0)[0] is None
    info = inlets["gaze"].info(timeout=10)
    output.close()

    assert [time - start for _, time in gaze] == pytest.approx([0, 0, 0.1, 0.1], abs=1e-6)
    assert [time for _, time in activity] == [time for _, time in gaze]
    first = dict(zip([label for label, *_ in GAZE], gaze[0][0], strict=True))
    assert (first["gaze_x"], first["gaze_y_low"], first["gaze_y_high"]) == (0.25, -0.625, -0.375)
    assert (first["track"], first["x"], first["frame"], first["camera_time"]) == (3, 320.5, 0, 7.5)
    assert gaze[2][0][-1] == 7.6 and math.isnan(gaze[1][0][1])
    seen = [dict(zip([label for label, *_ in ACTIVITY], one, strict=True)) for one, _ in activity]
    assert seen[0]["active"] == 1 and math.isnan(seen[1]["active"]) and seen[3]["track"] == 4
    # An event is at its frame's time: that of the first one, by the clock that relates both.
    assert json.loads(marker[0])["id"] == "event-4" and json.loads(marker[0])["utc_ns"] == UTC
    assert moment - start == pytest.approx(0, abs=1e-6)
    assert info.get_channel_labels() == [label for label, *_ in GAZE] and info.type() == "Gaze"


def test_a_missing_name_or_extra_is_named(monkeypatch):
    with pytest.raises(InputError, match=r"no name for the streams in 'lsl:'; write lsl:NAME"):
        open_output("lsl:")
    monkeypatch.setitem(__import__("sys").modules, "pylsl", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'tapetum\[lsl\]'"):
        open_output("lsl:lab")
