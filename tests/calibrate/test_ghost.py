"""The beam splitter's ghost, of the virtual bench, whose offset and ratio are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tapetum.bench import load_scene
from tapetum.calibrate import calibrate_second_beam
from tapetum.cli.app import main
from tapetum.errors import InputError
from tapetum.record import Session
from tapetum.record.shot import Shot
from tapetum.record.source import Frame
from tapetum.track.ghosts import Ghost


def spots(seed: int, dx: float, dy: float, ratio: float, number: int = 40, noise: float = 1.5) -> list[Frame]:
    """Frames of one spot that wanders, with its dim companion: Gaussians of one width."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:160, :200].astype(float)
    frames = []
    for n in range(number):
        cx, cy = 100 + 40 * np.sin(n / 6) + rng.uniform(-1, 1), 80 + 25 * np.cos(n / 5)
        image = 10 + noise * rng.standard_normal(x.shape)
        for px, py, height in ((cx, cy, 180.0), (cx + dx, cy + dy, 180 * ratio)):
            image += height * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 3.0**2))
        frames.append(Frame(n, n / 15, image.clip(0, 255).round().astype(np.uint8), f"x[{n}]"))
    return frames


@pytest.mark.parametrize(("dx", "dy", "ratio"), [(35.0, -20.0, 0.2), (-30.0, 28.0, 0.12)])
def test_offset_and_ratio_lie_within_their_errors(dx: float, dy: float, ratio: float) -> None:
    got = calibrate_second_beam(spots(1, dx, dy, ratio), focal_length=0.1, pitch=2.2e-6)
    for found, true in ((got.dx, dx), (got.dy, dy), (got.ratio, ratio)):
        assert abs(found.value - true) < 2 * found.error and found.error < 0.05 * abs(true)
    assert got.verdict == "good" and got.angle is not None
    assert got.angle[0].value == pytest.approx(-dx * 2.2e-6 / 0.1, rel=0.01)


def test_the_benchs_second_beam_is_found_and_read_by_tracker_and_scene(tmp_path: Path) -> None:
    scene = load_scene("hand-held", ["second_beam={ratio: 0.2, angle: ['1.1 mrad', '-0.9 mrad']}"])
    beam = scene.illumination.second_beam
    assert beam is not None
    camera = Shot(scene, Session(seconds=2.5, seed=11)).cameras["probe"]
    lens, sensor = scene.probe.lens, scene.probe.sensor
    got = calibrate_second_beam(iter(camera), focal_length=lens.focal_length, pitch=sensor.pitch)
    true = Ghost.of(scene)
    for found, value in ((got.dx, true.dx), (got.dy, true.dy), (got.ratio, true.ratio)):
        assert abs(found.value - value) < 3 * found.error, (found, value)
    got.save(tmp_path / "ghost.yaml")
    known = Ghost.load(tmp_path / "ghost.yaml")
    assert known == got.ghost
    mine = load_scene("hand-held", [f"illumination.second_beam={tmp_path / 'ghost.yaml'}"]).illumination.second_beam
    assert mine is not None and mine.ratio == pytest.approx(got.ratio.value, rel=1e-5)
    # Within the scatter of the offset.
    assert np.allclose(
        mine.angle, beam.angle, atol=3 * max(got.dx.error, got.dy.error) * sensor.pitch / lens.focal_length
    )
    got.write_page(tmp_path / "ghost.html")
    assert "Verdict" in (tmp_path / "ghost.html").read_text("utf-8")


def test_a_ghost_that_touches_its_bright_spot_is_said() -> None:
    """The scene's own: 90 px away from spots of 120 px. The bright one cuts it, and only its far side is seen."""
    scene = load_scene("hand-held")
    got = calibrate_second_beam(iter(Shot(scene, Session(seconds=2, seed=11)).cameras["probe"]))
    assert "offset over the spots' diameter" in got.verdict
    true = Ghost.of(scene)
    assert abs(got.dx.value - true.dx) > 20 and abs(got.dx.value - true.dx) < 2 * got.dx.error


def test_a_lamp_that_stands_is_no_ghost() -> None:
    still = spots(1, 35, -20, 0.2)[:1] * 30
    got = calibrate_second_beam(still)
    assert "way of the bright spot" in got.verdict


def test_frames_without_a_ghost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="no ghost was found"):
        calibrate_second_beam(spots(1, 35, -20, 0.0))
    np.save(tmp_path / "alone.npy", np.stack([frame.image for frame in spots(1, 35, -20, 0.2)]))

    def run(*words: object) -> tuple[int, str, str]:
        code = main(["calibrate", "ghost", *map(str, words)])
        return code, *capsys.readouterr()

    out = tmp_path / "g.yaml"
    code, said, _ = run(tmp_path / "alone.npy", "-o", out)
    assert code == 0 and "good" in said and (tmp_path / "g.html").exists()
    with pytest.raises(
        InputError, match=r"g.yaml: has no second_beam; make it again by `tapetum calibrate ghost --focal"
    ):
        load_scene("hand-held", [f"illumination.second_beam={out}"])
    assert run(tmp_path / "alone.npy", "-o", tmp_path / "h.yaml", "--pitch", "2 um")[2].startswith(
        "error: --focal-length: is missing"
    )
    assert "--detector" in run(tmp_path / "alone.npy", "-o", tmp_path / "h.yaml", "--detector", "x")[2]
    tracked = tmp_path / "t.csv"
    assert main(["track", str(tmp_path / "alone.npy"), "--ghost", str(out), "-o", str(tracked)]) == 0
    plain = tmp_path / "p.csv"
    assert main(["track", str(tmp_path / "alone.npy"), "-o", str(plain), "--ghost", "hand-held"]) == 0
    # Rows of the one camera, without its ghost's.
    assert len(tracked.read_text().splitlines()) < len(plain.read_text().splitlines())
