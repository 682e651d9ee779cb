"""No label of a synthesised set may be readable from anything but the picture of the retro-reflection."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from synth_plans import little_scene, shortened

from tapetum.bench import with_values
from tapetum.data import open_dataset
from tapetum.data.leaks import find_leaks, score_leaks
from tapetum.data.synth import Plan, make_plan, rotation_plan, synthesise
from tapetum.data.write import Rules

# Where a video lasts seconds only, test frames follow train frames at once: that is true of so short a set alone.
OF_SHORT_VIDEOS = {"neighbours in time", "neighbours in store"}


def _longer(plan: Plan, seconds: float) -> Plan:
    return replace(
        plan, videos=tuple(replace(one, session=replace(one.session, seconds=seconds)) for one in plan.videos)
    )


@pytest.mark.slow
def test_nothing_but_the_picture_tells_the_gaze(tmp_path: Path):
    # Diverging light moves the RR with the gaze, more than so small a frame lets a hand sway.
    scene = with_values(little_scene(), {"illumination.mode": "collimated", "illumination.divergence": None})
    plan = rotation_plan(scene, "small", 3)
    videos = tuple(replace(one, session=shortened(one.session, 16.0)) for one in plan.videos[:4])
    plan = replace(plan, videos=videos, rules=Rules(side=40))
    tried = score_leaks(open_dataset(synthesise(plan, tmp_path / "set.zarr")), seed=1)
    assert {"position", "time", "label quality"} <= {one.name for one in tried if one.verdict == "none"}
    assert [str(one) for one in tried if one.verdict == "found" and one.name not in OF_SHORT_VIDEOS] == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rotation", "focusing", "phones"])
def test_nothing_but_the_picture_tells_the_labels_of_a_small_set(kind: str, tmp_path: Path):
    plan = _longer(make_plan(kind, "small", 11), 12.0)
    found = find_leaks(open_dataset(synthesise(plan, tmp_path / "set.zarr", processes=2)), seed=1)
    assert [str(one) for one in found if one.name not in OF_SHORT_VIDEOS] == []
