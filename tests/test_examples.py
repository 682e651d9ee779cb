"""The example scripts run, and find what they say they find."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PHOTOGRAPHS = ROOT / ".." / "shared" / "data" / "laser-spots"


def example(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(f"example_{name}", ROOT / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up by its name.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_every_example_is_tested():
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == {
        "fig4",
        "fit_by_simulation",
        "gradient",
        "limits",
        "movie_theater",
        "track_photos",
        "twin",
        "two_probes",
    }


def test_fig4_draws_a_grid(tmp_path: Path):
    import cv2

    out = tmp_path / "fig4.png"
    small = ["--set", "probe.sensor.pixels=[64, 64]", "--set", "sampling.accuracy=0.01"]
    example("fig4").main(["-o", str(out), "--rotations", "0", "0.5", "--distances", "2.5", "5", *small])
    picture = cv2.imread(str(out))
    assert picture is not None and min(picture.shape[:2]) > 200
    # Dark surroundings and bright RRs, not an empty page.
    assert picture.std() > 30


def test_gradient_finds_tilt_and_focus_again():
    tilt, distance = example("gradient").main(["--steps", "25"])
    assert tilt == pytest.approx(0.4, abs=0.02)
    assert distance == pytest.approx(2.5, rel=0.04)


def test_track_photos_without_a_folder_follows_one_camera(capsys):
    table = example("track_photos").main([])
    assert {track for _, track, _, _ in table} == {1}
    assert len(table) == 8
    steps = np.diff([(x, y) for _, _, x, y in table], axis=0)
    assert np.hypot(*steps.T).max() < 30
    assert "frame-007.png" in capsys.readouterr().out


@pytest.mark.skipif(not PHOTOGRAPHS.is_dir(), reason="needs the photographs of laser spots in ../shared/data")
def test_track_photos_of_real_beams(tmp_path: Path):
    chosen = ("t-168mm.pgm", "t-414mm.pgm", "t-hene.pgm")
    for name in chosen:
        shutil.copy(PHOTOGRAPHS / name, tmp_path)
    table = example("track_photos").main([str(tmp_path)])
    assert {name for name, _, _, _ in table} == set(chosen)


def test_limits_fall_with_the_power(capsys: pytest.CaptureFixture[str]):
    rows = example("limits").main(["--powers", "0.25", "1", "--set", "sampling.accuracy=0.01"])
    (_, _, dim, dim_focus), (_, _, bright, bright_focus) = rows
    assert 1.9 < dim / bright < 4 and 1.9 < dim_focus / bright_focus < 4
    assert "focus" in capsys.readouterr().out


@pytest.mark.slow
def test_a_fit_by_simulation_finds_the_gaze():
    true, value, half, _ = example("fit_by_simulation").main([])
    assert abs(value - true).max() < 1e-3
    assert (abs(value - true) <= half).mean() > 0.6


def test_two_probes_answer_where_one_cannot():
    results = example("two_probes").main(["--seconds", "1"])
    answered = {name: frames for name, (_, frames, _) in results.items()}
    assert answered["smoothed, fused"] > max(answered["left probe"], answered["right probe"])


@pytest.mark.slow
def test_a_movie_theater_is_lit_more_evenly(tmp_path: Path):
    cases = example("movie_theater").main(["-o", str(tmp_path / "theater.png")])
    assert (tmp_path / "theater.png").stat().st_size > 10_000
    (one_light, one_snr), (many_light, many_snr) = cases.values()
    assert many_light.ratio < one_light.ratio and many_snr.ratio < one_snr.ratio


@pytest.mark.slow
def test_a_twin_reads_frames_and_films(capsys: pytest.CaptureFixture[str]):
    found, off, count = example("twin").main([])
    assert found.misfit_lit < 1.05 < found.before.misfit_lit
    assert (np.abs(off) < 4).all() and count > 30
    assert "misfit" in capsys.readouterr().out
