"""The bundled model: whole, small enough, and honest about where it comes from."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tapetum.experiments import pretrain
from tapetum.models import ResNet18, model_card, pretrained, store

FOLDER = Path(store.__file__).parent / "pretrained" / pretrain.NAME


def test_it_loads_and_answers() -> None:
    model = pretrained(pretrain.NAME)
    assert isinstance(model, ResNet18)
    frames = np.random.default_rng(0).integers(0, 255, (2, 400, 400)).astype(np.uint8)
    predicted = model.predict(frames, anyway=True)
    assert predicted.names == ("gaze_x", "gaze_y")
    assert np.isfinite(predicted.value).all()
    assert (predicted.upper > predicted.lower).all()


def test_it_fits_into_the_package() -> None:
    assert sum(file.stat().st_size for file in FOLDER.iterdir()) <= 25e6


def test_its_card_says_how_it_was_made_and_what_it_reached() -> None:
    card = model_card(FOLDER)
    notes = card["notes"]
    assert notes["seeds"] == list(pretrain.TRAIN_SEEDS)
    assert notes["fresh_seed"] == pretrain.FRESH_SEED
    assert notes["command"] == "make models"
    assert notes["simulation_only"] is True
    for name in ("gaze_x", "gaze_y"):
        figures = card["metrics"]["targets"][name]
        assert figures["mae"] < 0.5 * figures["baseline_mae"]
