"""Recordings of the Rotation set's camera beyond the paper's: for development, and varied ones for training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tapetum.bench import load_scene, with_values
from tapetum.data.synth import Plan, make_plan, rotation_plan
from tapetum.data.synth.plan import Video
from tapetum.record.stray import DimRoom, FixedPattern

__all__ = ["DISTANCES", "before_room", "development_plan", "varied_plan"]

DISTANCES = (3.0, 4.0, 5.5, 7.0, 8.0)
"""Of the development recordings, in metres; the Rotation set was filmed at 5.5."""

# Of the development recordings and, seven each, of the varied ones: all different, none of the set's.
_DEVELOPMENT_SEED, _VARIED_SEEDS = 2, range(3, 7)
_DEVELOPMENT_SECONDS = {"paper": 20.0, "laptop": 8.0, "small": 2.0}
_DEVELOPMENT_BACKGROUND, _DEVELOPMENT_ROOM = 80.0, 30.0
# Together about as long as the Rotation set.
_VARIED_SECONDS = {"paper": 25.0, "laptop": 8.0, "small": 1.0}
# Electrons of the uniform background and of the room at 5.5 m: drawn log-uniformly.
_VARIED_BACKGROUND, _VARIED_ROOM = (20.0, 160.0), (3.0, 60.0)


def development_plan(size: str) -> Plan:
    """Return the plan of development recordings: other seeds, distances and background than the Rotation set's.

    They were used to develop the method, so they are no independent test.
    """
    scene = load_scene("rotation")
    videos = [
        before_room(
            rotation_plan(scene, size, _DEVELOPMENT_SEED).videos[number],
            f"development-{distance:g}m",
            distance,
            _DEVELOPMENT_SECONDS[size],
            background=_DEVELOPMENT_BACKGROUND,
            room=_DEVELOPMENT_ROOM,
        )
        for number, distance in enumerate(DISTANCES)
    ]
    plan = make_plan("rotation", size, _DEVELOPMENT_SEED)
    return replace(plan, videos=tuple(videos), rules=replace(plan.rules, test_fraction=1.0))


def varied_plan(size: str) -> Plan:
    """Return the plan of varied training recordings, each at another distance and before another room.

    In total they are as long as the Rotation set's. Distances cover the development recordings' range evenly.
    """
    scene = load_scene("rotation")
    base = [video for seed in _VARIED_SEEDS for video in rotation_plan(scene, size, seed).videos]
    videos: list[Video] = []
    for number, distance in enumerate(np.linspace(DISTANCES[0], DISTANCES[-1], len(base))):
        rng = np.random.default_rng([_VARIED_SEEDS[0], number])
        background, room = (float(np.exp(rng.uniform(*np.log(ends)))) for ends in (_VARIED_BACKGROUND, _VARIED_ROOM))
        name, seconds = f"varied-{distance:.2f}m", _VARIED_SECONDS[size]
        videos.append(before_room(base[number], name, float(distance), seconds, background=background, room=room))
    return replace(make_plan("rotation", size, _VARIED_SEEDS[0]), videos=tuple(videos))


def before_room(video: Video, name: str, distance: float, seconds: float, *, background: float, room: float) -> Video:
    """The video filmed from another distance, before a dimly lit room.

    The exposure grows with the square of the distance so that the RR stays as bright; so does all other light.
    """
    scene = video.scene
    longer = (distance / scene.distance) ** 2
    values = {
        "distance": distance,
        "probe.sensor.exposure": scene.probe.sensor.exposure * longer,
        "probe.sensor.background": background * longer,
    }
    session = replace(video.session, seconds=seconds, stray=(FixedPattern(), DimRoom(room * longer)))
    return replace(video, name=name, scene=with_values(scene, values), session=session)
