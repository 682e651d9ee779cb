"""Planning a bench: every number is that of the module it comes from, and nothing that is not finite leaves."""

from __future__ import annotations

import functools
import json
import math
import re
from collections.abc import Sequence
from typing import Any

import pytest
import torch

from tapetum.bench import Scene, load_scene, scene_names, with_values
from tapetum.errors import InputError
from tapetum.simulate.budget import link_budget
from tapetum.simulate.eye_safety import NOT_A_CERTIFICATE, beam_of, eye_safety
from tapetum.simulate.information import FisherInformation
from tapetum.simulate.phone import open_camera
from tapetum.simulate.plan_parts import in_si
from tapetum.simulate.planning import PARAMETERS, Plan, plan_bench
from tapetum.simulate.retroreflect import plan_scene

TWO_LINES = [{"wavelength": "532 nm", "power": "2 mW"}, {"wavelength": "850 nm", "power": "3 mW"}]
# What a traced lens is planned with here: the same numbers are asked for several times, and none of them is judged.
ROUGH = {"sampling.accuracy": 0.3, "probe.sensor.pixels": [24, 20]}
# A zoom lens costs the most, at long focal lengths and over the distance above all.
SHORT = {"target.lens.focal_length": "20 mm", "target.lens.f_number": 16, "sampling.propagation": "far field"}
ROUGH_OF = {"focusing": {**ROUGH, **SHORT}, "phones": ROUGH, "rotation": ROUGH}


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits that a test can look for, in place of the derivatives of every pixel, which have tests of their own."""

    def fisher(scene: Scene, parameters: Sequence[str]) -> FisherInformation:
        assert scene.distance > 0
        # Alone 0.5e-3 each, but for the last, of which nothing is known; the first two hide each other by 0.8.
        information = torch.diag(torch.tensor([4e6] * (len(parameters) - 1) + [0.0], dtype=torch.float64))
        information[0, 1] = information[1, 0] = 0.8 * 4e6
        return FisherInformation(tuple(parameters), (1.0,) * len(parameters), information)

    monkeypatch.setattr("tapetum.simulate.planning.fisher", fisher)


def scene(name: str = "thin-lens", **changes: Any) -> Scene:
    return with_values(load_scene(name), {key.replace("__", "."): value for key, value in changes.items()})


def row(plan: Plan, label: str) -> str:
    """What the plan's text says beside a label; the lines of a long row as one."""
    lines = plan.lines()
    first = next(i for i, line in enumerate(lines) if line.startswith(f"  {label} "))
    rest = lines[first + 1 :]
    more = next((i for i, line in enumerate(rest) if line[:20].strip()), len(rest))
    return " ".join(line[20:].strip() for line in [lines[first], *rest[:more]])


pytestmark = pytest.mark.usefixtures("known")


@functools.cache
def turned(name: str) -> tuple[Scene, Plan]:
    """A scene a little turned, and its plan, which two tests read."""
    bench = with_values(scene(name, rotation=[0.1, 0.3]), ROUGH_OF.get(name, {}))
    return bench, plan_bench(bench)


@pytest.mark.parametrize("name", scene_names())
def test_every_number_is_its_module_s(name: str) -> None:
    bench, plan = turned(name)
    thin = bench.target.lens.kind == "thin"
    sine = math.hypot(math.sin(math.radians(0.1)), math.sin(math.radians(0.3)))
    camera = open_camera(bench, sine)
    assert plan.budgets == (link_budget(bench),)
    assert plan.sampling.plan == camera.plan.as_dict() == plan_scene(bench, sine).as_dict()
    assert plan.sampling.expected_error == camera.metadata()["expected_error"]
    assert plan.sampling.memory_bytes == camera.plan.bytes_needed(1, math.prod(bench.probe.sensor.pixels))
    assert plan.eye.found == eye_safety(beam_of(bench), (bench.distance,))
    told = () if plan.limit is None else plan.limit.parameters
    assert (*told, *plan.left_out) and set(told) | set(plan.left_out) == set(PARAMETERS)
    assert (told == PARAMETERS) == thin


def test_geometry_by_hand() -> None:
    told = plan_bench(scene(rotation=[0, 0.5])).geometry
    # 1/z = 1/0.1 - 1/5, N p = 648 · 8.8 µm.
    z = 1 / (10 - 0.2)
    assert told.image_distance == pytest.approx(z, rel=1e-12)
    assert told.f_number == pytest.approx(100 / 6)
    assert math.tan(math.radians(told.field_deg[0]) / 2) == pytest.approx(648 * 8.8e-6 / 2 / z)
    assert told.gaze == (0, pytest.approx(z * math.tan(math.radians(0.5)) / (486 * 8.8e-6)))
    assert told.rotation_deg == (0, pytest.approx(0.5))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "collimated, 1 mW at 640 nm, plane wave"),
        (
            {"illumination": {"mode": "diverging", "divergence": "0.5 deg"}},
            "diverging, 1 mW at 640 nm, wave diverging from a point 5 m away",
        ),
        ({"vergence": -0.5}, "collimated, 1 mW at 640 nm, wave converging to a point 2 m away"),
        ({"illumination.lines": TWO_LINES}, "collimated, 1 mW at 640 nm, 2 mW at 532 nm, 3 mW at 850 nm, plane wave"),
    ],
)
def test_the_wave_is_named(changes: dict[str, Any], words: str) -> None:
    assert row(plan_bench(scene(**changes)), "illumination") == words


def test_the_second_beam_and_infinity_are_named() -> None:
    plan = plan_bench(scene("hand-held", object_distance=math.inf))
    assert row(plan, "second beam") == "0.1 of the power, (0.9, 0.4) mrad aside"
    assert "focused at infinity" in row(plan, "target")
    assert plan.as_dict()["geometry"]["object_distance"] is None


def test_propagation_says_why() -> None:
    fits = plan_bench(scene())
    assert row(fits, "propagation").startswith(fits.sampling.propagation)
    width = in_si(2 * fits.sampling.return_radius_at_probe, "m")
    assert f"the return, {width} wide at the probe, fits its 50 mm aperture" in row(fits, "propagation")
    small = scene(probe__lens__aperture_radius=2e-3, diameter=0.05)
    assert "overfills its 4 mm aperture" in row(plan_bench(small), "propagation")
    asked = plan_bench(scene(propagation="far field"))
    assert row(asked, "propagation").endswith("; sampling.propagation asks for it")


def test_errors_that_nobody_claims() -> None:
    columns = plan_bench(scene()).sampling.plan["columns"]
    forced = plan_bench(scene(sampling__pupil=columns - 5))
    assert row(forced, "expected error") == "unknown: sampled by hand more coarsely than planned"
    assert forced.as_dict()["sampling"]["expected_error"] is None
    assert forced.as_dict()["sampling"]["plan"]["expected_error"] is None
    beyond = plan_bench(scene(rotation=2))
    assert row(beyond, "expected error") == "no light returns past the cut-off"
    assert row(beyond, "leaves the target") == "0 W (share 0)"
    # 1.6 deg still returns, 1.6 deg and the second beam's mrad do not.
    second = {"ratio": 0.1, "angle": [0, 3e-3]}
    # On a sensor that reaches so far out.
    wide = {"target__sensor__pixels": [4000, 4000]}
    partly = plan_bench(scene(rotation=1.6, illumination__second_beam=second, **wide))
    assert partly.budgets[0].sensor_watts > 0
    assert row(partly, "expected error") == "no claim: some of the light is past the cut-off"


def test_several_wavelengths() -> None:
    bench = scene(illumination__lines=TWO_LINES)
    plan = plan_bench(bench)
    assert plan.budgets == tuple(link_budget(bench, wavelength) for wavelength in (640e-9, 532e-9, 850e-9))
    assert f"{plan.budgets[1].electrons:.4g} electrons" in row(plan, "532 nm")
    assert f"{plan.budgets[2].snr:.4g} a frame" in row(plan, "850 nm")
    assert plan.eye.found is None
    refusal = row(plan, "not computed")
    assert "illumination.lines: 3 wavelengths" in refusal and "ask a laser safety officer" in refusal
    assert plan.lines()[-1] == NOT_A_CERTIFICATE


def test_what_is_summed_is_counted() -> None:
    layer = {"depth": "1 mm", "index": 1.5, "reflectance": 0.04}
    plan = plan_bench(scene(illumination__lines=TWO_LINES, layers=[layer], coherence_length=1e-4))
    assert plan.sampling.wavelengths == (640e-9, 532e-9, 850e-9)
    assert "summed over 3 wavelengths and 2 planes" in row(plan, str(plan.sampling.plan["method"]))
    assert row(plan, "layers.0").endswith("on the probe's sensor besides")


def test_eye_safety_outside_its_wavelengths() -> None:
    plan = plan_bench(scene(wavelength=1550e-9))
    assert plan.eye.refused is not None and "400" in plan.eye.refused
    told, usual = plan.as_dict()["eye_safety"], plan_bench(scene()).as_dict()["eye_safety"]
    assert told.keys() == usual.keys()
    assert (told["computed"], usual["computed"]) == (False, True)
    assert told["reason"] == plan.eye.refused and told["laser_class"] is None and told["at"] == []
    assert told["notice"] == usual["notice"] == NOT_A_CERTIFICATE


def test_light_that_hurts_says_so() -> None:
    plan = plan_bench(scene(power=0.2, diameter=0.005))
    assert plan.eye.found is not None and plan.eye.found.laser_class == "3B"
    assert row(plan, "class") == "3B by calculation: a danger to the eye in the direct beam"
    times = plan.eye.found.nearest.irradiance / plan.eye.found.nearest.mpe
    assert times > 100
    assert row(plan, "at 0.1 m").endswith(f"TOO MUCH for the limit (MPE) of 25.46 W/m², {times:.3g} times it")
    assert row(plan, "NOHD") == "naked eye no end, 50 mm telescope no end"
    told = plan.as_dict()["eye_safety"]
    assert told["nohd"] is None and [place["safe"] for place in told["at"]] == [False, False]


def test_limits_in_words_and_numbers() -> None:
    plan = plan_bench(scene(), ("gaze_x", "place_x", "distance", "power"))
    assert re.split(" {2,}", row(plan, "gaze_x")) == ["0.0008333 of the field", "0.0005 of the field"]
    assert row(plan, "place_x") == "833.3 µm on the probe's sensor  500 µm on the probe's sensor"
    assert row(plan, "distance").split() == ["500", "µm", "500", "µm"]
    assert row(plan, "power").split() == ["no", "information"] * 2
    assert "Cramér-Rao limit of one frame: standard deviation of the best unbiased estimate" in plan.lines()
    told = plan.as_dict()["limit"]
    assert told["parameters"] == ["gaze_x", "place_x", "distance", "power"]
    assert told["bounds"]["gaze_x"] == pytest.approx(0.5e-3 / 0.6) and told["bounds"]["power"] is None
    assert told["alone"] == {"gaze_x": 0.5e-3, "place_x": 0.5e-3, "distance": 0.5e-3, "power": None}
    assert told["information"][0] == [4e6, 3.2e6, 0, 0] and told["left_out"] == {}


def test_an_infinite_focus_has_no_limit() -> None:
    plan = plan_bench(scene(object_distance=math.inf))
    assert plan.limit.parameters == tuple(name for name in PARAMETERS if name != "object_distance")
    assert row(plan, "object_distance") == "left out: the target is focused at infinity"
    assert list(plan.as_dict()["limit"]["left_out"]) == ["object_distance"]


def test_a_scene_too_large_is_refused_before_anything_is_computed() -> None:
    large = scene(target__lens__aperture_radius=0.03, object_distance=0.3)
    with pytest.raises(InputError, match=r"samples over the pupil.*stop the target's aperture down"):
        plan_bench(large)


def test_a_parameter_that_is_refused_is_refused_before_a_lens_is_traced(monkeypatch: pytest.MonkeyPatch) -> None:
    def traced(*_: object) -> None:
        raise AssertionError("planned all the same")

    monkeypatch.setattr("tapetum.simulate.planning.open_camera", traced)
    with pytest.raises(InputError, match="take one of its cameras for the target"):
        plan_bench(scene("phones"), ["gaze_x"])


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        # Traced ones as they are planned above.
        *((name, None if name in ROUGH_OF else {}) for name in scene_names()),
        ("hand-held", {"illumination.lines": TWO_LINES, "object_distance": math.inf}),
        ("thin-lens", {"power": 5.0, "rotation": [1.7, -1.6], "source_size": 5e-4}),
        ("hand-held", {"offset": 300, "wavelength": 1e-6}),
    ],
)
def test_a_terminal_and_json_hold_it(name: str, changes: dict[str, Any] | None) -> None:
    plan = turned(name)[1] if changes is None else plan_bench(scene(name, **changes))
    lines = plan.lines()
    assert max(map(len, lines)) <= 100 and len(lines) <= 50
    assert lines[-1] == NOT_A_CERTIFICATE
    assert [line for line in lines if not line.startswith(" ")] == [
        "Bench",
        "Link budget",
        "Sampling",
        "Cramér-Rao limit of one frame: standard deviation of the best unbiased estimate, RR's place known",
        "Eye safety",
        NOT_A_CERTIFICATE,
    ]
    assert not re.search(r"\b(nan|None)\b", "\n".join(lines))
    # What JSON gives back is what was told: no tuples, no tensors, no infinities.
    told = plan.as_dict()
    assert json.loads(json.dumps(told, allow_nan=False)) == told


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.50929, "509.3 mW"),
        (0.0, "0 W"),
        (0.99999, "1 W"),
        (999.99e-6, "1 mW"),
        (-2.5e-7, "-250 nW"),
        (3068.0, "3.068 kW"),
        (4e-15, "4e-15 W"),
    ],
)
def test_numbers_take_a_prefix(value: float, words: str) -> None:
    assert in_si(value, "W") == words
