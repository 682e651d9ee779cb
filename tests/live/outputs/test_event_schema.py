"""The published form of events is that of the classes, holds for real events, and refuses others."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from live_messages import CAMERA, PLAIN, make_event

from tapetum.live import Event
from tapetum.live.schema import event_schema

PUBLISHED = Path(__file__).parents[3] / "docs" / "event.schema.json"


def test_the_published_schema_is_that_of_the_classes():
    again = "from tapetum.live.schema import event_schema as s; import json; print(json.dumps(s(), indent=2))"
    assert json.loads(PUBLISHED.read_text()) == event_schema(), f"write it again: python -c '{again}'"


def test_events_hold_to_it_and_others_do_not():
    validator = pytest.importorskip("jsonschema_rs").Draft202012Validator(event_schema())
    events = [
        make_event(),
        Event("a", "update", "looks", 1, "door", PLAIN, CAMERA),
        Event("a", "end", "gone", 1, "", CAMERA, None),
        Event("source", "update", "source lost", 1, "it was unplugged"),
    ]
    for event in events:
        validator.validate(json.loads(json.dumps(event.as_json())))
    # A newer version's fields and kinds, and the number that the page's server adds, are passed over.
    whole = json.loads(json.dumps(make_event().as_json()))
    validator.validate({**whole, "number": 3, "picture": True, "kind": "shutter opened"})
    wrong = [
        {**whole, "schema": "tapetum/event/2"},
        {**whole, "type": "begin"},
        {**whole, "utc_ns": "today"},
        {**whole, "after": {**whole["after"], "gaze_x": [0.1, 0.2]}},
        {key: value for key, value in whole.items() if key != "id"},
        json.loads(json.dumps(replace(make_event(), after=None, before=3).as_json())),
    ]
    assert not any(validator.is_valid(one) for one in wrong)
    fields = [*event_schema()["properties"].values(), *event_schema()["$defs"]["CameraState"]["properties"].values()]
    assert all(field.get("description") for field in fields)
