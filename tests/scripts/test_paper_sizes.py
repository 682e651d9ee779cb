"""Sizes side by side: cells hold what table1.json holds, a model no better than the mean is named, docs are current."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import make_paper_page as script
from make_paper_page import side_by_side
from tapetum.data.synth import make_plan
from tapetum.errors import InputError
from tapetum.experiments import RECIPES
from tapetum.models import ResNet18

ROOT = Path(__file__).parents[2]


def told(size: str, mae: float) -> dict[str, Any]:
    row = {"task": "rotation, x", "model": "ResNet-18", "unit": "fraction of the field", "mae": mae, "guess_mae": 0.25}
    other = {**row, "task": "object distance", "model": "ridge", "unit": "m", "mae": 0.123, "guess_mae": 0.75}
    classes = {"top_1": 0.934, "frames": 321}
    return {"size": size, "version": "9.9", "date": "2030-01-02", "rows": [row, other], "classes": classes}


def test_every_size_has_its_column_and_what_is_missing_is_a_dash():
    large = told("paper", 0.01)
    del large["rows"][1]
    lines = side_by_side([told("laptop", 0.03), large]).splitlines()
    assert lines[2] == "| rotation, x | ResNet-18 | 0.03 (0.25) | 0.01 (0.25) |"
    assert lines[3] == "| object distance | ridge | 0.123 (0.75) m | – |"
    assert lines[4] == "| phones identified, top-1 | ResNet-18 | 93.4 % of 321 | 93.4 % of 321 |"
    assert lines[-1] == "*`laptop`: Tapetum 9.9, 2030-01-02; `paper`: Tapetum 9.9, 2030-01-02.*"


@pytest.mark.parametrize(("mae", "worse"), [(0.2499, False), (0.25, True), (0.266, True)])
def test_what_is_no_better_than_the_mean_is_named(mae: float, worse: bool):
    assert ("no better than the mean" in side_by_side([told("small", mae)])) == worse


def test_a_folder_of_figures_becomes_a_column(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    numbers, page = tmp_path / "numbers", tmp_path / "sizes.md"
    shutil.copytree(script.NUMBERS, numbers)
    monkeypatch.setattr(script, "NUMBERS", numbers)
    monkeypatch.setattr(script, "INCLUDES", tmp_path)
    for size in ("laptop", "small"):
        (tmp_path / size).mkdir()
        (tmp_path / size / "table1.json").write_text(json.dumps(told(size, 0.02)))
    script.main([str(tmp_path / "laptop")])
    assert "| 0.02 (0.25) |" in page.read_text() and json.loads((numbers / "table1-laptop.json").read_text())["date"]
    before = page.read_text()
    with pytest.raises(InputError, match="shows nothing"):
        script.main([str(tmp_path / "small")])
    assert page.read_text() == before


def test_the_docs_say_what_is_filmed_and_trained_at_each_size():
    cells: dict[str, list[str]] = {}
    for line in (ROOT / "docs" / "paper.md").read_text(encoding="utf-8").splitlines():
        parts = [part.strip() for part in line.strip("|").split("|")]
        if len(parts) == 4:
            cells[parts[0]] = parts[1:]
    sizes = ("small", "laptop", "paper")
    for kind in ("rotation", "focusing", "phones"):
        plans = [make_plan(kind, size) for size in sizes]
        seconds = [f"{plan.videos[0].session.seconds:g} s" for plan in plans]
        assert cells[f"{kind.capitalize()}: {len(plans[0].videos)} videos of"] == seconds
    for task, name in (("gaze", "rotation"), ("focus", "focusing"), ("phones", "phones")):
        models = [RECIPES[f"{name}-resnet18"].make(size) for size in sizes]
        assert all(isinstance(model, ResNet18) for model in models)
        recipe = [f"{one.crop}, {one.size}, {one.settings.epochs}" for one in models if isinstance(one, ResNet18)]
        assert cells[f"{task}: crop, reduced to, epochs"] == recipe
