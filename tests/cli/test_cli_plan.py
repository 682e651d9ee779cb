"""`tapetum plan`: text and JSON of the bundled scenes, and what cannot be planned."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from tapetum.bench import load_scene
from tapetum.simulate.budget import link_budget
from tapetum.simulate.eye_safety import NOT_A_CERTIFICATE
from tapetum.simulate.information import fisher

SMALL = ("--set", "probe.sensor.pixels=[40, 32]", "--set", "sampling.accuracy=0.01")
PLAIN = ("--set", "target.sensor={pixels: [648, 486], pitch: 8.8 um}")
# What the commands say, not how well they know it, is asked for: a traced lens is planned in seconds.
ROUGH = ("--set", "sampling.accuracy=0.3")
TWO = ("--set", "illumination.lines=[{wavelength: 532 nm, power: 1 mW}]")
KEYS = ["scene", "geometry", "link_budget", "sampling", "limit", "labels", "eye_safety"]
THIN = ("hand-held", "thin-lens")
NAMES = ["gaze_x", "gaze_y", "object_distance", "focal_length", "distance", "power"]


def planned(run, *arguments: object) -> dict[str, Any]:
    """What `--json` tells, which knows neither NaN nor Infinity."""
    ran = run("plan", *arguments, "--json")
    # What takes seconds says how long it took.
    assert ran.code == 0 and all(line.startswith("planning: ") for line in ran.err.splitlines())

    def refuse(text: str) -> None:
        raise AssertionError(text)

    return json.loads(ran.out, parse_constant=refuse)


@pytest.mark.parametrize("scene", THIN)
def test_bundled_scenes_as_text(run, scene: str) -> None:
    ran = run("plan", scene, *SMALL)
    assert (ran.code, ran.err) == (0, "")
    lines = ran.out.splitlines()
    assert max(map(len, lines)) <= 100 and len(lines) <= 48
    assert [line.split()[0] for line in lines if not line.startswith(" ")] == [
        "Bench",
        "Link",
        "Sampling",
        "Cramér-Rao",
        "Gaze",
        "Eye",
        "An",
    ]
    assert lines[-1] == NOT_A_CERTIFICATE
    assert [line.split()[0] for line in lines if line.split()[0] in NAMES] == NAMES
    known = load_scene(scene)
    assert known.illumination.mode in ran.out and f"{link_budget(known).electrons:.4g} electrons" in ran.out


@pytest.mark.parametrize("scene", THIN)
def test_bundled_scenes_as_json(run, scene: str) -> None:
    told = planned(run, scene, *SMALL)
    assert list(told) == KEYS and told["scene"] == scene
    known = load_scene(scene, SMALL[1::2])
    assert told["link_budget"] == [json.loads(json.dumps(link_budget(known).as_dict()))]
    # The sampling's, and that of rings that the probe's aperture cuts off.
    assert 0.02 < told["sampling"]["expected_error"] < 0.03 and told["sampling"]["propagation"].startswith("far field")
    assert told["limit"]["parameters"] == NAMES
    assert list(told["limit"]["bounds"]) == list(told["limit"]["alone"]) == list(told["limit"]["units"]) == NAMES
    found = fisher(known, NAMES)
    assert told["limit"]["information"] == found.information.tolist() and told["limit"]["units"] == found.units
    # No image of parallel light depends on the distance.
    assert (told["limit"]["bounds"]["distance"] is None) == (scene == "thin-lens")
    assert told["eye_safety"]["computed"] is True and told["eye_safety"]["notice"] == NOT_A_CERTIFICATE


@pytest.mark.slow
def test_a_real_lens_is_planned_by_what_its_rays_tell(run) -> None:
    asked = ("rotation", "--set", "probe.sensor.pixels=[40, 32]", *ROUGH, *PLAIN)
    told = planned(run, *asked)
    assert told["geometry"]["camera"] == "cmount-12mm-f1.4" and told["sampling"]["memory_bytes"] > 0
    # By real rays the field is not that of a thin lens.
    thin = 2 * math.degrees(math.atan(648 * 8.8e-6 / 2 / 3.8e-3))
    assert told["geometry"]["field_deg"][0] == pytest.approx(thin, rel=0.1)
    assert told["limit"]["parameters"] == ["gaze_x", "gaze_y", "power"]
    assert set(told["limit"]["left_out"]) == {"object_distance", "focal_length", "distance"}
    assert "ask for it by name" in told["limit"]["left_out"]["focal_length"]
    assert any("counted as a thin lens" in note for note in told["link_budget"][0]["notes"])
    ran = run("plan", *asked)
    assert ran.code == 0 and "left out: not differentiated through a traced lens" in ran.out
    refused = run("plan", *asked, "--target-parameters", "gaze_x,distance")
    assert refused.code == 2 and "distance: not differentiated through a traced lens" in refused.complaint


@pytest.mark.slow
def test_a_phone_is_planned_without_limits(run) -> None:
    asked = ("phones", "--set", "probe.sensor.pixels=[40, 32]", "--set", "target.name=phone-03", *ROUGH)
    told = planned(run, *asked)
    assert told["geometry"]["camera"].startswith("phone-03 (main: phone-b")
    assert told["limit"]["parameters"] == [] and set(told["limit"]["left_out"]) == set(NAMES)
    assert any("the camera 'main' alone is counted, of 2" in note for note in told["link_budget"][0]["notes"])
    assert all("not computed for a phone" in why for why in told["limit"]["left_out"].values())
    refused = run("plan", *asked, "--target-parameters", "gaze_x")
    assert refused.code == 2 and "take one of its cameras for the target" in refused.complaint


def test_more_light_tells_more(run) -> None:
    """Shot noise alone: four times the light, half of the spread; the power's own spread doubles."""
    quiet = (*SMALL, "--set", "read_noise=0", "--set", "bits=16", "--set", "rotation=0.5")
    names = ("--target-parameters", "gaze_y, power")
    dim = planned(run, "thin-lens", *quiet, *names, "--set", "power=1 mW")["limit"]
    bright = planned(run, "thin-lens", *quiet, *names, "--set", "power=4 mW")["limit"]
    assert dim["parameters"] == ["gaze_y", "power"]
    assert bright["bounds"]["gaze_y"] == pytest.approx(dim["bounds"]["gaze_y"] / 2, rel=1e-2)
    assert bright["bounds"]["power"] == pytest.approx(dim["bounds"]["power"] * 2, rel=1e-2)
    for name in dim["parameters"]:
        assert 0 < dim["alone"][name] <= dim["bounds"][name] < math.inf


def test_a_target_focused_at_infinity(run) -> None:
    told = planned(run, "thin-lens", *SMALL, "--set", "object_distance=inf")
    assert told["geometry"]["object_distance"] is None
    assert told["limit"]["parameters"] == [name for name in NAMES if name != "object_distance"]
    ran = run("plan", "thin-lens", *SMALL, "--set", "object_distance=inf", "--target-parameters", "object_distance")
    assert ran.code == 2 and "leave object_distance out" in ran.complaint


def test_changes_show(run) -> None:
    told = planned(run, "thin-lens", *SMALL, "--set", "wavelength=532 nm", "--set", "rotation=0.5")
    assert told["geometry"]["wavelengths"] == [5.32e-7]
    assert told["geometry"]["rotation_deg"] == [0, pytest.approx(0.5)]
    assert told["eye_safety"]["beam"]["wavelength"] == 5.32e-7


def test_several_wavelengths_are_planned_without_eye_safety(run) -> None:
    told = planned(run, "thin-lens", *SMALL, *TWO)
    assert [one["wavelength"] for one in told["link_budget"]] == [6.4e-7, 5.32e-7]
    assert told["eye_safety"]["computed"] is False and told["eye_safety"]["laser_class"] is None
    assert told["eye_safety"]["reason"].startswith("illumination.lines: 2 wavelengths at once")
    ran = run("plan", "thin-lens", *SMALL, *TWO)
    assert ran.code == 0 and ran.err == ""
    assert "not computed      illumination.lines: 2 wavelengths" in ran.out
    assert ran.out.splitlines()[-1] == NOT_A_CERTIFICATE


@pytest.mark.parametrize("form", [[], ["--json"]])
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["thin-lense"], "no such scene; give the path of a YAML file"),
        (["thin-lens", "--set", "distance=-1"], "distance"),
        (["thin-lens", "--set", "distanc=1"], "did you mean"),
        (["thin-lens", "--set", "object_distance=0.05"], "not beyond the focal length"),
        (["thin-lens", "--set", "sampling.accuracy=1e-9"], "finer than the engine's"),
        (["thin-lens", "--target-parameters", "gaze_x,,power"], "--target-parameters: 'gaze_x,,power' has an empty"),
        (["thin-lens", *SMALL, "--target-parameters", "power,power"], "twice"),
        (["thin-lens", *SMALL, "--target-parameters", "colour"], "unknown parameter 'colour'"),
        (
            ["thin-lens", "--set", "target.lens.aperture_radius=30mm", "--set", "object_distance=0.3"],
            "GiB; stop the target's aperture down",
        ),
    ],
)
def test_what_cannot_be_planned(run, arguments: list[str], words: str, form: list[str]) -> None:
    ran = run("plan", *arguments, *form)
    assert ran.code == 2 and ran.out == ""
    assert ran.complaint.startswith("error: ") and words in ran.complaint
