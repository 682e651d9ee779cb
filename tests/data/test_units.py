"""Units in a dataset: numbered and named, and kept apart by the split."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from synth_plans import PIECE, little_scene, shortened

from tapetum.data import dataset_from_arrays, open_dataset, split_by
from tapetum.data.dataset import EMBARGO, TEST, TRAIN
from tapetum.data.synth import Units, make_plan, synthesise
from tapetum.data.synth.plan import SETS
from tapetum.data.write import Rules
from tapetum.errors import InputError


def units_of(counts: list[int], cameras: list[str] | None = None) -> xr.Dataset:
    """A set of ten frames a unit, the last two of each a test."""
    unit = np.repeat(np.arange(len(counts)), counts)
    names = {} if cameras is None else {"device": np.repeat(cameras, counts)}
    images = np.random.default_rng(0).integers(0, 255, (len(unit), 8, 8), np.uint8)
    split = np.concatenate([np.r_[np.zeros(n - 2), np.ones(2)] for n in counts]).astype(int)
    made = dataset_from_arrays(images, {"gaze_x": np.linspace(-1, 1, len(unit)), **names}, split=split, recording=unit)
    about = {"classes": [f"unit-{n}" for n in range(len(counts))]}
    return made.assign(unit=xr.Variable(("frame",), unit.astype(np.int32), about))


def test_units_that_test_never_train():
    made = units_of([10] * 6, ["a", "a", "a", "b", "b", "b"])
    other, seen = split_by(made, "unit"), split_by(made, "seen-unit")
    # The last of each camera.
    assert other.tp.test.tp.units == ("unit-2", "unit-5")
    assert set(other.tp.train.tp.units).isdisjoint(other.tp.test.tp.units)
    assert np.array_equal(other["split"] == TRAIN, seen["split"] == TRAIN)
    assert seen.tp.test.tp.units == other.tp.train.tp.units == ("unit-0", "unit-1", "unit-3", "unit-4")
    assert (seen["split"].values == TEST).sum() == 8
    assert (other["split"].values == TEST).sum() == 20
    # Ends of training units are no training, whatever tests.
    assert (other["split"].values == EMBARGO).sum() == 8
    assert split_by(made, "time") is made


def test_a_split_by_units_needs_units():
    with pytest.raises(InputError, match="does not distinguish copies of its camera; film units"):
        split_by(units_of([10]).drop_vars("unit"), "unit")
    with pytest.raises(InputError, match=r"has 1 unit of b, and a split by units needs 2"):
        split_by(units_of([10, 10, 10], ["a", "a", "b"]), "unit")


def test_plans_film_copies_of_every_camera():
    # The first three phones of the set: drawing copies of all eleven would take most of this file's time.
    phones = replace(SETS["phones"], videos=SETS["phones"].videos[:3])
    plan = phones.plan(None, "small", 4, Units(2))
    assert [video.unit for video in plan.videos] == list(range(6)) and len(set(plan.units)) == 6
    assert plan.units[2].startswith("phone-02-")
    assert plan.videos[2].scene.target.name == "phone-02"  # type: ignore[union-attr]
    assert len({video.session.seed for video in plan.videos}) == 6
    # A longer list begins with the shorter one: a unit's number in its camera is all that it depends on.
    shorter = phones.plan(None, "small", 4, Units(1))
    assert len(shorter.units) == 3 and set(shorter.units) < set(plan.units)
    # All videos of a set without devices show copies of one camera.
    rotation = make_plan("rotation", "small", 4, Units(2))
    assert [video.unit for video in rotation.videos] == [0, 1] * 7
    decentres = {video.scene.target.sensor.decentre for video in rotation.videos}
    assert len(decentres) == 2
    plain = make_plan("rotation", "small", 4)
    assert plain.units == () and "unit" not in plain.as_dict()["videos"][0]


def test_a_set_of_units_says_which_is_which(tmp_path: Path):
    plan = SETS["rotation"].plan(little_scene(), "small", 0, Units(2, "thin"))
    short = tuple(replace(one, session=shortened(one.session, 1.2)) for one in plan.videos[:2])
    plan = replace(plan, videos=short, rules=Rules(side=40, test_fraction=0), piece=PIECE)
    made = open_dataset(synthesise(plan, tmp_path / "units.zarr"))
    assert made.tp.units == plan.units
    assert np.array_equal(made["unit"].values, made["recording"].values)
    assert [one["unit"] for one in made.tp.recordings] == list(plan.units)
    told = [one["parameters"]["scene"]["target"]["sensor"]["decentre"] for one in made.tp.recordings]
    assert told[0] != told[1]
