"""What the virtual bench films, asked for on the command line, and what real sources have no use for."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tapetum.record.frames import open_frames
from tapetum.record.recording import open_recording
from tapetum.record.video import VideoWriter

LITTLE = (
    *("--set", "probe.sensor.pixels=[160, 120]", "--set", "target.sensor.pixels=[162, 122]"),
    *("--set", "target.sensor.pitch=35.2um", "--set", "sampling.accuracy=0.05"),
)
# Less light, and in less time: too little for blinking that is to be found.
DIM = (*LITTLE, "--set", "target.lens.aperture_radius=2mm")


def test_the_benchs_motion_blinks_and_clutter(run, tmp_path: Path) -> None:
    out, plain = tmp_path / "a.rec", tmp_path / "plain.rec"
    asked = ("--roll", 3, "--walk", 5.5, 4, "--blink", 4, "--clutter", 2, "--stray")
    assert run("record", "hand-held", "-o", out, "--seconds", 2, "--seed", 5, *asked, *DIM).code == 0
    recording = open_recording(out)
    told = recording.meta
    assert told["motion"]["roll"] == pytest.approx(math.radians(3)) and list(told["motion"]["walk"]) == [5.5, 4]
    assert told["laser"]["code"]["seed"] == 4 and len(told["clutter"]) == 2
    assert {one["kind"] for one in told["stray"]} == {"dimroom", "gradient", "fixedpattern"}
    assert run("record", "hand-held", "-o", plain, "--seconds", 2, "--seed", 5, "--no-labels", *DIM).code == 0
    alone = open_recording(plain).meta
    assert alone["motion"]["walk"] is None and alone["motion"]["roll"] == 0
    assert alone["laser"]["code"] is None and alone["clutter"] == [] and alone["stray"] == []
    # They are in the pictures, not only in the words.
    light, dark = (np.stack([frame.image for frame in open_frames(path)]) for path in (out, plain))
    assert np.median(light.max(0)) > np.median(dark.max(0)) + 1
    target = [float(frame.image.max()) for frame in open_frames(out, "target")]
    # The word holds off bits: without the laser the brightest pixel is a dimmer one.
    assert min(target) < 0.7 * max(target)


@pytest.mark.parametrize("option", [("--roll", 2), ("--walk", 5, 4), ("--clutter", 3), ("--stray",), ("--seed", 1)])
def test_a_real_source_refuses_what_is_the_benchs(run, chain, tmp_path: Path, option: tuple[object, ...]) -> None:
    probe = chain.recording / "probe.mkv"
    ran = run("record", probe, "--target", "camera:1", "-o", tmp_path / "a.rec", *option)
    assert ran.code == 2 and f"{option[0]}: belongs to scenes of the virtual bench" in ran.complaint
    scene = run("record", "hand-held", "--target", "camera:1", "-o", tmp_path / "a.rec", *option)
    assert scene.code == 2 and "films its own target" in scene.complaint
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--blinker", "/dev/none"), "--blinker: has no code to blink; give its number too: --blink 1"),
        (("--align", "guess"), "--align: unknown value 'guess'; use one of clock, blink"),
        (("--offset", "3 m"), "--offset: '3 m' has the wrong dimension"),
        (("--offset", "soon"), "--offset: 'soon' is no quantity"),
    ],
)
def test_options_of_real_clocks_that_cannot_be(
    run, chain, tmp_path: Path, option: tuple[object, ...], words: str
) -> None:
    probe, target = (chain.recording / f"{name}.mkv" for name in ("probe", "target"))
    ran = run("record", probe, "--target-source", target, "-o", tmp_path / "a.rec", *option)
    assert ran.code == 2 and words in ran.complaint and list(tmp_path.iterdir()) == []
    if option[0] != "--blinker":
        alone = run("record", probe, "-o", tmp_path / "a.rec", *option)
        assert alone.code == 2 and f"{option[0]}: takes two streams; give --target-source" in alone.complaint
    bench = run("record", "hand-held", "-o", tmp_path / "a.rec", *option)
    assert bench.code == 2 and f"{option[0]}: belongs to real sources" in bench.complaint


def test_a_real_recording_is_aligned_by_its_blinking_and_an_offset(run, tmp_path: Path) -> None:
    """Two videos of one bench, the target's begun 0.4 s later: their own times both count from 0."""
    bench = tmp_path / "bench.rec"
    assert run("record", "hand-held", "-o", bench, "--seconds", 6, "--blink", 4, "--no-labels", *LITTLE).code == 0
    begun = {}
    for name, skip in (("probe", 0), ("target", 6)):
        frames = list(open_frames(bench, name))[skip:]
        begun[name] = frames[0].utc_ns
        with VideoWriter(tmp_path / f"{name}.mkv", frames[0].image.shape) as video:
            for frame in frames:
                video.write(frame.image, frame.time - frames[0].time)
    true = (begun["target"] - begun["probe"]) / 1e9
    sources = (tmp_path / "probe.mkv", "--target-source", tmp_path / "target.mkv", "--no-labels")
    ran = run("record", *sources, "-o", tmp_path / "a.rec", "--align", "blink", "--blink", 4)
    assert ran.code == 0 and "aligned by the blinking: target +0." in ran.out
    told = open_recording(tmp_path / "a.rec").meta
    # To half a frame: bits of three frames tell no more.
    assert 0.35 < true < 0.5 and told["aligned"][0]["seconds"] == pytest.approx(true, abs=0.035)
    assert told["laser"]["code"]["word"] and told["laser"]["code"]["seed"] == 4
    ran = run("record", *sources, "-o", tmp_path / "b.rec", "--offset", "20 ms")
    assert ran.code == 0
    shifted = open_recording(tmp_path / "b.rec")
    assert shifted.utc_ns("target")[0] - shifted.utc_ns("probe")[0] == 20_000_000
    assert shifted.meta["aligned"] == [{"stream": "target", "seconds": 0.02, "align": "clock", "offset": 0.02}]


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--walk", 5, 0), "motion.walk: must be positive, is (5.0, 0.0)"),
        (("--walk", "nan", 3), "motion.walk: must not be negative, is (nan, 3.0)"),
        (("--walk", 5), "--walk"),
        (("--roll", "nan"), "Invalid value for '--roll'"),
        (("--roll", -1), "--roll"),
        (("--clutter", -1), "--clutter"),
    ],
)
def test_a_motion_that_cannot_be(run, tmp_path: Path, option: tuple[object, ...], words: str) -> None:
    ran = run("record", "hand-held", "-o", tmp_path / "a.rec", "--seconds", 1, *option)
    assert ran.code == 2 and words in ran.complaint and list(tmp_path.iterdir()) == []


def test_the_guide_says_which_places_of_the_field_lack_labels(run, tmp_path: Path) -> None:
    ran = run("record", "hand-held", "-o", tmp_path / "a.rec", "--seconds", 4, "--guide", *DIM)
    assert ran.code == 0, ran.err
    drawn = ran.out.split("as its picture shows it")[1].splitlines()[1:6]
    assert all(set(row.replace(" ", "")) <= set("#+.") for row in drawn) and "." in "".join(drawn)
    assert "lack labels; bring the laser's spot to:" in ran.out
    refused = run("record", "hand-held", "-o", tmp_path / "b.rec", "--guide", "--no-labels", *LITTLE)
    assert refused.code == 2 and "--guide: needs labels" in refused.complaint
