"""From electrons to digital numbers: the statistics of frames, and the frames that a seed has always given."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tapetum.bench import Probe, ProbeSensor, ThinLens
from tapetum.errors import InputError
from tapetum.simulate import Image, expose
from tapetum.simulate.exposure import (
    count_moments,
    count_variance,
    digitise,
    expected_counts,
    gain_of,
    hot_currents,
)
from tapetum.simulate.radiometry import dark_electrons, electrons, photoelectrons, photon_energy

LENS = ThinLens(focal_length=0.2, aperture_radius=25e-3)
# A sensor that resolves single electrons: 16 bits, two numbers an electron.
FINE: dict[str, Any] = {"bits": 16, "gain": 2.0, "full_well": 30000.0, "offset": 100.0, "read_noise": 3.0}


def sensor(**changes: Any) -> ProbeSensor:
    return ProbeSensor(**{"pixels": (64, 48), **changes})


def flat(level: float, count: int = 200_000) -> torch.Tensor:
    return torch.full((count,), level)


def drawn(one: ProbeSensor, level: float, seed: int = 0) -> np.ndarray:
    return digitise(flat(level), one, np.random.default_rng(seed)).astype(float)


def present(mean: torch.Tensor, one: ProbeSensor, rng: np.random.Generator) -> np.ndarray:
    """The formula on which the bundled model was trained."""
    generator = torch.Generator().manual_seed(int(rng.integers(1 << 62)))
    light = mean.detach().to("cpu", torch.float32)
    counts = torch.poisson(light, generator=generator)
    if one.read_noise:
        counts += one.read_noise * torch.randn(counts.shape, generator=generator)
    top = 2**one.bits - 1
    numbers = counts.clamp_(max=one.full_well).mul_(top / one.full_well).add_(one.offset)
    return numbers.round_().clamp_(0, top).numpy().astype(np.uint8 if one.bits <= 8 else np.uint16)


@pytest.mark.parametrize(
    "one",
    [
        sensor(),
        sensor(bits=12, background=5.0, dark_current=2e4, offset=17.0, full_well=1234.5, read_noise=7.7),
        sensor(bits=10, read_noise=0.0),
        sensor(hot_pixels=0.3),
        sensor(hot_current=1e9, serial=7),
    ],
    ids=["custom", "all old fields", "no read noise", "hot pixels without current", "current without hot pixels"],
)
def test_old_seeds_give_the_old_frames(one: ProbeSensor) -> None:
    light = torch.rand(3, 48, 64, generator=torch.Generator().manual_seed(1)) * 1.3 * one.full_well
    for seed in (0, 5, 2**40):
        want, rng, other = present(light, one, old := np.random.default_rng(seed)), np.random.default_rng(seed), old
        got = digitise(light, one, rng)
        assert got.dtype == want.dtype and np.array_equal(got, want)
        # The stream of seeds goes on where it did.
        assert rng.integers(1 << 62) == other.integers(1 << 62)


def test_old_irradiance_gives_the_old_electrons() -> None:
    one = sensor(background=3.0, dark_current=1e4)
    light = torch.rand(4, 5, generator=torch.Generator().manual_seed(2))
    photon = 6.62607015e-34 * 299792458.0 / 640e-9
    gain = one.pitch**2 * one.exposure * one.quantum_efficiency / photon
    assert torch.equal(electrons(light, one, 640e-9), light * gain + (one.background + one.dark_current * one.exposure))
    image = Image(light[None] * 1e-2, one.pitch, {"wavelength": 640e-9})
    want = present(electrons(image.irradiance, one, 640e-9), one, np.random.default_rng(3))
    assert np.array_equal(expose(image, Probe(LENS, one), 3), want)


def test_photon_transfer_slope_is_the_gain(validated) -> None:
    """EMVA 1288: with shot noise alone the variance rises with the mean, by the gain."""
    one = sensor(**FINE)
    levels = np.array([200.0, 1000.0, 3000.0, 7000.0, 12000.0])
    frames = [drawn(one, level, seed) for seed, level in enumerate(levels)]
    means, variances = np.array([f.mean() for f in frames]), np.array([f.var() for f in frames])
    slope = np.polyfit(means, variances, 1, w=1 / variances)[0]
    what = "Photon transfer: variance over mean of digital numbers, gain of 2 an electron"
    validated("Radiometry", what, abs(slope / 2 - 1), 0.01, "the gain (EMVA 1288)", "of it")
    assert means == pytest.approx(2 * levels + 100, rel=1e-3)


def test_read_noise_and_offset_in_the_dark(validated) -> None:
    dark = drawn(sensor(**FINE), 0.0)
    want = math.sqrt((2 * 3) ** 2 + 1 / 12)
    error = abs(dark.std() / want - 1)
    validated("Radiometry", "Read noise of dark frames, 3 electrons, rounding included", error, 0.01, "σ_r", "of it")
    assert dark.mean() == pytest.approx(100, abs=0.05)


def test_dark_current_grows_with_the_exposure() -> None:
    one = sensor(**FINE, dark_current=4e4, background=1.5, exposure=2e-3)
    twice = sensor(**FINE, dark_current=4e4, background=1.5, exposure=4e-3)
    assert (dark_electrons(one), dark_electrons(twice)) == (pytest.approx(81.5), pytest.approx(161.5))
    nothing = Image(torch.zeros(40, 48, 64), one.pitch, {"wavelength": 640e-9})
    for with_it, want in ((one, 81.5), (twice, 161.5)):
        frames = expose(nothing, Probe(LENS, with_it), 1).astype(float)
        assert (frames.mean() - 100) / 2 == pytest.approx(want, rel=0.005)
        assert frames.var() / 4 == pytest.approx(want + 9, rel=0.02)


def test_a_full_well_holds_no_more() -> None:
    one = sensor(bits=12, gain=0.5, full_well=1000.0, offset=20.0)
    assert set(drawn(one, 5000.0)) == {520.0}
    # A gain that fills the digital range first.
    steep = sensor(bits=8, gain=1.0, full_well=1000.0)
    assert set(drawn(steep, 900.0)) == {255.0}
    # Left out, the gain makes the full well the largest number.
    assert gain_of(sensor(bits=12, full_well=1000.0)) == 4.095
    assert drawn(sensor(bits=12, full_well=1000.0), 5000.0).max() == 4095
    assert drawn(sensor(offset=300.0), 0.0).min() == 255


@pytest.mark.parametrize("bits", range(1, 17))
def test_bits(bits: int) -> None:
    one = sensor(bits=bits, full_well=1000.0, read_noise=20.0)
    ramp = torch.linspace(0, 1500, 20_000)
    numbers = digitise(ramp, one, np.random.default_rng(0))
    assert numbers.dtype == (np.uint8 if bits <= 8 else np.uint16)
    assert numbers.min() == 0 and numbers.max() == 2**bits - 1
    want = count_moments(ramp.double(), one)[0].numpy()
    slack = 0.5 + 6 * gain_of(one) * np.sqrt(ramp.numpy() + 400)
    assert np.all(np.abs(numbers - want) <= slack)


def hot(**changes: Any) -> ProbeSensor:
    return sensor(**{**FINE, "pixels": (320, 240), "hot_pixels": 0.01, "hot_current": 1e5, "exposure": 0.01, **changes})


def test_hot_pixels_are_a_share_with_exponential_currents(validated) -> None:
    currents = hot_currents(hot(pixels=(1000, 800)))
    count = int((currents > 0).sum())
    assert count == pytest.approx(8000, abs=4 * math.sqrt(8000))
    hot_ones = np.sort(currents[currents > 0].numpy()) / 1e5
    steps = (np.arange(count) + 0.5) / count
    distance = np.abs(1 - np.exp(-hot_ones) - steps).max()
    what = "Hot pixels' dark current: Kolmogorov's distance to its distribution, 8000 of them"
    validated("Radiometry", what, distance, 1.95 / math.sqrt(count), "exponential distribution (0.1 %)", "of 1")


def test_hot_pixels_stay_put_between_frames_and_seeds_and_move_with_the_serial() -> None:
    one, dark = hot(), torch.zeros(6, 240, 320)
    level = 100 + 2 * 50
    for seed in (1, 2):
        frames = digitise(dark, one, np.random.default_rng(seed))
        # Means of 1000 electrons a frame: far above 50 in 95 of 100 hot pixels, and nowhere else.
        bright = frames > level
        strong = (hot_currents(one) * one.exposure > 120).numpy()
        assert strong.sum() > 500
        assert bright[:, strong].all() and not bright[:, (hot_currents(one) == 0).numpy()].any()
        # The places are fixed, the shot noise is not.
        assert not np.array_equal(frames[0], frames[1])
        want = (hot_currents(one) * one.exposure).numpy()
        spread = (frames.astype(float) - 100) / 2 - want
        assert (spread[:, strong] ** 2 / (want[strong] + 9 + 1 / 48)).mean() == pytest.approx(1, abs=0.1)
    places, others = hot_currents(one) > 0, hot_currents(hot(serial=1)) > 0
    both = int((places & others).sum())
    assert both < 0.05 * int(places.sum())
    assert torch.equal(hot_currents(one), hot_currents(hot(gain=1.0, exposure=1.0)))


def test_a_larger_share_has_the_same_hot_pixels_and_more() -> None:
    few, many = hot_currents(hot()), hot_currents(hot(hot_pixels=0.05))
    assert torch.equal(many[few > 0], few[few > 0]) and int((many > 0).sum()) > 3 * int((few > 0).sum())
    assert int((hot_currents(hot(hot_pixels=1.0)) > 0).sum()) == 320 * 240
    # Nobody changes a sensor through what it was asked.
    hot_currents(hot()).zero_()
    assert torch.equal(hot_currents(hot()), few)


def test_hot_pixels_have_no_places_in_a_window() -> None:
    message = r"image: has shape \(10, 10\), which is no frame of 320 x 240 pixels.*; give whole frames"
    with pytest.raises(InputError, match=message):
        digitise(torch.zeros(10, 10), hot(), np.random.default_rng(0))
    with pytest.raises(InputError, match=message):
        expected_counts(torch.zeros(10, 10), hot(), 640e-9)
    digitise(torch.zeros(10, 10), hot(hot_current=0.0), np.random.default_rng(0))


def test_electrons_go_with_the_wavelength_and_add() -> None:
    one = sensor(background=4.0, exposure=1e-3)
    light = torch.full((2, 48, 64), 1e-4, dtype=torch.float64)
    red, infrared = (photoelectrons(light, one, w) for w in (640e-9, 785e-9))
    # As many more photons as each has less energy.
    assert float((infrared / red).mean()) == pytest.approx(785 / 640)
    assert float(red[0, 0, 0]) == pytest.approx(1e-4 * one.pitch**2 * 1e-3 * 0.5 / photon_energy(640e-9))
    both = red + infrared + dark_electrons(one)
    assert torch.allclose(electrons(light, one, 640e-9) + electrons(light, one, 785e-9) - 4.0, both)
    image = Image(light, one.pitch, {"wavelength": 785e-9})
    assert torch.equal(expected_counts(image, one), expected_counts(light, one, 785e-9))
    assert not torch.equal(expected_counts(image, one), expected_counts(image, one, 640e-9))
    assert torch.equal(count_variance(image, one), count_variance(light, one, 785e-9))


def test_light_of_no_known_wavelength_is_refused() -> None:
    image = Image(torch.zeros(1, 48, 64), 2.2e-6)
    for call in (
        lambda: expose(image, Probe(LENS, sensor()), 0),
        lambda: expected_counts(image, sensor()),
        lambda: count_variance(torch.zeros(3), sensor()),
    ):
        with pytest.raises(InputError, match="wavelength: is not known; give it in metres"):
            call()


@pytest.mark.parametrize("value", [math.nan, math.inf, -1e-3])
def test_light_that_is_none_is_refused(value: float) -> None:
    light = torch.full((1, 48, 64), 1e-4)
    light[0, 3, 5] = value
    image = Image(light, sensor().pitch, {"wavelength": 640e-9})
    for call in (
        lambda: expose(image, Probe(LENS, sensor(background=100.0)), 0),
        lambda: expected_counts(image, sensor()),
        lambda: count_variance(light, sensor(), 640e-9),
    ):
        with pytest.raises(InputError, match=f"image: holds {value:.3g} W/m².*give finite irradiances from 0"):
            call()


def test_rounding_below_zero_is_darkness() -> None:
    light = torch.full((1, 48, 64), 1e-4)
    light[0, 3, 5] = -1e-12
    image = Image(light, sensor().pitch, {"wavelength": 640e-9})
    assert expose(image, Probe(LENS, sensor(read_noise=0.0)), 0)[0, 3, 5] == 0


def test_pixels_of_another_pitch_are_refused() -> None:
    image = Image(torch.zeros(1, 48, 64), 5e-6, {"wavelength": 640e-9})
    for call in (
        lambda: expose(image, Probe(LENS, sensor(pitch=2.2e-6)), 0),
        lambda: expected_counts(image, sensor(pitch=2.2e-6)),
        lambda: count_variance(image, sensor(pitch=2.2e-6)),
    ):
        with pytest.raises(InputError, match=r"image: has pixels of 5 µm, the probe's sensor of 2\.2 µm"):
            call()


@pytest.mark.parametrize("level", [1e9, 1e12, 1e20, 1e30, math.inf])
def test_any_bright_light_saturates(level: float) -> None:
    for one in (sensor(), sensor(**FINE), sensor(full_well=1e9)):
        numbers = digitise(torch.full((1000,), 10 * level), one, np.random.default_rng(0))
        assert (numbers > 0.9 * min(2**one.bits - 1, gain_of(one) * one.full_well + one.offset)).all()
        mean, variance = count_moments(torch.tensor(10 * level, dtype=torch.float64), one)
        assert float(mean) == pytest.approx(min(2**one.bits - 1, gain_of(one) * one.full_well + one.offset))
        assert float(variance) == pytest.approx(1 / 12, abs=1e-3)


SENSORS = {
    "fine": FINE,
    "no read noise": {**FINE, "read_noise": 0.0, "offset": 0.0},
    "no offset": {**FINE, "offset": 0.0},
    "loud": {**FINE, "offset": 5.0, "read_noise": 20.0},
    "12 bits over a full well": {"bits": 12, "read_noise": 4.0, "offset": 2.0, "full_well": 4000.0},
    "clipped by its numbers": {"bits": 10, "gain": 1.5, "read_noise": 2.0, "offset": 30.0, "full_well": 4000.0},
}


def test_mean_and_variance_against_drawn_frames(validated) -> None:
    """Between darkness and saturation, clipped ends included."""
    worst_mean = worst_variance = 0.0
    for number, fields in enumerate(SENSORS.values()):
        one = sensor(**fields)
        top = min(one.full_well, (2**one.bits - 1 - one.offset) / gain_of(one))
        levels = [0.0, 0.5, 2.0, 10.0, 100.0, *(top + k * math.sqrt(top) for k in (-2, -1, 0, 1, 2, 8))]
        for i, level in enumerate(levels):
            frames = digitise(flat(level), one, np.random.default_rng([number, i])).astype(float)
            mean, variance = (float(x) for x in count_moments(torch.tensor(level).double(), one))
            deviation = math.sqrt(variance)
            worst_mean = max(worst_mean, abs(frames.mean() - mean) / deviation)
            whole = gain_of(one) ** 2 * max(level + one.read_noise**2, 1.0)
            worst_variance = max(worst_variance, abs(frames.var() - variance) / whole)
    against = "200 000 drawn pixels a level"
    what = f"Expected digital numbers from darkness to saturation, {len(SENSORS)} sensors"
    validated("Radiometry", what, worst_mean, 0.025, against, "of their noise")
    validated("Radiometry", what.replace("Expected", "Variance of"), worst_variance, 0.03, against, "of the unclipped")


def test_gradients_of_mean_and_variance() -> None:
    for fields in ({**FINE, "offset": 2.0}, {**FINE, "read_noise": 20.0}, {**FINE, "full_well": 300.0}):
        one = sensor(**fields)
        levels = torch.tensor([0.7, 5.0, 60.0, 290.0, 310.0], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda x, one=one: count_moments(x, one), (levels,), atol=1e-4)


def test_gradients_are_finite_at_no_light_and_fade_in_saturation() -> None:
    one = sensor(**{**FINE, "full_well": 1000.0, "read_noise": 0.0})
    light = torch.tensor([0.0, 500.0, 1000.0, 2000.0], dtype=torch.float64, requires_grad=True)
    mean, _ = count_moments(light, one)
    (slope,) = torch.autograd.grad(mean.sum(), light)
    assert slope[:2].tolist() == pytest.approx([2.0, 2.0])
    # At the full well one half of the frames are clipped: so is one half of the slope.
    assert float(slope[2]) == pytest.approx(1.0, abs=0.02)
    assert abs(float(slope[3])) < 1e-6
    variance = count_moments(light, one)[1]
    (slope,) = torch.autograd.grad(variance.sum(), light)
    assert bool(torch.isfinite(slope).all())


@settings(max_examples=60, deadline=None)
@given(
    bits=st.integers(1, 16),
    gain=st.one_of(st.none(), st.floats(0.01, 30)),
    offset=st.floats(0, 400),
    read_noise=st.floats(0, 50),
    full_well=st.floats(50, 1e5),
)
def test_moments_stay_in_their_bounds(
    bits: int, gain: float | None, offset: float, read_noise: float, full_well: float
) -> None:
    one = sensor(bits=bits, gain=gain, offset=offset, read_noise=read_noise, full_well=full_well)
    top = 2**bits - 1
    # A range of a few electrons is no normal distribution's.
    assume((top - offset) / gain_of(one) > 40)
    light = torch.cat([torch.zeros(1), torch.logspace(-3, 6, 200)]).double()
    mean, variance = count_moments(light, one)
    slack = 1e-9 * (top + gain_of(one) * 1e6)
    assert float(mean.min()) >= -slack and float(mean.max()) <= top + slack
    assert bool((mean.diff() >= -slack).all())
    assert bool(torch.isfinite(variance).all()) and float(variance.min()) >= 1 / 12
    # No variable between 0 and top scatters more than a coin; clipping only takes away.
    assert float(variance.max()) <= top**2 / 4 * (1 + 1e-6) + 1 / 12 + slack
    assert bool((variance <= gain_of(one) ** 2 * (light + read_noise**2) * (1 + 1e-9) + 1 / 12 + slack).all())


def test_types_and_shapes_are_kept() -> None:
    one = sensor()
    for dtype in (torch.float32, torch.float64):
        mean, variance = count_moments(torch.ones(2, 3, dtype=dtype), one)
        assert mean.dtype == variance.dtype == dtype and mean.shape == variance.shape == (2, 3)
