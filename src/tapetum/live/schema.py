"""The published form of an event: a JSON Schema (2020-12) made of the classes themselves."""

from __future__ import annotations

import re
from inspect import getdoc
from typing import Any

from pydantic import TypeAdapter

from tapetum.live.events import KINDS, Event
from tapetum.live.state import CameraState

__all__ = ["event_schema"]


def event_schema() -> dict[str, Any]:
    """Return the JSON Schema of `Event.as_json`, which webhooks, MQTT and the page's socket send.

    Version 1 may gain fields and kinds, and loses none: readers of events must ignore what they do not know.
    """
    made = TypeAdapter(Event).json_schema(mode="serialization")
    camera = made["$defs"]["CameraState"]
    for part, of in ((made, Event), (camera, CameraState)):
        # Every field is always sent, whatever its default.
        part["required"] = list(part["properties"])
        for field in part["properties"].values():
            field.pop("title", None)
            field.pop("default", None)
        for names, words in _documented(of):
            for name in names:
                part["properties"][name]["description"] = words
        part["description"] = (getdoc(of) or "").split("\n\n")[0]
    made["properties"] = {"schema": {"const": "tapetum/event/1", "description": "This form."}, **made["properties"]}
    made["required"] = ["schema", *made["required"]]
    made["properties"]["type"] |= {"enum": ["new", "update", "end"]}
    # No closed list: a later kind must not make a receiver refuse the event.
    made["properties"]["kind"] |= {"examples": list(KINDS)}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **made}


def _documented(of: type) -> list[tuple[list[str], str]]:
    """Names of fields, and what the docstring says of them."""
    parameters = (getdoc(of) or "").partition("Parameters\n----------\n")[2]
    found = re.findall(r"^(\w[\w, ]*)\n((?: {4}.*\n?)+)", parameters, re.MULTILINE)
    return [(names.split(", "), " ".join(words.split())) for names, words in found]
