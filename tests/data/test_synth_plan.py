"""The three plans: as many videos as the paper's, and nothing but the label differs between them."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from synth_plans import little_scene

from tapetum.bench import Scene, load_scene, scene_dict, scene_names, with_values
from tapetum.bench.phone import phone_names
from tapetum.bench.scene import PhoneTarget
from tapetum.data.synth import KINDS, SIZES, Plan, focusing_plan, make_plan, phones_plan, rotation_plan
from tapetum.data.synth.plan import PIECE
from tapetum.errors import InputError
from tapetum.record import Shot


def phone_scene() -> Scene:
    return with_values(little_scene(), {"target": {"kind": "phone", "name": "phone-05", "object_distance": 5.5}})


@functools.cache
def plan_of(kind: str, size: str = "small", seed: int = 0) -> Plan:
    if kind == "phones":
        return phones_plan(phone_scene(), size, seed)
    return {"rotation": rotation_plan, "focusing": focusing_plan}[kind](little_scene(), size, seed)


def test_rotation_is_seven_videos_of_100_seconds():
    plan = rotation_plan(little_scene(), "paper")
    assert [video.frames for video in plan.videos] == [1500] * 7
    assert plan.rules.side == 400 and plan.rules.test_fraction == 0.2


def test_focusing_is_a_grid_of_focal_lengths_and_distances():
    plan = focusing_plan(little_scene(), "paper")
    assert [video.frames for video in plan.videos] == [900] * 18
    labels = [dict(video.labels) for video in plan.videos]
    assert sorted({one["focal_length"] for one in labels}) == [0.050, 0.085, 0.135]
    assert sorted({one["object_distance"] for one in labels}) == [3, 3.5, 4, 4.5, 5, 5.5]
    assert len({tuple(one.values()) for one in labels}) == 18
    for video, label in zip(plan.videos, labels, strict=True):
        assert video.scene.target.object_distance == label["object_distance"]
        assert video.scene.target.lens.focal_length == label["focal_length"]


def test_phones_are_eleven_of_the_catalogue_and_look_towards_the_probe():
    plan = plan_of("phones", "paper")
    assert [video.frames for video in plan.videos] == [1500] * 11
    assert plan.classes == [f"phone-{n:02d}" for n in range(1, 12)]
    assert set(plan.classes) <= set(phone_names())
    for video, name in zip(plan.videos, plan.classes, strict=True):
        assert isinstance(video.scene.target, PhoneTarget)
        assert video.scene.target.name == name == dict(video.labels)["device"]
        assert video.session.motion.extent == 0.25


@pytest.mark.parametrize("kind", KINDS)
def test_the_bundled_scenes_make_every_plan(kind: str):
    if kind not in scene_names():
        pytest.skip(f"no bundled scene {kind}")
    plan = make_plan(kind, "paper", 1)
    assert len(plan.videos) == {"rotation": 7, "focusing": 18, "phones": 11}[kind]
    assert plan.digest == make_plan(kind, "paper", 1).digest != make_plan(kind, "paper", 2).digest


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_but_the_label_differs_between_videos(kind: str):
    plan = plan_of(kind)
    probes = [scene_dict(video.scene)["probe"] for video in plan.videos]
    assert all(probe == probes[0] for probe in probes)
    sessions = [dataclasses.replace(video.session, seed=0) for video in plan.videos]
    assert all(session == sessions[0] for session in sessions)
    assert len({video.session.seed for video in plan.videos}) == len(plan.videos)


def test_seeds_of_sets_and_of_videos_are_their_own():
    seeds = [v.session.seed for kind in KINDS for n in (0, 1) for v in plan_of(kind, seed=n).videos]
    assert len(set(seeds)) == len(seeds)
    assert rotation_plan(little_scene(), seed=3) == rotation_plan(little_scene(), seed=3)


def test_parts_cover_every_frame_once():
    plan = rotation_plan(little_scene(), "paper")
    for number, video in enumerate(plan.videos):
        own = [part for part in plan.parts if part.video == number]
        covered = np.concatenate([np.arange(part.first, part.last) for part in own])
        np.testing.assert_array_equal(covered, np.arange(video.frames))
        assert all(part.first % PIECE == 0 for part in own)
    assert [part.number for part in plan.parts] == list(range(len(plan.parts)))


def test_the_digest_is_of_all_that_decides():
    plans = [
        rotation_plan(little_scene(), "small", 0),
        rotation_plan(little_scene(), "small", 1),
        rotation_plan(little_scene(), "paper", 0),
        rotation_plan(load_scene("hand-held"), "small", 0),
        focusing_plan(little_scene(), "small", 0),
    ]
    assert len({plan.digest for plan in plans}) == len(plans)
    assert rotation_plan(little_scene(), "small", 0).digest == plans[0].digest


@pytest.mark.parametrize(("kind", "videos", "parts"), [("rotation", 7, 4), ("focusing", 18, 1), ("phones", 11, 2)])
def test_every_size_has_the_same_videos_only_longer(kind: str, videos: int, parts: int):
    small, laptop, paper = (plan_of(kind, size, 1) for size in SIZES)
    assert len(small.videos) == len(laptop.videos) == len(paper.videos) == videos
    for one, two, three in zip(small.videos, laptop.videos, paper.videos, strict=True):
        assert one.session.seconds < two.session.seconds < three.session.seconds
        assert dataclasses.replace(one, session=three.session) == dataclasses.replace(two, session=three.session)
        # The same motion, seen for longer.
        assert one.session.seed == two.session.seed == three.session.seed
    assert len(laptop.parts) == videos * parts and small.rules == laptop.rules == paper.rules
    assert len({plan.digest for plan in (small, laptop, paper)}) == 3


def test_unknown_names_are_told():
    for arguments, word in ((("gaze",), "kind"), (("rotation", "huge"), "size")):
        with pytest.raises(InputError, match=word):
            make_plan(*arguments)
    assert KINDS == ("rotation", "focusing", "phones")


@pytest.mark.slow
@pytest.mark.parametrize("number", range(11))
def test_every_phone_of_the_paper_s_set_can_be_filmed(number: int) -> None:
    """At the paper's size targets turn farther than in a short film, and each camera must be known that far."""
    video = make_plan("phones", "paper").videos[number]
    assert Shot(video.scene, video.session).probe(0, 1).max() > 0
