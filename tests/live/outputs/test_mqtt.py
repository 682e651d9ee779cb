"""MQTT with a broker of its own on a real socket: topics, discovery, wills, broken connections."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest
from live_messages import CAMERA, PLAIN, make_event, make_state, until

from tapetum.errors import InputError
from tapetum.live.outputs import home_assistant, open_output
from tapetum.live.outputs.mqtt import Mqtt

pytest.importorskip("paho.mqtt.client")
from mqtt_broker import Broker

CONFIG = "homeassistant/device/tapetum_lab/config"


@pytest.fixture
def fast(monkeypatch):
    monkeypatch.setattr("tapetum.live.outputs.mqtt._RECONNECT", (0.02, 0.02))


def test_a_watch_is_introduced_and_its_events_and_cameras_arrive():
    broker = Broker()
    output = open_output(f"mqtt://me:secret@127.0.0.1:{broker.port}/lab")
    output.state(make_state(0, CAMERA, PLAIN))
    until(lambda: output.counts.sent == 1)
    output.event(make_event(1))
    output.state(make_state(1, PLAIN))
    until(lambda: output.counts.sent == 3)
    output.close()
    until(lambda: broker.texts("lab/status") == ["online", "offline"])
    broker.close()
    assert broker.logins == [("me", "secret")] and "secret" not in output.name
    assert all(retained for topic, _, retained in broker.got if topic != "lab/event")
    (event,) = (json.loads(text) for text in broker.texts("lab/event"))
    assert event == {"event_type": "seen", **json.loads(json.dumps(make_event(1).as_json()))}
    states = [json.loads(text) for text in broker.texts("lab/state")]
    assert [(one["here"], one["cameras"], one["imaging"]) for one in states] == [("ON", 2, 1), ("ON", 1, 0)]
    # The second camera keeps its number when the first goes.
    first, second = ([json.loads(text) for text in broker.texts(f"lab/camera/{n}")] for n in (1, 2))
    assert [one["here"] for one in first] == ["ON", "OFF"] and first[0]["gaze_x"] == [0.25, 0.125, 0.375]
    assert second[-1]["here"] == "ON" and second[-1]["id"] == "c3d4" and second[-1]["gaze_x"] is None


def test_what_discovery_names_is_what_is_published():
    topic, content = home_assistant.discovery("lab")
    assert topic == CONFIG and re.fullmatch(r"homeassistant/device/[a-zA-Z0-9_-]+/config", topic)
    assert content["availability_topic"] == "lab/status" and content["device"]["identifiers"] == ["tapetum_lab"]
    parts = content["components"]
    assert {part["platform"] for part in parts.values()} == {"binary_sensor", "sensor", "event"}
    assert len({part["unique_id"] for part in parts.values()}) == len(parts) == 7 + home_assistant.SLOTS
    shown = home_assistant.summary(make_state(0, CAMERA))
    for part in parts.values():
        if part["state_topic"] == "lab/state":
            assert re.fullmatch(r"\{\{ value_json\.(\w+) \}\}", part["value_template"])[1] in shown
    assert parts["event"]["event_types"][0] == "seen"


def test_slots_are_kept_given_again_and_never_more_than_there_are():
    slots = home_assistant.Slots(2)
    a, b, c = (replace(CAMERA, id=name) for name in "abc")
    assert slots.update((a, b, c)) == (a, b)
    assert slots.update((b, c)) == (c, b)
    assert slots.update(()) == (None, None)


def test_events_of_a_cut_connection_arrive_after_it(fast):
    broker = Broker()
    output = open_output(f"mqtt://127.0.0.1:{broker.port}/lab")
    output.event(make_event(0))
    output.state(make_state(0, CAMERA))
    until(lambda: output.counts.sent == 2)
    port = broker.port
    broker.close()
    # As nobody said goodbye, the broker tells the house.
    until(lambda: broker.texts("lab/status") == ["online", "offline"])
    until(lambda: not output._online.is_set() and "broker" in output.counts.fault)
    for number in range(1, 4):
        output.event(make_event(number))
    again = Broker(port)
    until(lambda: output.counts.sent == 5)
    assert [json.loads(text)["id"] for text in again.texts("lab/event")] == ["event-1", "event-2", "event-3"]
    assert len(again.texts(CONFIG)) == 1
    # What was retained is told again, though it did not change.
    output.state(make_state(0, CAMERA))
    until(lambda: len(again.texts("lab/state")) == 1)
    # Home Assistant starts, and is told once more.
    until(lambda: again.subscribed == ["homeassistant/status"])
    again.send("homeassistant/status", "online")
    until(lambda: len(again.texts(CONFIG)) == 2)
    output.close()
    again.close()


def test_a_broker_that_refuses_is_named_and_costs_only_its_own_messages(fast):
    broker = Broker(refuses=5)
    output = Mqtt(f"mqtt://me@127.0.0.1:{broker.port}")
    output._patience = 0.3
    output.start()
    until(lambda: "refuses the connection (Not authorized)" in output.counts.fault)
    for number in range(1500):
        output.event(make_event(number))
    assert output.counts.dropped >= 499 and output.counts.sent == 0
    output.close()
    broker.close()
    until(lambda: output.counts.dropped + output.counts.failed == 1500 and output.counts.waiting == 0)


@pytest.mark.parametrize("text", ["mqtt://127.0.0.1/a/#", "mqtt://127.0.0.1/a?b", "mqtt:///a"])
def test_a_text_that_names_no_broker_is_refused(text):
    with pytest.raises(InputError, match="write mqtt://user@host:1883/prefix"):
        open_output(text)
