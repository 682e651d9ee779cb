"""Light straight from a dot projector: energy, shape, which beam hits, and when."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import jn_zeros
from scipy.stats import ncx2

from tapetum.bench import load_scene, with_values
from tapetum.bench.phone import Dots, load_phone
from tapetum.optics.grid import Grid
from tapetum.record.returns import Flashes, flashes_of
from tapetum.simulate.dots import (
    beam_directions,
    beam_offsets,
    dot_image,
    dot_window,
    lit_time,
    waist_at,
)

SECTION = "LiDAR dots"
WAVELENGTH, FOCAL = 940e-9, 0.1
WIDE = math.radians(0.5)


def power_through(power: float, waist: float, offset: np.ndarray, radius: float) -> float:
    """Power of a Gaussian beam (waist to 1/e²) that passes a round aperture beside its middle: a noncentral χ² of two
    degrees of freedom, in units of (waist/2)²."""
    sigma = waist / 2
    away = float((offset**2).sum()) / sigma**2
    # SciPy has no noncentral distribution about the centre.
    central = 1 - math.exp(-(radius**2) / (2 * sigma**2))
    return power * (float(ncx2.cdf(radius**2 / sigma**2, 2, away)) if away > 1e-12 else central)


def dots(**changes: object) -> Dots:
    given = {
        "position": (0.0, 0.0),
        "power": 1.5,
        "period": 1 / 60,
        "pulse": 1e-3,
        "columns": 24,
        "rows": 24,
        "field": (math.radians(60), math.radians(48)),
    }
    return Dots(**{**given, **changes})  # type: ignore[arg-type]


def image(output: Grid, offset: tuple[float, float] = (0.0, 0.0), *, distance: float, radius: float) -> np.ndarray:
    light = dot_image(
        output,
        np.array([offset]),
        power=1e-3,
        divergence=WIDE,
        wavelength=WAVELENGTH,
        distance=distance,
        radius=radius,
        focal_length=FOCAL,
    )
    return light.numpy()


@pytest.mark.parametrize("offset", [(0.0, 0.0), (3e-3, -2e-3), (0.02, 0.01)])
def test_the_image_holds_what_passes_the_aperture(offset: tuple[float, float], validated) -> None:
    radius, distance = 5e-3, 5.5
    found = image(Grid(701, 701, 2.2e-6), offset, distance=distance, radius=radius).sum() * 2.2e-6**2
    expected = float(power_through(1e-3, waist_at(distance, WIDE), np.array(offset), radius))
    what = f"power on the sensor, beam {1e3 * math.hypot(*offset):.1f} mm off the aperture's middle"
    # Beyond the pixels lies the light of rings 82 and more: 2/(π² n) of it.
    validated(SECTION, what, abs(found / expected - 1), 8e-3, "noncentral χ² of a Gaussian through a disc", "of it")


def test_power_through_is_the_integral() -> None:
    x = (np.arange(1200) - 599.5) * 1e-5
    inside = x[:, None] ** 2 + x[None, :] ** 2 < 5e-3**2
    waist = 0.01
    for offset in ((0.0, 0.0), (4e-3, 0.0), (9e-3, 9e-3)):
        beam = np.exp(-2 * ((x[None, :] - offset[0]) ** 2 + (x[:, None] - offset[1]) ** 2) / waist**2)
        expected = 2 / (math.pi * waist**2) * (beam * inside).sum() * 1e-10
        assert float(power_through(1.0, waist, np.array(offset), 5e-3)) == pytest.approx(expected, rel=1e-3)


def test_far_away_it_is_an_airy_pattern(validated) -> None:
    # A Fresnel number of 1e-3 or so, and a beam much wider than the aperture.
    radius = 1e-3
    pitch = 0.5e-6
    row = image(Grid(1, 401, pitch), distance=1e3, radius=radius)[0]
    half = row[200:]
    found = pitch * (1 + int(np.argmax((half[1:-1] < half[:-2]) & (half[1:-1] < half[2:]))))
    expected = jn_zeros(1, 1)[0] / math.pi * WAVELENGTH * FOCAL / (2 * radius)
    what = "radius of the first dark ring, projector 1 km away"
    validated(SECTION, what, abs(found / expected - 1), 0.01, "1.22 λ f_p/D_p", "of it")


def test_near_by_it_is_the_probes_aperture(validated) -> None:
    radius, distance, pitch = 12.5e-3, 1.0, 40e-6
    light = image(Grid(101, 101, pitch), distance=distance, radius=radius)
    # As a disc: mean squared radius of its inner 90 % of the light.
    x = (np.arange(101) - 50) * pitch
    around = np.hypot(x[:, None], x[None, :]).ravel()
    order = np.argsort(around)
    held = np.cumsum(light.ravel()[order])
    radius_seen = around[order][np.searchsorted(held, 0.5 * held[-1])]
    waist = waist_at(distance, WIDE)
    # Half of the light that passes, under a Gaussian beam narrower than the aperture.
    through = 1 - math.exp(-2 * radius**2 / waist**2)
    expected = FOCAL / distance * waist * math.sqrt(-math.log(1 - through / 2) / 2)
    what = "radius with half of the light, projector 1 m away"
    validated(
        SECTION, what, abs(radius_seen / expected - 1), 0.05, "rays: the beam in the aperture, times f_p/d", "of it"
    )


def test_light_from_the_right_of_the_aperture_falls_to_the_left() -> None:
    window = dot_window(5.5, 5e-3, FOCAL, WAVELENGTH, 2.2e-6)
    light = image(window, (0.03, 0.0), distance=5.5, radius=5e-3)
    x = np.arange(window.columns) - (window.columns - 1) / 2
    assert (light.sum(0) * x).sum() < -0.05 * light.sum() * window.columns / 8
    np.testing.assert_allclose(light, light[::-1], atol=1e-9 * light.max())


def test_the_grid_spans_its_field_and_turns() -> None:
    straight, turned = dots(), dots(tilt=math.radians(8))
    along = beam_directions(straight)
    angle = np.degrees(np.arctan(along[:, :2] / along[:, 2:]))
    assert along.shape == (576, 3)
    np.testing.assert_allclose(angle.max(0), (30, 24))
    np.testing.assert_allclose(angle.min(0), (-30, -24))
    other = beam_directions(turned)
    turn = np.arctan2(other[:, 1], other[:, 0]) - np.arctan2(along[:, 1], along[:, 0])
    np.testing.assert_allclose(np.degrees((turn + math.pi) % (2 * math.pi) - math.pi), 8, atol=1e-9)


def test_a_beam_hits_when_the_phone_is_turned_by_its_angle() -> None:
    """The probe right of the middle of the phone's picture is on the left of the plate as the probe sees it."""
    along = beam_directions(dots(tilt=math.radians(8)))
    for number in (0, 100, 301, 575):
        x, y, _ = along[number]
        passed = beam_offsets(along, np.array([[-x, y]]), np.array([5.5]))[0]
        assert math.hypot(*passed[number]) < 1e-9
        assert np.hypot(passed[:, 0], passed[:, 1]).argmin() == number
    # Between two beams neither is nearer than half of their distance.
    one = dots(columns=1, rows=1)
    passed = beam_offsets(beam_directions(one), np.array([[math.sin(0.01), 0.0]]), np.array([5.5]))
    np.testing.assert_allclose(passed[0, 0], (5.5 * math.tan(0.01), 0.0), atol=1e-12)
    assert np.isinf(beam_offsets(np.array([[0.0, 0.0, -1.0]]), np.zeros((1, 2)), np.ones(1))).all()


def test_exposures_meet_pulses_as_their_lengths_say(validated) -> None:
    one = dots()
    times = np.linspace(0, 50 * one.period, 40001)[:-1]
    for exposure in (1e-4, 2e-3, 16e-3, 30e-3):
        seconds = lit_time(one, times, np.full(len(times), exposure), 0.004)
        mean = abs(seconds.mean() / (exposure * one.pulse / one.period) - 1)
        share = (seconds > 0).mean()
        expected = min(1.0, (exposure + one.pulse) / one.period)
        what = f"exposures of {1e3 * exposure:g} ms: pulsed light, and share of exposures with some"
        validated(
            SECTION, what, max(mean, abs(share - expected)), 2e-3, "pulse/period, (exposure + pulse)/period", "of it"
        )
    assert lit_time(one, np.array([0.0105]), np.array([2e-3]), 0.004)[0] == 0
    assert lit_time(one, np.array([0.0045]), np.array([1e-4]), 0.004)[0] == pytest.approx(1e-4)


def test_frames_hold_the_flashes_whichever_are_made() -> None:
    """In the virtual bench patches belong to a frame alone, and only an open camera app has them."""
    phone = with_values(load_scene("phones"), {"target.name": "phone-10"})
    # One beam of the middle comes by as the phone turns.
    count = 12
    x, y, _ = beam_directions(load_phone("phone-10").dots)[12 * 24 + 12]
    tilts = np.stack([-x + np.linspace(-0.02, 0.02, count), np.full(count, y)], -1)
    held = (np.full(count, 1e-3), tilts, np.zeros((count, 2)), np.linspace(0, 0.05, count), np.full(count, 5.5))
    made = Flashes(phone, *held)
    patches = [made.patch(i) for i in range(count)]
    seen = [i for i, patch in enumerate(patches) if patch is not None]
    assert 0 < len(seen) < count
    for i in reversed(seen):
        first, again = patches[i], Flashes(phone, *(one[i : i + 1] for one in held)).patch(0)
        assert first is not None and again is not None and again[:2] == first[:2]
        assert np.array_equal(again.light, first.light) and first.light.min() >= 0
        # At the projector's place against the main camera times f_p/d, turned with the hand; the tilt shortens it.
        middle = np.array(first[:2]) + (first.light.shape[0] - 1) / 2 - (phone.probe.sensor.pixels[0] - 1) / 2
        c, s = math.cos(held[3][i]), math.sin(held[3][i])
        place = np.array([c * -16.4e-3 - s * -1.2e-3, s * -16.4e-3 + c * -1.2e-3])
        np.testing.assert_allclose(middle, place * 0.1 / 5.5 / 2.2e-6, atol=2)
    assert Flashes(phone, 0 * held[0], *held[1:]).patch(seen[0]) is None
    shut = with_values(phone, {"target.imaging": False})
    bare = with_values(phone, {"target.name": "phone-01"})
    nothing = (np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1), np.ones(1))
    for other in (shut, bare, load_scene("thin-lens")):
        assert flashes_of(other, np.zeros(1), np.ones(1), 0.3, nothing) is None
