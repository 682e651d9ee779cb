from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from tapetum.errors import InputError
from tapetum.report import (
    DemoReport,
    DemoScores,
    ModelResult,
    demo_report,
    html,
    score_demo,
    score_gaze,
    write_demo_report,
)
from tapetum.report.evaluation import Outcome
from tapetum.report.figures import figure_png


def plain(page: str) -> str:
    """The page's words without pictures, styles and tags."""
    page = re.sub(r"<style>.*?</style>|src=\"[^\"]*\"", "", page, flags=re.S)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, content: DemoReport) -> tuple[str, DemoScores]:
    path = tmp_path_factory.mktemp("report") / "report.html"
    scores = write_demo_report(path, content)
    return path.read_text(encoding="utf-8"), scores


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the figures' pixels, two seconds a report, to `written`: the tests that ask for this one read words."""
    empty = figure_png(Figure((0.1, 0.1)), dpi=10)
    for module in (html, demo_report):
        monkeypatch.setattr(module, "figure_png", lambda figure, dpi=160: empty)


def test_the_report_holds_its_parts_and_their_numbers(written: tuple[str, DemoScores], content: DemoReport) -> None:
    page, scores = written
    words = plain(page)
    good, poor = (score_gaze(*model.outcome.pair()) for model in content.models)
    assert scores.models == (("ResNet-18", good), ("Zernike + ridge", poor))
    for one in (good, poor):
        assert f"{one.mae[0]:.3f} / {one.rmse[0]:.3f}" in words
        assert f"{one.mae_overall:.3f} / {one.rmse_overall:.3f}" in words
    assert f"{scores.baseline.mae_overall:.3f}" in words
    assert "39 of 40 frames got one" in words
    assert "0.500 px in the median" in words
    # 30 rows, one of them coasting, of 32 frames.
    assert "seen in 29 (91 %), in 2 tracks, the longest of 25 frames" in words
    assert "42.5 s" in words
    assert page.count("<img") == 10
    assert page.count('alt="') == 10
    assert "<script>alert" not in page
    assert "No real camera was filmed" in words
    assert "One more limit." in words
    assert "MAE 0.095 of the field" in words


def test_the_numbers_come_before_everything_else(written: tuple[str, DemoScores]) -> None:
    assert written[0].index('class="numbers"') < written[0].index("<section")


@pytest.mark.usefixtures("undrawn")
def test_sections_without_content_are_left_out(tmp_path: Path, content: DemoReport) -> None:
    bare = replace(content, sign=None, tracking=None, timings=(), path_rrs=(), path_rrs_at=())
    write_demo_report(tmp_path / "r.html", bare)
    words = plain((tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "Tracking" not in words
    assert "second beam, not on the target" not in words
    assert "from an empty folder" not in words


@pytest.mark.usefixtures("undrawn")
def test_a_model_no_better_than_the_mean_is_called_so(
    tmp_path: Path, content: DemoReport, told: Callable[..., Outcome]
) -> None:
    first = content.models[0].outcome
    bad = ModelResult("Hopeless", told(first.time, first.targets, -2 * first.targets), "wrong sign")
    write_demo_report(tmp_path / "r.html", replace(content, models=[bad, content.models[1]], sign=None, tracking=None))
    words = plain((tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "gaze x is worse than the training mean; gaze y is worse than the training mean. Do not use" in words
    assert "Zernike + ridge did better here than Hopeless: gaze x, gaze y" in words
    assert "Hopeless errs less than" not in words
    # Beside a good model, a poor one is called so too.
    write_demo_report(tmp_path / "r.html", replace(content, models=[content.models[1], bad], sign=None, tracking=None))
    words = plain((tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "Hopeless: gaze x is worse than the training mean. Do not use" in words


def test_bad_content_writes_nothing(tmp_path: Path, content: DemoReport, told: Callable[..., Outcome]) -> None:
    twice = replace(content, models=[content.models[0], content.models[0]])
    with pytest.raises(InputError, match="its own name"):
        write_demo_report(tmp_path / "r.html", twice)
    first = content.models[0].outcome
    holes = told(first.time, np.full_like(first.targets, np.nan), first.targets)
    with pytest.raises(InputError, match="not finite"):
        score_demo(replace(content, models=[ModelResult("Holes", holes, "")]))
    untrained = replace(first, guess=None)
    with pytest.raises(InputError, match="no training frames"):
        score_demo(replace(content, models=[ModelResult("Alone", untrained, "")]))
    assert not list(tmp_path.iterdir())
