"""How the bundled model is made, at a hundredth of its size."""

from __future__ import annotations

from pathlib import Path

import pytest

from tapetum.models import load_model, model_card
from tapetum.report import pretrain


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pretrain, "TRAIN_SEEDS", (101,))
    monkeypatch.setattr(pretrain, "SECONDS", 4.0)


@pytest.mark.usefixtures("tiny")
def test_an_interrupted_making_goes_on_where_it_stopped(tmp_path: Path) -> None:
    work, out = tmp_path / "work", tmp_path / "model"

    def stop(_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pretrain.make_pretrained(work, out, epochs=2, on_epoch=stop)
    assert not out.exists()
    filmed = {file: file.stat().st_mtime_ns for file in work.rglob("*.mkv")}
    assert len(filmed) == 4

    epochs: list[int] = []
    pretrain.make_pretrained(work, out, epochs=2, on_epoch=lambda report: epochs.append(report.epoch))
    # Neither the films nor the first epoch are made again.
    assert {file: file.stat().st_mtime_ns for file in work.rglob("*.mkv")} == filmed
    assert epochs == [2]
    card = model_card(out)
    assert card["notes"]["seeds"] == [101]
    assert card["weights"]["precision"] == "half"
    assert set(card["metrics"]["targets"]) == {"gaze_x", "gaze_y"}
    assert load_model(out).target_names == ("gaze_x", "gaze_y")
