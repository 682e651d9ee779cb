"""The demo end to end, on a recording of some seconds."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tapetum.errors import InputError
from tapetum.experiments import demo
from tapetum.experiments.demo import run_demo
from tapetum.experiments.pretrain import FRESH_SEED, NEAR_AXIS, TRAIN_SEEDS
from tapetum.models import load_model
from tapetum.report import demo_report, html
from tapetum.report.figures import figure_png
from tapetum.simulate import sign_dprime
from tapetum.track import read_tracks

SECONDS = 2.2


def test_from_a_scene_to_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    # Few gazes in the maps, coarsely: each is an image in fine sampling. The report's figures with few pixels.
    monkeypatch.setattr(demo, "_MAP", (3, 3))
    monkeypatch.setattr(demo, "sign_dprime", partial(sign_dprime, accuracy=0.01))
    for module in (html, demo_report):
        monkeypatch.setattr(module, "figure_png", lambda figure, dpi=160: figure_png(figure, dpi=40))
    outcome = run_demo(tmp_path / "out", seconds=SECONDS, seed=3, say=said.append)
    page = outcome.report.read_text(encoding="utf-8")
    # Self-contained: nothing is asked of any network.
    assert not re.search(r"(src|href)=[\"']https?://", page)
    assert "ResNet-18" in page
    assert "Zernike + ridge" in page
    names = [name for name, _ in outcome.scores.models]
    assert names == ["ResNet-18", "Zernike + ridge"]
    resnet = outcome.scores.models[0][1]
    # The bundled model has seen neither this recording nor its seed.
    assert resnet.mae_overall < 0.5 * outcome.scores.baseline.mae_overall
    assert outcome.scores.labels.rms < 3.0
    tracks = read_tracks(outcome.folder / "tracks.parquet")
    assert len(set(tracks["track"].to_pylist())) == 1
    gaze = tracks["gaze_x"].to_numpy(zero_copy_only=False).astype(float)
    assert np.isfinite(gaze).mean() > 0.9
    load_model(outcome.folder / "zernike")
    assert (outcome.folder / "gaze-path.png").stat().st_size > 10_000
    assert any("Filming" in line for line in said)

    # A second run takes the finished recording as it is; what the sign rests on is not computed twice for that, and the
    # figures are not drawn twice.
    picture = (outcome.folder / "gaze-path.png").read_bytes()
    for module in (html, demo_report):
        monkeypatch.setattr(module, "figure_png", lambda figure, dpi=160: picture)
    monkeypatch.setattr(demo, "save_figure", lambda figure, path: path.write_bytes(picture))
    monkeypatch.setattr(demo, "sign_dprime", lambda scene, gaze: torch.zeros(len(gaze), dtype=torch.float64))
    video = outcome.folder / "demo.rec" / "probe.mkv"
    before, first = video.stat().st_mtime_ns, outcome.report.stat().st_mtime_ns
    run_demo(tmp_path / "out", seconds=SECONDS, seed=3)
    assert video.stat().st_mtime_ns == before and outcome.report.stat().st_mtime_ns > first


@pytest.mark.parametrize("seed", [TRAIN_SEEDS[0], *NEAR_AXIS, FRESH_SEED])
def test_seeds_that_the_model_has_seen_are_refused(seed: int, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="choose another"):
        run_demo(tmp_path / "out", seed=seed)
    assert not (tmp_path / "out").exists()
