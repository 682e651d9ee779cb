"""What Home Assistant needs to know of a watch to show it: one discovery message for one device (2024.11 and later).

See "MQTT discovery" in Home Assistant's documentation of its MQTT integration.
"""

from __future__ import annotations

import re
from importlib.metadata import version
from typing import Any

from tapetum.live.events import KINDS
from tapetum.live.state import CameraState, State

__all__ = ["BIRTH", "SLOTS", "Slots", "device_id", "discovery", "summary"]

SLOTS = 8
"""Cameras that have an entity of their own; all of them count in `cameras`."""

BIRTH = "homeassistant/status"
"""Topic on which Home Assistant says that it has started, and that devices are to announce themselves."""


class Slots:
    """Gives each camera a small number while it stays, so that the entities of a house stay the same.

    An entity for each stay would leave a house with thousands of dead ones.
    """

    def __init__(self, most: int = SLOTS) -> None:
        self.ids: list[str | None] = [None] * most

    def update(self, cameras: tuple[CameraState, ...]) -> tuple[CameraState | None, ...]:
        """Return the camera of each slot; those that have none of their own are left out."""
        there = {camera.id: camera for camera in cameras}
        self.ids = [one if one in there else None for one in self.ids]
        for name in there:
            if name not in self.ids and None in self.ids:
                self.ids[self.ids.index(None)] = name
        return tuple(None if one is None else there[one] for one in self.ids)


def device_id(prefix: str) -> str:
    """Return the name of a watch's device for Home Assistant, which allows letters, digits, _ and -."""
    name = re.sub(r"[^A-Za-z0-9_-]", "_", prefix)
    return name if name.startswith("tapetum") else f"tapetum_{name}"


def summary(state: State) -> dict[str, Any]:
    """Return what the entities of a watch as a whole show."""
    health = state.health
    return {
        "here": "ON" if state.cameras else "OFF",
        "cameras": len(state.cameras),
        "imaging": sum(camera.active is True for camera in state.cameras),
        "connected": "ON" if health.connected else "OFF",
        "rate": round(health.rate, 1),
        "delay_ms": round(1000 * health.delay),
        "fault": health.fault,
        "source": state.source,
        "utc_ns": state.utc_ns,
    }


def discovery(prefix: str, slots: int = SLOTS) -> tuple[str, dict[str, Any]]:
    """Return topic and content of the message that describes a watch whose topics begin with `prefix`."""
    device = device_id(prefix)

    def entity(platform: str, key: str, name: str, **more: Any) -> dict[str, Any]:
        return {"platform": platform, "name": name, "unique_id": f"{device}_{key}", **more}

    def of_summary(platform: str, key: str, name: str, **more: Any) -> dict[str, Any]:
        template = f"{{{{ value_json.{key} }}}}"
        return entity(platform, key, name, state_topic=f"{prefix}/state", value_template=template, **more)

    measured = {"state_class": "measurement"}
    told = {"entity_category": "diagnostic"}
    components = {
        "here": of_summary("binary_sensor", "here", "A camera is here", device_class="occupancy"),
        "cameras": of_summary("sensor", "cameras", "Cameras", icon="mdi:cctv", **measured),
        "imaging": of_summary("sensor", "imaging", "Cameras that image", icon="mdi:record-rec", **measured),
        "connected": of_summary("binary_sensor", "connected", "Probe", device_class="connectivity", **told),
        "rate": of_summary("sensor", "rate", "Frames per second", icon="mdi:speedometer", **measured, **told),
        "fault": of_summary("sensor", "fault", "Fault", icon="mdi:alert-circle-outline", **told),
        # Home Assistant takes an event's other values as its attributes.
        "event": entity(
            "event", "event", "Event", state_topic=f"{prefix}/event", event_types=list(KINDS), icon="mdi:eye-outline"
        ),
    }
    for number in range(1, slots + 1):
        topic = f"{prefix}/camera/{number}"
        components[f"camera_{number}"] = entity(
            "binary_sensor",
            f"camera_{number}",
            f"Camera {number}",
            device_class="occupancy",
            state_topic=topic,
            value_template="{{ value_json.here }}",
            json_attributes_topic=topic,
        )
    content = {
        "device": {"identifiers": [device], "name": f"Tapetum ({prefix})", "manufacturer": "Tapetum", "model": "watch"},
        "origin": {"name": "Tapetum", "sw_version": version("tapetum")},
        "availability_topic": f"{prefix}/status",
        "qos": 1,
        "components": components,
    }
    return f"homeassistant/device/{device}/config", content
