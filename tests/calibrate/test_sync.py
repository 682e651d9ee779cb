"""Lag and drift of two cameras by the laser's code, in recordings whose clocks were set wrong by known amounts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tapetum.calibrate import calibrate_sync
from tapetum.calibrate.sync import code_of
from tapetum.cli.app import main
from tapetum.errors import InputError
from tapetum.record.aligning import shift_stream
from tapetum.record.laser import BlinkCode
from tapetum.record.recording import RecordingWriter, StreamInfo, open_recording

START = 10**18
SIZE = (40, 48)


def blinked(
    path: Path, seed: int, *, lag: float = 0.0, drift: float = 0.0, words: int = 3, every: float = 9.041,
    rates: tuple[float, float] = (15.0, 30.0), told: bool = True, unseen: bool = False,
) -> BlinkCode:  # fmt: skip
    """Write a recording in which the target's stamps are early by `lag` at its middle, and drift."""
    rng = np.random.default_rng(seed)
    code = BlinkCode(seed=7, every=every if words > 1 else None, start=0.6)
    seconds = every * words
    shown = {"bit": code.bit, "word": list(code.sent), "start": code.start, "every": code.every}
    frames = []
    for name, rate, exposure in zip(("probe", "target"), rates, (2e-4, 2e-3), strict=True):
        times = rng.uniform(0, 1 / rate) + np.arange(int(seconds * rate) - 1) / rate
        times = times[rng.random(len(times)) > 0.01]
        share = code.share(times + 1.5e-3 * rng.standard_normal(len(times)), exposure)
        stamps = times if name == "probe" else times - lag - drift * (times - seconds / 2)
        frames += [(stamp, name, light, exposure) for stamp, light in zip(stamps, share, strict=True)]
    info = {name: StreamInfo(*SIZE, 8, rate=rate) for name, rate in zip(("probe", "target"), rates, strict=True)}
    extra = {"laser": {"code": shown}} if told else {}
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    with RecordingWriter(path, streams=info, rate=15.0, hardware={}, start_utc_ns=START, extra=extra) as writer:
        for stamp, name, light, exposure in sorted(frames, key=lambda one: one[0]):
            image = rng.normal(12, 1.5, SIZE)
            height = 0 if unseen and name == "target" else 120 * (1 + 0.3 * np.sin(2 * stamp))
            image += light * height * np.exp(-((x - 24 - 5 * np.sin(stamp)) ** 2 + (y - 20) ** 2) / 6)
            moment = round(stamp * 1e9) + 10**9
            writer.write(name, image.clip(0, 255).round().astype(np.uint8), monotonic_ns=moment, utc_ns=START + moment)
            del exposure
    return code


@pytest.mark.slow
def test_lag_and_drift_lie_within_their_errors(tmp_path: Path) -> None:
    deviates = []
    for seed, (lag, drift, words, rate) in enumerate(
        [
            (0.03, 0.0, 1, 15.0),
            (-0.05, 4e-4, 4, 30.0),
            (0.08, -3e-4, 5, 60.0),
            (0.0, 0.0, 4, 15.0),
            (-0.02, 8e-4, 4, 60.0),
        ]
    ):
        blinked(tmp_path / f"{seed}.rec", seed, lag=lag, drift=drift, words=words, rates=(15.0, rate))
        got = calibrate_sync(open_recording(tmp_path / f"{seed}.rec"))
        assert len(got.probe) == words
        deviates.append((got.lag.value - lag) / got.lag.error)
        # A word alone is known to a third of a frame, several at different phases to some milliseconds.
        assert got.lag.error < (0.04 if words == 1 else 0.02)
        if got.drift is not None:
            deviates.append((got.drift.value - drift) / got.drift.error)
            assert got.residual is not None and got.residual < 0.03
    assert np.abs(deviates).max() < 3 and np.sqrt(np.mean(np.square(deviates))) < 1.5, deviates


@pytest.mark.slow
def test_words_at_one_phase_of_the_frames_tell_no_more_than_one(tmp_path: Path) -> None:
    """Nine seconds are 135 frames: every flank falls on one place between two frames."""
    for every, name in ((9.0, "locked"), (9.041, "free")):
        blinked(tmp_path / f"{name}.rec", 3, lag=0.01, words=5, every=every, rates=(15.0, 15.0))
    locked, free = (calibrate_sync(open_recording(tmp_path / f"{name}.rec")).lag for name in ("locked", "free"))
    assert locked.error > 0.015 > free.error
    assert abs(locked.value - 0.01) < 2 * locked.error and abs(free.value - 0.01) < 3 * free.error


def test_a_measured_lag_is_put_right(tmp_path: Path) -> None:
    blinked(tmp_path / "a.rec", 2, lag=0.09, words=2)
    recording = open_recording(tmp_path / "a.rec")
    lag = calibrate_sync(recording).lag.value
    before = {name: recording.utc_ns(name) for name in ("probe", "target")}
    again = shift_stream(recording, "target", lag, {"align": "test"})
    assert np.array_equal(again.utc_ns("probe"), before["probe"])
    assert np.all(again.utc_ns("target") - before["target"] == round(lag * 1e9))
    assert again.meta["aligned"] == [{"stream": "target", "seconds": lag, "align": "test"}]
    assert np.array_equal(again.frames("target")["monotonic_ns"], recording.frames("target")["monotonic_ns"])
    assert abs(calibrate_sync(again).lag.value) < 2e-3


def test_the_command_and_its_misuse(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blinked(tmp_path / "a.rec", 2, words=2, told=False)
    blinked(tmp_path / "dark.rec", 2, words=1, unseen=True)
    assert code_of(open_recording(tmp_path / "a.rec")) is None

    def run(*words: object) -> tuple[int, str, str]:
        code = main(["calibrate", "sync", *map(str, words)])
        said = capsys.readouterr()
        return code, said.out, said.err

    out = tmp_path / "s.yaml"
    code, said, _ = run(tmp_path / "a.rec", "--blink", 7, "-o", out)
    assert code in (0, 1) and "lag: to add to the target's times" in said and "words" in said
    assert "Verdict" in (tmp_path / "s.html").read_text("utf-8") and out.read_text("utf-8").startswith("# Written by")
    for words, complaint in (
        ([tmp_path / "a.rec"], "does not say which code was blinked; give --blink N"),
        ([tmp_path / "a.rec", "--blink", 8], "no word of the code is seen in both streams"),
        ([tmp_path / "dark.rec"], "no word of the code is seen in both streams (1 in probe, 0 in target)"),
        ([tmp_path / "a.rec", "--bit", "0.2 s"], "--bit: is that of a code"),
        ([tmp_path / "a.rec", "--blink", 7, "--bit", "2 m"], "--bit: '2 m' has the wrong dimension"),
        ([tmp_path / "none.rec"], "none.rec: does not exist"),
    ):
        code, _, complaint_given = run(*words, "-o", tmp_path / "t.yaml")
        assert code == 2 and complaint in complaint_given.splitlines()[-1], complaint_given
    assert not (tmp_path / "t.yaml").exists()


def test_labels_keep_a_recording_from_being_shifted(tmp_path: Path) -> None:
    import pyarrow as pa

    blinked(tmp_path / "a.rec", 2, words=1)
    recording = open_recording(tmp_path / "a.rec")
    recording.write_labels(pa.table({"frame": [0], "how": ["x"], "quality": [1.0]}))
    with pytest.raises(InputError, match="has labels, which rest on its clocks; remove labels"):
        shift_stream(recording, "target", 0.01, {})
