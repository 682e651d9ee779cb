"""A set small enough for tests: the plans of the real ones with little cameras and few seconds."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

from tapetum.bench import Scene, load_scene, with_values
from tapetum.data.synth import Plan, rotation_plan
from tapetum.data.write import Rules
from tapetum.record import Session


def little_scene() -> Scene:
    values = {
        "probe.sensor.pixels": [96, 80],
        "probe.sensor.pitch": "4.4 um",
        "probe.sensor.exposure": "800 us",
        "target.lens.aperture_radius": "2 mm",
        "target.sensor.pixels": [162, 122],
        "target.sensor.pitch": "17.6 um",
        "sampling.accuracy": 0.1,
    }
    return with_values(load_scene("hand-held"), values)


def shortened(session: Session, seconds: float) -> Session:
    """A session of some seconds, its hand so quiet that a little frame holds what it shows."""
    return replace(session, seconds=seconds, motion=replace(session.motion, sway=3e-3))


PIECE = 16


def little_plan(videos: int = 2, seconds: float = 1.6, seed: int = 0) -> Plan:
    """Some videos of two little parts each."""
    plan = rotation_plan(little_scene(), "small", seed)
    short = tuple(replace(one, session=shortened(one.session, seconds)) for one in plan.videos[:videos])
    return replace(plan, videos=short, rules=Rules(side=40), piece=PIECE)


def digest(store: Path) -> str:
    """Of every byte of a folder."""
    total = hashlib.sha256()
    for file in sorted(store.rglob("*")):
        if file.is_file():
            total.update(str(file.relative_to(store)).encode() + b"\0" + file.read_bytes())
    return total.hexdigest()
