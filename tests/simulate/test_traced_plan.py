"""The traced planner's claims: the error it states, what it refuses, and that it says so in one line."""

from __future__ import annotations

import math
import random
import re
from dataclasses import replace
from typing import Any

import pytest
import torch
from traced_cases import MIRROR, PROBE_FOCAL, WAVELENGTH, Case, bare, finer, picture, planned, traced

from tapetum.bench import load_scene, with_values
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.simulate import Camera, retroreflect, traced_light, traced_plan
from tapetum.simulate.probe_path import ProbeAperture
from tapetum.simulate.surfaces import Order, Surface
from tapetum.simulate.traced_pass import TracedGrids, TracedPass

SECTION = "Traced lenses"
# Lenses, the widest field asked of each in degrees, and the range of focal lengths or F-numbers.
LENSES: list[tuple[str, float, dict[str, tuple[float, float]]]] = [
    ("phone-a", 5.0, {}),
    ("phone-b", 5.0, {}),
    ("phone-d", 5.0, {}),
    ("phone-e", 5.0, {"f_number": (3.2, 6.0)}),
    ("compact-6mm-f1.9", 8.0, {"f_number": (2.8, 8.0)}),
    ("cmount-12mm-f1.4", 12.0, {"focal_length": (3.6e-3, 5e-3)}),
    ("zoom-5-15mm", 5.0, {"focal_length": (5.2e-3, 9e-3)}),
    ("la1509", 1.0, {"f_number": (25.0, 50.0)}),
]


@pytest.mark.parametrize(
    ("case", "radius", "accuracy", "step", "allowed"),
    [
        # Once damped by 0.007 of the peak, which no comparison of two efforts saw.
        (Case("zoom-18-140mm", 1.06, 3.0, 0.135, curvature=1 / 5.5), 12.5e-3, 0.02, 7, 0.004),
        # Most rays miss the aperture. Once off by 0.15 of the peak: the rim's light turned by 5 rad a sample.
        (Case("compact-6mm-f1.9", 3.0, 0.2, curvature=1 / 5.5), 5e-3, 0.03, 4, 0.01),
    ],
    ids=str,
)
def test_samples_on_the_way_out_hold_the_light_of_the_rim(
    case: Case, radius: float, accuracy: float, step: int, allowed: float, validated: Any
) -> None:
    """What comes out on axis far out of focus is the light of the rim, whatever the lens."""
    output = Grid(200, 200, 8.8e-6)
    window = math.hypot(output.width, output.height) / 2 / PROBE_FOCAL
    reach = traced(case)[1].aperture[1]
    aperture = ProbeAperture.behind_traced(5.5, radius, WAVELENGTH, window, reach=reach, accuracy=accuracy)
    scene = traced_light.traced_scene(
        *traced(case), output, wavelength=WAVELENGTH, probe_focal_length=PROBE_FOCAL, curvature=1 / 5.5,
        aperture=aperture,
    )  # fmt: skip
    one = traced_plan._made(scene, traced_light.followed(scene, accuracy), MIRROR, traced_plan._LADDER[step])
    more = replace(one.grids, leaving=2 * one.grids.leaving)
    better = TracedPass(one.fits, more, one.surface, one.path, wavelength=WAVELENGTH, accepted=one.accepted)
    tilts = case.steepest * torch.tensor([[0.0, 0.0], [0.08, 0.1], [0.1, 0.125]], dtype=torch.float64)
    ours, want = one(tilts), better(tilts)
    error = float(((ours - want).abs().amax((1, 2)) / want.amax((1, 2))).max())
    validated(SECTION, f"twice the samples on the way out, {case}", error, allowed, "itself")


@pytest.mark.parametrize("changes", [{"sampling.accuracy": 1e-300}, {"probe.lens.aperture_radius": 0.08}])
def test_an_aperture_of_too_many_samples_is_refused(changes: dict[str, float]) -> None:
    """Samples that follow the accuracy once overflowed, and wide apertures took minutes and gigabytes."""
    one = load_scene("focusing")
    with pytest.raises(InputError, match=r"samples there, .* GiB, above .*; stop it down to .* mm, ask for less"):
        retroreflect(with_values(one, {**changes, "sampling.propagation": "finite"}))


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (-4.5e-3, -2.4e-3)])
def test_of_a_spot_only_what_reaches_the_picture_is_sampled(tilt: tuple[float, float]) -> None:
    case, output = Case("phone-c", 5.0, 5.5, 7.5e-3), Grid(31, 31, 4e-6)
    aperture = ProbeAperture.behind_traced(5.5, 5e-3, WAVELENGTH, 1e-3, reach=1e-3, accuracy=0.03)
    filter_ = Surface(0.0, (Order((2 * tilt[0], 2 * tilt[1])),), depth=0.72e-3, index=1.11, tilt=tilt)
    one = planned(case, output, 0.03, filter_, aperture=aperture, rim_light=False).passes[0]
    blur = abs(one.fits.defocus) * one.fits.aperture[0]
    assert one.fits.part is not None and one.grids.half_width < blur
    # All of the spot, about its own middle.
    whole = 1.5 * blur
    grids = TracedGrids(320, 560, whole, 0.9 * whole, 900, 160)
    ours, all_of_it = (
        bare(fits, of, output, one.surface, one.accepted)
        for fits, of in ((one.fits, one.grids), (replace(one.fits, part=None), grids))
    )
    sines = torch.tensor([[0.0, 0.0], [0.05, 0.02], [-0.03, 0.07]], dtype=torch.float64)
    wanted = all_of_it.field(sines)
    apart = (ours.field(sines) - wanted).abs().amax((1, 2)) / wanted.abs().amax((1, 2))
    assert float(apart.max()) < 0.01


def drawn(seed: int) -> tuple[Case, float, tuple[float, float]]:
    """A lens, its focus and an accuracy; and a tilt within its field or, every second time, at its end, as sines."""
    draw = random.Random(seed)
    name, degrees, ranges = draw.choice(LENSES)
    values = {key: draw.uniform(*limits) for key, limits in ranges.items()}
    far = draw.choice([math.inf, math.inf, 5.0, 2.0])
    angle, azimuth = draw.uniform(0, degrees * 0.9), draw.uniform(0, 2 * math.pi)
    size = math.sin(math.radians(angle))
    case = Case(name, angle if seed % 2 else degrees, far, values.get("focal_length"), values.get("f_number"))
    return case, draw.choice([3e-2, 1e-2]), (size * math.cos(azimuth), size * math.sin(azimuth))


def claimed(seed: int) -> float | None:
    """Measured over claimed error of a random scene, of its own peak; None where it is refused or nothing claimed."""
    case, accuracy, tilt = drawn(seed)
    traced.cache_clear()
    output = picture(case, 31)
    try:
        one = planned(case, output, accuracy)
    except InputError as refusal:
        assert "\n" not in str(refusal)
        return None
    if math.isinf(one.plan.expected_error):
        return None
    at = torch.tensor([tilt], dtype=torch.float64)
    ours, ratio = one.field(at)[0].to(torch.complex128).abs() ** 2, 0.0
    # What a window leaves out falls slowly and not evenly: twice the window may err by as much as what it judges. A
    # wide window's rim is sharp, and half as many samples again on the way out do not hold it.
    for window in (2.0, 6.0):
        better = finer(one.passes[0], output, 1.5, window=window, leaving=4.0).field(at)[0].abs() ** 2
        ratio = float((ours - better).abs().max()) / float(better.max()) / one.plan.expected_error
        if ratio < 0.5:
            break
    return ratio


def test_the_stated_error_holds(validated: Any) -> None:
    # Without 4 and 10: their lenses are drawn again, and come nearer to what is stated.
    ratios = [ratio for ratio in map(claimed, (0, 1, 2, 3, 5, 6, 7, 8, 9, 11)) if ratio is not None]
    assert len(ratios) >= 8
    validated(SECTION, "measured over stated error, 10 random lenses, gazes and focuses", max(ratios), 1.0,
              "a window two or six times as wide, and finer samples", "of the stated error")  # fmt: skip


def climb_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plans of one scene for few and for many pictures start from the same step: seek it for the first alone."""
    steps, climbed = [], traced_plan._climbed

    def once(*given: Any, **other: Any) -> Any:
        steps[:] = steps or [climbed(*given, **other)]
        return steps[0]

    monkeypatch.setattr(traced_plan, "_climbed", once)


@pytest.mark.parametrize(
    ("case", "accuracy"),
    [
        (Case("compact-6mm-f1.9", 8.0, f_number=7.32), 0.01),
        (Case("phone-e", 5.0, 2.0, f_number=4.22), 0.03),
        (Case("phone-d", 1.28, 2.0), 0.01),
    ],
    ids=str,
)
def test_the_stated_error_holds_at_every_tilt(
    case: Case, accuracy: float, validated: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors rise and fall with the tilt, and three tilts, compared with one finer sampling, once missed the worst."""
    output = picture(case, 31)
    sines = torch.linspace(0, 0.6 * case.steepest, 25, dtype=torch.float64)
    tilts = torch.stack([0.54 * sines, -0.84 * sines], -1)
    climb_once(monkeypatch)
    one, many = (planned(case, output, accuracy, pictures=pictures) for pictures in (1, 1000))
    # Another, six times as wide and of twice the samples on the way out, is within 0.04 of the stated error.
    better = finer(one.passes[0], output, 1.1, window=3.0, leaving=2.0).field(tilts).abs() ** 2
    ratio = 0.0
    for group in (one, many):
        ours = group.field(tilts).to(torch.complex128).abs() ** 2
        error = float(((ours - better).abs().amax((1, 2)) / better.amax((1, 2))).max())
        ratio = max(ratio, error / group.plan.expected_error)
    what = f"measured over stated error, worst of 25 tilts, {case}, {accuracy:g} of the peak"
    validated(SECTION, what, ratio, 1.0, "a window three times as wide", "of the stated error")


@pytest.mark.slow
def test_the_stated_error_holds_on_many(validated: Any) -> None:
    ratios = [ratio for ratio in map(claimed, range(1000, 1100)) if ratio is not None]
    assert len(ratios) >= 65
    validated(SECTION, "measured over stated error, 100 random lenses, gazes and focuses", max(ratios), 1.0,
              "a window two or six times as wide, and finer samples", "of the stated error")  # fmt: skip


def test_samples_that_change_no_picture_are_left_out_where_pictures_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    case, accuracy = Case("cmount-12mm-f1.4", 15.0, 5.0, 3.8e-3), 1e-2
    output = picture(case, 31)
    climb_once(monkeypatch)
    few = planned(case, output, accuracy, pictures=300)
    many = planned(case, output, accuracy, pictures=299)
    assert few.plan.columns < 0.8 * many.plan.columns and few.plan.sensor < many.plan.sensor
    sines = torch.linspace(0, math.sin(math.radians(14)), 12, dtype=torch.float64)
    tilts = torch.stack([0.28 * sines, -0.96 * sines], -1)
    ours, usual = (one.field(tilts).abs() ** 2 for one in (few, many))
    assert float(((ours - usual).abs().amax((1, 2)) / usual.amax((1, 2))).max()) < 0.3 * accuracy


@pytest.mark.parametrize("case", [Case("phone-a", 5.0), Case("phone-d", 5.0)], ids=str)
def test_samplings_compared_on_few_pixels_state_as_much_as_on_all(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    output = picture(case, 120)
    detail = WAVELENGTH * PROBE_FOCAL / (4 * traced(case)[1].aperture[1])
    looked_at = traced_light._compared(output, detail)
    # The middle, where the peak is, among them; an even number of pixels has none there.
    assert looked_at.rows % 2 == 1 and looked_at.rows * looked_at.columns < 0.4 * output.rows * output.columns
    assert 0.97 * output.width < looked_at.width < output.width + looked_at.pitch
    few = planned(case, output, 1e-2).plan.expected_error
    monkeypatch.setattr(traced_light, "_FEWER", math.inf)
    assert 0.9 < few / planned(case, output, 1e-2).plan.expected_error < 1.2


def test_a_bright_return_is_as_accurate_as_asked_and_a_faint_one_says_so() -> None:
    """Head on a mirror's return is at its most sensitive; where the return fades its error is of what is left."""
    bright = Case("phone-a", 5.0)
    output = picture(bright, 31)
    one = planned(bright, output, 1e-2)
    assert one.plan.expected_error <= 1e-2
    ours, better = (
        each.field(torch.zeros(1, 2).double())[0].to(torch.complex128).abs() ** 2
        for each in (one, finer(one.passes[0], output, 1.5))
    )
    assert float((ours - better).abs().max() / better.max()) <= one.plan.expected_error
    faint = Case("la1509", 0.65, f_number=39.0)
    assert 1e-2 < planned(faint, picture(faint, 31), 1e-2).plan.expected_error < math.inf
    assert math.isinf(planned(Case("la1509", 1.0, f_number=39.0), picture(faint, 31), 1e-2).plan.expected_error)


def test_far_defocus_is_refused_in_one_line() -> None:
    case = Case("photo-50mm-f1.8", 1.0, 0.6)
    with pytest.raises(InputError) as refused:
        planned(case, Grid(15, 15, 1e-4))
    assert "\n" not in str(refused.value) and "f_number" in str(refused.value)


def test_an_accuracy_out_of_reach_is_refused_with_one_within() -> None:
    case = Case("phone-d", 2.0)
    with pytest.raises(InputError, match="ask for") as refused:
        planned(case, picture(case, 21), 1e-7)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("f_number", [4.5, 7.3])
def test_an_accuracy_that_sampling_names_is_enough(f_number: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was twice the error at three tilts, rounded, and refused again where the other tilts' was more than that."""
    monkeypatch.setattr(traced_plan, "_LADDER", traced_plan._LADDER[:3])
    case = Case("compact-6mm-f1.9", 8.0, f_number=f_number)
    output = picture(case, 21)
    with pytest.raises(InputError, match="is not reached with") as refused:
        planned(case, output, 1e-3, pictures=1)
    (named,) = re.findall(r"ask for ([\d.e-]+) or more", str(refused.value))
    assert 0.9 * float(named) < planned(case, output, float(named), pictures=1).plan.expected_error < 1.1 * float(named)


def test_a_scene_is_rendered_with_its_claim() -> None:
    scene = with_values(
        load_scene("thin-lens"),
        {"target.lens": {"kind": "prescription", "name": "phone-d"}, "target.object_distance": math.inf,
         "sampling.accuracy": 1e-2, "sampling.propagation": "far field", "probe.sensor.pixels": [101, 101]},
    )  # fmt: skip
    images = retroreflect(scene, rotation=[0, 2])
    assert images.metadata["expected_error"] <= 1e-2
    irradiance = torch.as_tensor(images.irradiance)
    assert irradiance.shape[-2:] == (101, 101) and bool(torch.isfinite(irradiance).all())
    assert float(irradiance[0].max()) > float(irradiance[1].max()) > 0


def test_planning_takes_its_time_for_many_gazes_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    sought: list[Any] = []

    def kept(scene: Any, light: Any, surface: Any, found: Any, *others: Any) -> Any:
        sought.append(found)
        return found

    monkeypatch.setattr(traced_plan, "_thinned", kept)
    monkeypatch.setattr(traced_plan, "_PAYS_FROM", 3)
    lens = {"kind": "prescription", "name": "phone-d"}
    changes = {"target.lens": lens, "sampling.accuracy": 0.03, "probe.sensor.pixels": [21, 21]}
    scene = with_values(load_scene("thin-lens"), changes)
    retroreflect(scene, rotation=[0, 1])
    assert not sought
    retroreflect(scene, rotation=[0, 1, 2])
    assert len(sought) == 1


def test_where_finer_samples_are_too_many_the_error_is_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """The paths' error leaves little for sampling, whose finest step is beyond the limits: the best below serves."""
    case, accuracy = Case("phone-a", 5.0), 1e-2
    output, steps, climbed = picture(case, 31), [], traced_plan._climbed

    def kept(*given: Any, **other: Any) -> Any:
        steps.append(climbed(*given, **other))
        return steps[-1]

    monkeypatch.setattr(traced_plan, "_climbed", kept)
    usual = planned(case, output, accuracy, pictures=1).plan.expected_error
    finest = steps[0].finer.grids
    monkeypatch.setattr(traced_plan, "_MOST_PUPIL", max(finest.pupil, finest.leaving))
    monkeypatch.setattr(traced_plan, "_for_samples", lambda light, accuracy: 1e-6)
    assert 1e-6 < planned(case, output, accuracy, pictures=1).plan.expected_error <= usual


@pytest.mark.slow
def test_the_focusing_sets_longest_lens_is_not_refused() -> None:
    changes = {"target.lens.focal_length": "135 mm", "target.object_distance": "3 m"}
    camera = Camera(with_values(load_scene("focusing"), changes), math.sin(math.radians(1.0)))
    assert camera.plan.expected_error < 0.04
