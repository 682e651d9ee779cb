from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tapetum.bench import Illumination, Layer, PixelArray, Probe, ProbeSensor, Scene, Target, TargetSensor, ThinLens
from tapetum.errors import InputError
from tapetum.simulate import retroreflect
from tapetum.simulate.budget import Reflection, link_budget
from tapetum.simulate.constellation import (
    Constellation,
    PlacedProbe,
    ProbeKit,
    Rail,
    Volume,
    coverage,
    design,
    evenness,
    irradiance,
    overlap_law,
    signal,
    single_probe,
)
from tapetum.simulate.radiometry import irradiance_at_target, photoelectrons

SENSOR = ProbeSensor(pixels=(2592, 1944), bits=12, exposure=1e-3, background=40)
PHONE = Target(ThinLens(4e-3, 1e-3), object_distance=15.0, sensor=TargetSensor(reflectance=0.1))
SECTION = "Several probes"


def probes(count: int, seed: int = 0) -> Constellation:
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(count, 3)) + np.array([0, 0, 4])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return Constellation(
        tuple(
            PlacedProbe(tuple(place), tuple(axis), angle, power)
            for place, axis, angle, power in zip(
                rng.uniform(-1, 1, (count, 3)).tolist(),
                axes.tolist(),
                rng.uniform(0.1, 1, count).tolist(),
                rng.uniform(0.1, 1, count).tolist(),
                strict=True,
            )
        ),
        SENSOR,
    )


def seen_by(sensor: ProbeSensor, target: Target, distance: float, divergence: float = 0.0087) -> Scene:
    light = Illumination("diverging", 640e-9, 1e-3, divergence)
    return Scene(distance=distance, target=target, probe=Probe(ThinLens(0.2, 0.025), sensor), illumination=light)


def kept(distance: float, aperture: float, angle: float = 0.0) -> Reflection:
    """A phone's return by the link budget: diffraction takes some of it from a probe's aperture at any distance."""
    target = replace(PHONE, rotation=(angle, 0.0))
    lens, light = ThinLens(0.2, aperture), Illumination("diverging", 640e-9, 1e-3, 0.5)
    scene = Scene(distance=distance, target=target, probe=Probe(lens, SENSOR), illumination=light)
    return link_budget(scene).reflections[0]


def dressed(sensor: TargetSensor) -> Target:
    return Target(ThinLens(4e-3, 1e-3), object_distance=15.0, sensor=sensor)


TARGETS = {
    "mirror": PHONE,
    "array": dressed(TargetSensor(0.2, array=PixelArray(fill=0.6, surround=0.3, bayer=(0.8, 1, 1, 0.5)))),
    "filter": dressed(TargetSensor(0.2, layers=(Layer(depth=3e-4, reflectance=0.5, transmittance=0.4),))),
}


@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.parametrize("gain", [None, 0.02])
def test_one_probe_is_the_link_budget_of_a_scene(name, gain, validated):
    sensor, target = replace(SENSOR, gain=gain), TARGETS[name]
    one = Constellation((PlacedProbe((0, 0, 0), (0, 0, 1), 0.0087, 1e-3, 0.2, 0.025),), sensor)
    worst = 0.0
    for distance in (1.2, 2.0, 5.5, 40.0):
        scene = seen_by(sensor, target, distance)
        budget, found = link_budget(scene), signal(one, target, [[0, 0, distance]])
        here = float(irradiance(one, [[0, 0, distance]])[0, 0])
        for got, want in (
            (here, irradiance_at_target(scene)),
            (found.electrons, budget.electrons),
            (found.pixels, budget.rr_pixels),
            (found.snr, budget.snr),
        ):
            worst = max(worst, abs(float(np.squeeze(got)) / want - 1))
        assert bool(found.saturated[0, 0]) == (budget.saturation > 1)
    what = f"one probe, a {name}, {'own gain' if gain else 'no gain'}, 1.2 to 40 m"
    validated(SECTION, what, worst, 1e-9, "the link budget of a scene", "of the value")


@pytest.mark.parametrize("name", ["mirror", "dimmed"])
@pytest.mark.parametrize("distance", [1.2, 5.5])
def test_its_electrons_are_those_of_a_simulated_picture(name, distance, validated):
    # A layer that only dims: what a reflecting one sends back itself is not the sensor's.
    dim = dressed(TargetSensor(0.2, layers=(Layer(depth=3e-4, reflectance=0.0, transmittance=0.4),)))
    target = {"mirror": PHONE, "dimmed": dim}[name]
    # Large enough for the outer rings, of 64 um each.
    sensor = replace(SENSOR, pixels=(200, 200), pitch=20e-6)
    one = Constellation((PlacedProbe((0, 0, 0), (0, 0, 1), 0.0087, 1e-3, 0.2, 0.025),), sensor)
    picture = retroreflect(seen_by(sensor, target, distance), [0.0], accuracy=3e-3)
    there = float(photoelectrons(picture.irradiance, sensor, 640e-9).sum())
    found = float(signal(one, target, [[0, 0, distance]]).electrons[0, 0])
    what = f"electrons of a return, {name}, {distance:g} m"
    validated(SECTION, what, abs(found / there - 1), 0.03, "a simulated picture", "of the value")


def test_many_links_are_interpolated():
    one = Constellation((PlacedProbe((0, 0, 0), (0, 0, 1), 0.5, 1e-3),), SENSOR)
    rng = np.random.default_rng(0)
    points = np.stack([*rng.uniform(-1, 1, (2, 300)), rng.uniform(5, 20, 300)], axis=1)
    facing = np.array([0.02, 0, -1.0]) / math.hypot(0.02, 1)
    many = signal(one, PHONE, points, facing)
    few = [signal(one, PHONE, points[i : i + 100], facing) for i in (0, 100, 200)]
    for name in ("electrons", "pixels"):
        own = np.concatenate([getattr(part, name) for part in few])
        bright = own[:, 0] > 0.2 * own.max() if name == "electrons" else own[:, 0] < 4 * own.min()
        np.testing.assert_allclose(getattr(many, name)[bright], own[bright], rtol=0.02)
    assert many.electrons.min() >= 0


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_a_plane_across_the_cone_gets_all_the_power(tilt, validated):
    one = Constellation((PlacedProbe((0.3, -0.2, 0), (0, 0, 1), 0.6, 0.7),), SENSOR)
    # A plane through (0, 0, 4), turned about x; midpoints of small cells.
    step = 0.01
    side = (np.arange(-300, 300) + 0.5) * step
    u, v = np.meshgrid(side, side)
    points = np.stack([u, v * math.cos(tilt), 4 + v * math.sin(tilt)], axis=-1).reshape(-1, 3)
    normal = np.array([0, math.sin(tilt), -math.cos(tilt)])
    total = float(irradiance(one, points, normal).sum()) * step**2
    validated(
        SECTION,
        f"power through a plane turned by {tilt:g} rad, summed over 1 cm cells",
        abs(total / 0.7 - 1),
        1e-3,
        "the probe's power",
        "of the power",
    )


def test_a_lattice_of_parallel_beams_lights_evenly_at_any_distance(validated):
    # n(d) = π d² tan²h/s² beams of P/(π d² tan²h) each: P/s².
    spacing, half = 0.1, 0.2
    grid = spacing * np.arange(-25, 26)
    lattice = Constellation(
        tuple(PlacedProbe((x, y, 0), (0, 0, 1), 2 * half, 0.01) for x in grid.tolist() for y in grid.tolist()), SENSOR
    )
    cell = (np.arange(10) + 0.5) / 10 * spacing
    worst = 0.0
    numbers = []
    for distance in (2.0, 4.0, 8.0):
        x, y = np.meshgrid(cell, cell)
        points = np.stack([x.ravel(), y.ravel(), np.full(x.size, distance)], axis=1)
        light = irradiance(lattice, points, [0, 0, -1]).sum(axis=1).mean()
        worst = max(worst, abs(light / (0.01 / spacing**2) - 1))
        numbers.append(coverage(lattice, points).sum(axis=1).mean() / distance**2)
    assert max(numbers) / min(numbers) < 1.02
    validated(
        SECTION,
        "illumination under parallel beams on a square lattice, n ∝ d², 2 to 8 m",
        worst,
        0.02,
        "power per cell, at any distance",
        "of the value",
    )


def test_overlap_law_is_what_constellations_of_that_many_beams_do(validated):
    worst = 0.0
    for d in (5.0, 10.0, 20.0):
        n = round((d / 5) ** 2)
        one = PlacedProbe((0, 0, 0), (0, 0, 1), 0.1, 1e-5, aperture_radius=0.05)
        there = signal(Constellation((one,) * n, SENSOR), PHONE, [[0, 0, d]])
        near = signal(Constellation((one,), SENSOR), PHONE, [[0, 0, 5.0]])
        # The law is that of returns which do not depend on the distance.
        first = float(near.electrons[0, 0]) * kept(d, 0.05).watts / kept(5.0, 0.05).watts * (d / 5) ** 2
        law = overlap_law(d, 5.0, first, float(there.noise[0, 0]))
        worst = max(worst, abs(float(there.combined[0]) / float(law.snr) - 1))
        worst = max(worst, abs(float(there.electrons.sum()) / first - float(law.signal)))
    validated(
        SECTION, "summed signal and combined SNR of d² beams, 5 to 20 m", worst, 1e-9, "closed form", "of the value"
    )


def test_what_can_be_constant_at_once():
    d = np.array([1.0, 2.0, 4.0])
    shot = overlap_law(d, 1.0, 1e4, 0.0)
    np.testing.assert_allclose(shot.illumination, 1)
    np.testing.assert_allclose(shot.snr, 100)
    read = overlap_law(d, 1.0, 1.0, 1e9)
    np.testing.assert_allclose(read.snr / read.snr[0], 1 / d, rtol=1e-6)
    many = overlap_law(d, 1.0, 1.0, 1e9, exponent=4)
    np.testing.assert_allclose(many.snr / many.snr[0], 1, rtol=1e-6)
    np.testing.assert_allclose(many.illumination, d**2)


def test_overlapping_cones_add_and_edges_are_sharp():
    two = Constellation(
        (PlacedProbe((0, 0, 0), (0, 0, 1), 0.2, 1.0), PlacedProbe((0.3, 0, 0), (0, 0, 1), 0.2, 2.0)), SENSOR
    )
    radius = 10 * math.tan(0.1)
    points = [[0.15, 0, 10], [-radius + 1e-6, 0, 10], [-radius - 1e-6, 0, 10], [0, 0, -10]]
    assert coverage(two, points).tolist() == [[True, True], [True, False], [False, False], [False, False]]
    assert coverage(two, points, margin=0.35)[1:3].all()
    assert not coverage(two, points, margin=-0.1)[1:].any()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.01, 100), st.floats(0.1, 10))
def test_invariances(seed: int, factor: float, zoom: float):
    some = probes(4, seed)
    points = np.random.default_rng(seed).uniform([-2, -2, 4], [2, 2, 9], (20, 3))
    before = irradiance(some, points)
    np.testing.assert_allclose(irradiance(some.scaled(factor), points), factor * before, rtol=1e-12)
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()

    def moved(probe: PlacedProbe) -> PlacedProbe:
        place = zoom * turn @ probe.position + 1
        return replace(probe, position=tuple(place.tolist()), direction=tuple((turn @ probe.direction).tolist()))

    there = replace(some, probes=tuple(moved(probe) for probe in some.probes))
    np.testing.assert_allclose(irradiance(there, zoom * points @ turn.T + 1) * zoom**2, before, rtol=1e-6)


def test_a_camera_that_looks_away_answers_as_two_shifted_pupils_share():
    one = Constellation((PlacedProbe((0, 0, 0), (0, 0, 1), 0.5, 1e-3),), SENSOR)
    angles = np.array([0.0, 0.1, 0.2, 0.26, 0.5])
    facing = np.stack([np.sin(angles), 0 * angles, -np.cos(angles)], axis=1)
    seen = signal(one, PHONE, np.tile([0, 0, 8.0], (5, 1)), facing).electrons[:, 0]
    z = 1 / (1 / 4e-3 - 1 / 15)
    x = np.linspace(-1, 1, 2001) * 1e-3
    X, Y = np.meshgrid(x, x)
    disc = X**2 + Y**2 < 1e-6
    for angle, value in zip(angles, seen, strict=True):
        other = (X - 2 * z * math.tan(angle)) ** 2 + Y**2 < 1e-6
        share = kept(8.0, 0.0125, angle).inside_probe / kept(8.0, 0.0125).inside_probe
        assert value / seen[0] == pytest.approx((disc & other).sum() / disc.sum() * math.cos(angle) * share, abs=2e-3)
    assert seen[-1] == 0


def test_the_design_beats_one_diverging_probe(validated):
    volume = Volume((-7, 0.9, 6), (7, 1.4, 24), rake=0.25)
    kit, rail = ProbeKit(SENSOR), Rail((-6, 7, 0), (6, 7, 0))
    found = design(volume, PHONE, kit, rail, cap=1e-4, probes=32, snr_weight=0.0)
    baseline = single_probe(volume, kit, (0, 7, 0), cap=1e-4)
    # Points that the design has not seen.
    points = volume.sample(4000, 99)
    ours = evenness(irradiance(found.constellation, points).sum(axis=1))
    theirs = evenness(irradiance(baseline, points).sum(axis=1))
    assert ours.high <= 1.02e-4 and theirs.high <= 1.02e-4
    assert 2 <= len(found.constellation.probes) <= 32
    places = np.sort([probe.position[0] for probe in found.constellation.probes])
    assert np.diff(places).min() > 0.0999 and places.min() >= -6 and places.max() <= 6
    validated(
        SECTION,
        "largest over smallest illumination of a theater's seats, designed",
        ours.ratio / theirs.ratio,
        0.7,
        "one diverging probe",
        "of its ratio",
    )


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: PlacedProbe((0, 0, 0), (0, 0, 2), 0.1, 1.0),
        lambda: PlacedProbe((0, 0, math.nan), (0, 0, 1), 0.1, 1.0),
        lambda: PlacedProbe((0, 0, 0), (0, 0, 1), math.inf, 1.0),
        lambda: PlacedProbe((0, 0, 0), (0, 0, 1), 0.1, -1.0),
        lambda: Constellation((), SENSOR),
        lambda: Volume((0, 0, 0), (1, -1, 1)),
        lambda: irradiance(probes(2), [[0, math.nan, 1]]),
        lambda: irradiance(probes(2), [[0.0, 1.0]]),
        lambda: irradiance(probes(2), [[0, 0, 5]], [0, 0, -2]),
        lambda: signal(probes(1), PHONE, [probes(1).probes[0].position]),
        lambda: overlap_law([0.5], 1.0, 1.0, 1.0),
        lambda: evenness([]),
        lambda: Rail((0, 0, 0), (0, 0, 0)),
        lambda: single_probe(Volume((-9, 0, 1), (9, 1, 2)), ProbeKit(SENSOR), (0, 0, 0), cap=1.0),
        lambda: design(
            Volume((-1, 0, 5), (1, 1, 9)), PHONE, ProbeKit(SENSOR), Rail((0, 3, 0), (1, 3, 0)), cap=1.0, probes=40
        ),
    ],
)
def test_refusals(wrong):
    with pytest.raises(InputError, match=r".+: .+; .+"):
        wrong()


def test_too_few_probes_for_the_volume_are_refused():
    with pytest.raises(InputError, match="dark"):
        design(
            Volume((-7, 1, 6), (7, 1.5, 24)),
            PHONE,
            ProbeKit(SENSOR),
            Rail((-6, 7, 0), (6, 7, 0)),
            cap=1.0,
            probes=2,
            divergences=[0.1],
            samples=60,
        )
