"""`tapetum dataset info`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import zarr
from PIL import Image


def test_lines_for_a_person(run, chain) -> None:
    ran = run("dataset", "info", chain.dataset)
    assert ran.code == 0
    assert "20 crops of 400 px: 16 to train on, 4 to test" in ran.out
    assert "gaze_x: 0.000 to 0.190" in ran.out and "spot.rec: 20 of 20 frames, 16 train, 4 test" in ran.out
    assert "label quality: 0.90" in ran.out
    # Four test frames tell nothing about leaks, and that is said.
    assert "not tested: gaze_x from anything" in ran.out and "leak:" not in ran.out


def test_json_and_a_sheet(run, chain, tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.png"
    ran = run("dataset", "info", chain.dataset, "--json", "--sheet", sheet)
    assert ran.code == 0
    told = json.loads(ran.out)
    assert told["frames"] == 20 and told["train"] == 16 and told["labels"]["gaze_y"]["least"] < 0
    assert told["leaks"][0]["verdict"] == "untested" and told["leaks"][0]["score"] is None
    with Image.open(sheet) as picture:
        assert picture.size[0] > 1000


def test_a_sheet_of_another_kind_is_refused_at_once(run, chain, tmp_path: Path) -> None:
    ran = run("dataset", "info", chain.dataset, "--sheet", tmp_path / "sheet.gif")
    assert ran.code == 2 and "cannot draw a .gif file" in ran.complaint
    assert not list(tmp_path.iterdir())


def test_stores_that_are_not_ours(run, chain, tmp_path: Path) -> None:
    foreign = tmp_path / "foreign.zarr"
    zarr.create_group(str(foreign), zarr_format=3).create_array("image", shape=(2, 3), dtype="u1")
    older = tmp_path / "older.zarr"
    zarr.create_group(str(older), zarr_format=2)
    empty, half = tmp_path / "empty", tmp_path / "half.zarr"
    empty.mkdir()
    shutil.copytree(chain.dataset, half)
    next(p for p in (half / "image" / "c").rglob("*") if p.is_file()).unlink()
    single = tmp_path / "array.zarr"
    zarr.create_array(str(single), shape=(2,), dtype="u1", zarr_format=3)
    words = {
        foreign: "not a Tapetum dataset",
        older: "no zarr.json",
        empty: "no zarr.json",
        half: "parts of image are missing",
        single: "",
    }
    for store, word in words.items():
        ran = run("dataset", "info", store)
        assert ran.code == 2 and store.name in ran.complaint and word in ran.complaint
