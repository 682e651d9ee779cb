"""`tapetum export`: one ONNX file, or one line and nothing written."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from pyarrow import csv
from tests.cli.conftest import Ran

from tapetum.cli.app import main
from tapetum.models import pretrained
from tapetum.models.fast import FastResNet18


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ran]:
    """The bundled model as a file, and what the command that made it said."""
    path = tmp_path_factory.mktemp("exported") / "gaze.onnx"
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        code = main(["export", "thin-lens-gaze", "-o", str(path)])
    return path, Ran(code, out.getvalue(), err.getvalue())


def test_the_bundled_model(exported: tuple[Path, Ran]) -> None:
    out, ran = exported
    assert (ran.code, ran.err) == (0, "")
    assert ran.out == f"{out}: 50 MB\n" and out.stat().st_size == pytest.approx(50e6, rel=0.02)
    images = np.random.default_rng(0).integers(0, 256, (2, 330, 330), dtype=np.uint8)
    wanted = pretrained().predict(images)
    np.testing.assert_allclose(FastResNet18(out, threads=1).predict(images).value, wanted.value, rtol=0, atol=1e-5)


def test_what_was_exported_evaluates_and_tracks(run, chain, exported: tuple[Path, Ran], tmp_path: Path) -> None:
    (fast, _), tables, film = exported, {}, tmp_path / "film.rec"
    # Of the chain's drawn spots the model says nothing: it was made for a camera.
    assert run("record", "hand-held", "--seconds", "0.5", "--seed", "41", "--no-labels", "-o", film).code == 0
    for name in ("thin-lens-gaze", str(fast)):
        out = tmp_path / "tracks.csv"
        ran = run("track", film, "--model", name, "-o", out, "--overwrite")
        assert ran.code == 0
        tables[name] = csv.read_csv(out)
    slow, quick = tables.values()
    assert slow.num_rows == quick.num_rows > 0
    for column in ("gaze_x", "gaze_x_low", "gaze_y_high"):
        one, other = (np.array(table[column].to_pylist(), dtype=float) for table in (slow, quick))
        assert np.isfinite(one).any()
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-4)
    again = run("export", fast, "-o", tmp_path / "twice.onnx")
    assert again.code == 2 and "is exported already" in again.complaint
    missing = run("track", chain.recording, "--model", tmp_path / "no.onnx", "-o", tmp_path / "t.csv")
    assert missing.code == 2 and "there is no such model" in missing.complaint


def test_what_cannot_be_exported(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments, words in (
        (("thin-lens-gaze", "-o", tmp_path / "m.pt"), "unknown kind of export '.pt'; name it NAME.onnx"),
        (
            ("no-such", "-o", tmp_path / "m.onnx"),
            "no-such: is neither a model's folder or .onnx file nor the name of a bundled",
        ),
        (("thin-lens-gaze",), "Missing option"),
    ):
        ran = run("export", *arguments)
        assert ran.code == 2 and words in ran.complaint
    monkeypatch.setitem(sys.modules, "onnx", None)
    ran = run("export", "thin-lens-gaze", "-o", tmp_path / "m.onnx")
    assert ran.code == 2
    assert ran.complaint == "error: onnx is not installed; pip install 'tapetum[fast]'"
    assert not list(tmp_path.iterdir())


def test_a_ridge_is_refused(run, chain, tmp_path: Path) -> None:
    ran = run("export", chain.model, "-o", tmp_path / "m.onnx")
    assert ran.code == 2
    assert "only networks become ONNX, this one is zernike" in ran.complaint
    assert not list(tmp_path.iterdir())
