"""The photon-transfer method against sensors whose gain, noise and full well are known."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tapetum.bench import ProbeSensor, load_scene
from tapetum.calibrate import SensorCalibration, calibrate_sensor, photon_transfer
from tapetum.calibrate.levels import exposure_in, gather
from tapetum.calibrate.photon_transfer import good_pixels
from tapetum.cli.app import main
from tapetum.errors import InputError
from tapetum.record.frames import open_frames
from tapetum.record.noise import counts

SIZE = (96, 128)
SHARES = (0.03, 0.08, 0.15, 0.25, 0.4, 0.55, 0.7, 0.9, 1.6)


def frames(
    sensor: ProbeSensor,
    light: float,
    rng: np.random.Generator,
    number: int,
    *,
    gain: np.ndarray | float = 1.0,
    offset: np.ndarray | float = 0.0,
    flicker: float = 0.0,
    uneven: float = 0.1,
    rows: float = 0.0,
) -> np.ndarray:
    """Frames [N, H, W] of the bench's sensor under smooth light of so many electrons in the middle."""
    y, x = np.mgrid[-1 : 1 : SIZE[0] * 1j, -1 : 1 : SIZE[1] * 1j]
    shape = 1 - uneven * (x**2 + 0.5 * y + y**2) / 2
    taken = []
    for _ in range(number):
        now = 1 + flicker * rng.standard_normal()
        banding = 1 + rows * np.sin(8 * np.arange(SIZE[0])[:, None] / SIZE[0] + rng.uniform(0, 7))
        mean = np.maximum(light * now * shape * banding * gain + offset, 0).astype(np.float32)
        taken.append(counts(mean, sensor, rng))
    return np.stack(taken)


def files(folder: Path, sensor: ProbeSensor, rng: np.random.Generator, **how: object) -> tuple[list[str], list[str]]:
    """Write dark and flat stacks; flat ones named by their exposure."""
    most = min(sensor.full_well, (2**sensor.bits - 1 - sensor.offset) / float(sensor.gain or 1))
    number = int(how.pop("number", 8))  # type: ignore[call-overload]
    shares = how.pop("shares", SHARES)
    np.save(folder / "dark.npy", frames(sensor, 0, rng, 2 * number, **{**how, "flicker": 0.0, "rows": 0.0}))
    flats = []
    for share in shares:  # type: ignore[attr-defined]
        flats.append(str(folder / f"flat-{1000 * share:g}us.npy"))
        np.save(flats[-1], frames(sensor, share * most, rng, number, **how))  # type: ignore[arg-type]
    return [str(folder / "dark.npy")], flats


def sensor_of(seed: int) -> ProbeSensor:
    rng = np.random.default_rng([seed, 1])
    bits = int(rng.choice([10, 12, 14]))
    full_well, top = float(rng.uniform(4000, 40000)), 2**bits - 1
    offset = float(rng.uniform(0.02, 0.05) * top)
    gain = (top - offset) / full_well * (rng.uniform(0.7, 0.95) if seed % 2 else rng.uniform(1.05, 1.4))
    noise = float(rng.uniform(2, 9))
    return ProbeSensor(pixels=SIZE[::-1], bits=bits, offset=offset, gain=gain, full_well=full_well, read_noise=noise)


def measured(folder: Path, seed: int, **how: object) -> tuple[ProbeSensor, SensorCalibration]:
    sensor = sensor_of(seed)
    return sensor, calibrate_sensor(*files(folder, sensor, np.random.default_rng(seed), **how))


def test_stated_uncertainties_hold(tmp_path: Path) -> None:
    """Over twelve sensors: four quantities, each within its error as often as a normal deviate would be."""
    found: dict[str, list[float]] = {}
    for seed in range(12):
        rng = np.random.default_rng([seed, 2])
        prnu, dsnu = rng.uniform(0.004, 0.02), rng.uniform(1, 4)
        gain = 1 + prnu * rng.standard_normal(SIZE)
        offset = 20 + dsnu * rng.standard_normal(SIZE)
        folder = tmp_path / str(seed)
        folder.mkdir()
        sensor, got = measured(folder, seed, gain=gain, offset=offset, flicker=0.003)
        one = got.measured
        most = min(sensor.full_well, (2**sensor.bits - 1 - sensor.offset) / float(sensor.gain or 1))
        # The patterned offset counts as light: 20 electrons, with their shot noise.
        truth = {
            "gain": float(sensor.gain or 0),
            "read_noise": float(np.hypot(sensor.read_noise, np.sqrt(20))),
            "full_well": most - 20,
            "sensitivity": prnu,
        }
        for name, value in truth.items():
            given = getattr(one, name)
            found.setdefault(name, []).append((given.value - value) / given.error)
            # Errors are of the size that so many pixels and frames allow.
            assert given.error < (0.01 if name in ("gain", "full_well") else 1.0) * value
        assert one.full_well_is == ("clipped" if seed % 2 else "converter")
    for name, deviates in found.items():
        # 99 % range of the RMS of twelve normal deviates: 0.5 to 1.54; limits of reading are wider than they need be.
        assert np.sqrt(np.mean(np.square(deviates))) < 1.54, (name, deviates)
        assert np.abs(deviates).max() < 4, (name, deviates)


def test_good_frames_are_good_and_make_a_scene(tmp_path: Path) -> None:
    sensor, got = measured(tmp_path, 3)
    assert got.verdict == "good", [check.line for check in got.checks() if not check.good]
    got.save(tmp_path / "mine.yaml", "3.45 um")
    scene = load_scene("thin-lens", [f"probe.sensor={tmp_path / 'mine.yaml'}", "probe.sensor.exposure=2 ms"])
    mine = scene.probe.sensor
    assert mine.pixels == (SIZE[1], SIZE[0]) and mine.bits == sensor.bits and mine.exposure == 2e-3
    assert mine.pitch == pytest.approx(3.45e-6)
    assert mine.gain == pytest.approx(sensor.gain, rel=0.01)
    assert mine.full_well == pytest.approx(sensor.full_well, rel=0.01)
    assert np.nanmax(np.abs(got.measured.linearity)) < 0.01
    got.write_page(tmp_path / "mine.html")
    assert "Verdict: good" in (tmp_path / "mine.html").read_text("utf-8")


def test_a_sensor_file_without_pitch_is_refused(tmp_path: Path) -> None:
    _, got = measured(tmp_path, 3, number=4)
    got.save(tmp_path / "mine.yaml")
    with pytest.raises(InputError, match=r"mine.yaml: states no pixel pitch; add 'pitch"):
        load_scene("thin-lens", [f"probe.sensor={tmp_path / 'mine.yaml'}"])
    with pytest.raises(InputError, match=r"none.yaml: no such file; give a file that"):
        load_scene("thin-lens", ["probe.sensor=none.yaml"])


@pytest.mark.parametrize(
    ("how", "amiss"),
    [
        ({"flicker": 0.02}, "flicker between frames"),
        ({"flicker": 0.2}, "frames in levels"),
        ({"uneven": 0.9}, "evenness of the light"),
        ({"rows": 0.02}, "flicker of rows"),
        ({"shares": (0.1, 0.3, 0.5)}, "saturation"),
        ({"shares": (0.1, 0.3, 0.5, 1.5)}, "levels for the line"),
        ({"shares": (0.02, 0.04, 0.06, 0.1, 0.15, 0.2)}, "range of the levels"),
        ({"offset": 3000.0}, "dark level"),
    ],
)
def test_what_is_amiss_is_named(tmp_path: Path, how: dict[str, object], amiss: str) -> None:
    sensor = sensor_of(3)
    got = calibrate_sensor(*files(tmp_path, sensor, np.random.default_rng(3), **how), bits=sensor.bits)
    assert amiss in [check.what for check in got.checks() if not check.good]
    assert got.verdict.startswith("to correct: ")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], list[str]]:
    """Dark and flat stacks with which nothing is amiss; no test writes to them."""
    return files(tmp_path_factory.mktemp("good"), sensor_of(3), np.random.default_rng(1))


def changed(good: tuple[list[str], list[str]], folder: Path, change) -> SensorCalibration:
    dark, flats = ([str(folder / Path(file).name) for file in part] for part in good)
    for file, own in zip((*good[0], *good[1]), (*dark, *flats), strict=True):
        np.save(own, change(np.load(file)))
    return calibrate_sensor(dark, flats)


def smoothed(images: np.ndarray) -> np.ndarray:
    wide = images.astype(np.float64)
    return np.rint((wide + np.roll(wide, 1, axis=2)) / 2).astype(images.dtype)


@pytest.mark.parametrize(
    ("change", "amiss"),
    [
        (smoothed, "noise shared by neighbours"),
        (lambda images: np.repeat(images[::2], 2, axis=0), "repeated frames"),
        (lambda images: (images // 4 * 4).astype(images.dtype), "step of the numbers"),
        (
            lambda images: np.maximum(images.astype(int) - int(sensor_of(3).offset), 0).astype(np.uint16),
            "dark frames at zero",
        ),
        (lambda images: np.rint(4000 * (images / 4095) ** 0.45).astype(np.uint16), "straightness of the variance"),
    ],
)
def test_frames_that_were_worked_on_are_found_out(
    good: tuple[list[str], list[str]], tmp_path: Path, change, amiss: str
) -> None:
    got = changed(good, tmp_path, change)
    assert amiss in [check.what for check in got.checks() if not check.good], got.verdict


def test_rounding_that_hides_the_read_noise_is_said(tmp_path: Path) -> None:
    """8 bit over 20 000 electrons: 78 electrons a step, 3 electrons of noise."""
    sensor = ProbeSensor(pixels=SIZE[::-1], bits=8, offset=6.4, gain=248 / 20000, full_well=19000, read_noise=3)
    got = calibrate_sensor(*files(tmp_path, sensor, np.random.default_rng(4)))
    assert got.measured.read_noise_is == "hidden" and got.measured.read_noise.value > 3
    assert got.measured.gain.value == pytest.approx(248 / 20000, rel=0.02)
    assert abs(got.measured.offset.value - 6.4) < 3 * got.measured.offset.error
    assert "dark noise" in got.verdict


def test_levels_of_one_video_are_told_apart(tmp_path: Path) -> None:
    sensor, rng = sensor_of(3), np.random.default_rng(2)
    most = sensor.full_well
    ramp = np.concatenate([frames(sensor, share * most, rng, 6) for share in SHARES])
    np.save(tmp_path / "ramp.npy", ramp)
    np.save(tmp_path / "dark.npy", frames(sensor, 0, rng, 12))
    got = calibrate_sensor([tmp_path / "dark.npy"], [tmp_path / "ramp.npy"])
    assert len(got.measured.flats) == len(SHARES) and got.kept == got.frames == 66
    assert (
        not len(got.measured.linearity)
        and "not measured: no exposure times" in dict(got.numbers())["linearity: largest deviation"]
    )
    times = [share / 1000 for share in SHARES]
    timed = calibrate_sensor([tmp_path / "dark.npy"], [tmp_path / "ramp.npy"], exposures=times)
    assert np.nanmax(np.abs(timed.measured.linearity)) < 0.01
    with pytest.raises(InputError, match=r"--exposures: 2 times for 9 flat levels"):
        calibrate_sensor([tmp_path / "dark.npy"], [tmp_path / "ramp.npy"], exposures=[1, 2])


def test_dark_current_from_dark_frames_of_three_exposures(tmp_path: Path) -> None:
    sensor, rng = sensor_of(3), np.random.default_rng(2)
    darks = []
    for seconds in (0.1, 0.5, 1.0):
        darks.append(tmp_path / f"dark-{seconds}s.npy")
        np.save(darks[-1], frames(sensor, 0, rng, 12, offset=40 * seconds))
    _, flats = files(tmp_path, sensor, rng)
    current = calibrate_sensor(darks, flats).measured.dark_current
    assert current is not None and abs(current.value - 40) < 3 * current.error < 6


def test_names_state_exposures() -> None:
    assert exposure_in("flat-2.5ms.npy") == 2.5e-3 and exposure_in("a/500us") == 5e-4 and exposure_in("t_2s_b") == 2.0
    assert exposure_in("flats.npy") is None and exposure_in("12.mkv") is None


def test_the_command_and_its_misuse(
    good: tuple[list[str], list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dark, flats = good
    out = tmp_path / "s.yaml"

    def run(*words: object) -> tuple[int, str, str]:
        code = main(["calibrate", "probe", *map(str, words)])
        return code, *capsys.readouterr()

    code, said, _ = run(*dark, *flats, "-o", out, "--pitch", "3 um", "--json")
    told = json.loads(said)
    assert code == 0 and told["verdict"] == "good" and told["gain"]["error"] > 0 and (tmp_path / "s.html").exists()
    assert run(*dark, *flats, "-o", out)[0] == 2
    code, said, _ = run(*dark, *flats[:3], "-o", out, "--overwrite")
    assert code == 1 and "to correct" in said and "saturation: not reached" in said
    for words, complaint in (
        ([*dark, "-o", tmp_path / "t.yaml"], "error: FLAT: no flat frames are named"),
        ([*dark, *flats, "-o", tmp_path / "t.json"], "t.json: is no name for this; name it NAME.yaml"),
        ([*dark, tmp_path / "none.npy", "-o", tmp_path / "t.yaml"], "none.npy: does not exist"),
        ([*dark, *flats, "-o", tmp_path / "t.yaml", "--pitch", "3 s"], "--pitch: '3 s' has the wrong dimension"),
        ([*dark, *flats, "-o", tmp_path / "t.yaml", "--bits", "6"], "--bits: the frames hold"),
        ([flats[0], flats[0], "-o", tmp_path / "t.yaml"], "error: FLAT: no flat frames are named"),
        ([*dark, flats[0], "-o", tmp_path / "t.yaml"], "flat frames: 1 flat level of two frames or more"),
        ([*dark, "camera:0x", "-o", tmp_path / "t.yaml"], "camera:0x: names no camera"),
    ):
        code, _, complaint_given = run(*words)
        last = complaint_given.splitlines()[-1]
        assert code == 2 and complaint in last, last
        assert not (tmp_path / "t.yaml").exists()


def test_frames_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    dark, flats = files(tmp_path, sensor_of(3), np.random.default_rng(1), number=4)
    np.save(flats[0], np.zeros((3, 40, 40), np.uint16))
    with pytest.raises(InputError, match=r"frames are 40 x 40 px, the dark ones 128 x 96 px"):
        calibrate_sensor(dark, flats)
    np.save(tmp_path / "float.npy", np.zeros((3, 40, 40)))
    with pytest.raises(InputError, match="holds float64, not whole numbers"):
        calibrate_sensor(dark, [tmp_path / "float.npy"])
    (tmp_path / "torn.npy").write_bytes((tmp_path / "float.npy").read_bytes()[:200])
    with pytest.raises(InputError, match=r"is truncated, or no \.npy"):
        open_frames(tmp_path / "torn.npy")
    np.save(tmp_path / "tiny.npy", np.zeros((3, 8, 8), np.uint8))
    with pytest.raises(InputError, match="8 x 8 px are too few"):
        calibrate_sensor([tmp_path / "tiny.npy"], flats)


def test_levels_without_a_line_are_refused() -> None:
    class Named:
        name = "flat"

    def still(value: int) -> Iterator[object]:
        from tapetum.record.source import Frame

        for n in range(3):
            yield Frame(n, 0.0, np.full(SIZE, value, np.uint8), f"x[{n}]")

    dark = list(gather(still(3), Named()))  # type: ignore[arg-type]
    assert good_pixels(dark[0]).all()
    flats = [level for value in (40, 60, 80) for level in gather(still(value), Named())]  # type: ignore[arg-type]
    with pytest.raises(InputError, match="no line of variance over signal could be fitted"):
        photon_transfer(dark, flats)
