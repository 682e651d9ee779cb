"""The link budget against the simulation, closed forms and its own scaling laws."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tapetum.bench import Illumination, Layer, Microlens, PixelArray, Scene, TargetSensor, load_scene, with_values
from tapetum.errors import InputError
from tapetum.optics.glass import focal_length_at
from tapetum.simulate import retroreflect
from tapetum.simulate.budget import link_budget
from tapetum.simulate.camera import Camera
from tapetum.simulate.exposure import digitise, gain_of
from tapetum.simulate.radiometry import (
    beam_radius,
    electrons,
    encircled_energy,
    illumination_curvature,
    irradiance_at_target,
    layer_transmittance,
    photon_energy,
    return_radius_by_rays,
    share_in_disc,
    specular_reflectance,
)

WAVELENGTH = 640e-9
DIVERGING = {"mode": "diverging", "divergence": "0.5 deg"}
THIN = load_scene("thin-lens")
BASE = with_values(
    THIN,
    {"probe.sensor.pixels": [200, 200], "probe.sensor.pitch": 8e-6, "target.lens.aperture_radius": 1.5e-3},
)


def scene(**changes: Any) -> Scene:
    return with_values(BASE, {key.replace("__", "."): value for key, value in changes.items()}) if changes else BASE


CASES: dict[str, dict[str, Any]] = {
    "in focus": {"object_distance": math.inf},
    "in focus, turned by 0.5 deg": {"object_distance": math.inf, "rotation": [0, 0.5]},
    "focused at 5 m": {"object_distance": 5.0},
    "focused at 5 m, turned by 0.5 deg": {"object_distance": 5.0, "rotation": [0.3, 0.4]},
    "focused at 2.6 m": {"object_distance": 2.6},
    "focused at 5 m, diverging light": {"object_distance": 5.0, "illumination": DIVERGING},
    "focused at 2.6 m, diverging light": {"object_distance": 2.6, "illumination": DIVERGING},
}


def test_watts_and_peak_against_the_simulation(validated) -> None:
    """What is left is light that the sharp edge diffracts past the aperture on its way back."""
    watts: list[float] = []
    for changes in CASES.values():
        one = scene(**changes)
        told = link_budget(one)
        image = retroreflect(one).irradiance[0].double()
        watts.append(told.sensor_watts / (float(image.sum()) * one.probe.sensor.pitch**2))
        brightest = float(electrons(image, one.probe.sensor, WAVELENGTH).max())
        assert 0.5 < told.peak_electrons / brightest < 1.6
        assert told.electrons == pytest.approx(
            watts[-1] * float(electrons(image, one.probe.sensor, WAVELENGTH).sum()), rel=1e-3
        )
    error = max(abs(ratio - 1) for ratio in watts)
    what = f"Watts of the link budget on the probe's sensor, {len(CASES)} thin-lens scenes, r = 1.5 mm, f = 100 mm"
    validated("Radiometry", what, error, 0.08, "the wave simulation's sum over the image", "of it")


@pytest.mark.parametrize("degrees", [10.0, 20.0])
def test_watts_under_a_steep_tilt(degrees: float, validated) -> None:
    """A fast short lens, where sines are no tangents and the cosine counts."""
    one = scene(
        **{
            "target.lens": {"focal_length": 4e-3, "aperture_radius": 3.6e-3},
            "object_distance": math.inf,
            "rotation": [degrees, 0.0],
            "probe.sensor.pixels": [256, 256],
            "sampling.propagation": "far field",
        }
    )
    image = retroreflect(one).irradiance[0].double()
    # The budget counts what enters the probe's aperture; without one all of it does.
    told = link_budget(one).leaving_watts * one.probe.transmission
    ratio = told / (float(image.sum()) * one.probe.sensor.pitch**2)
    what = f"Watts that leave the target, f/0.56, f = 4 mm, {degrees:g}°"
    validated("Radiometry", what, abs(ratio - 1), 0.015, "the wave simulation's sum over the image", "of it")


def test_snr_against_drawn_frames() -> None:
    one = scene(
        **{
            "object_distance": math.inf,
            "illumination.power": 2e-4,
            "exposure": 1e-6,
            "bits": 12,
            "offset": 20.0,
            "background": 2.0,
            "read_noise": 3.0,
        }
    )
    told, sensor = link_budget(one), one.probe.sensor
    assert told.saturation < 0.5
    image = retroreflect(one).irradiance[0].double()
    y, x = np.indices(image.shape) - (np.array(image.shape) - 1)[:, None, None] / 2
    inside = np.hypot(x, y) <= math.sqrt(told.rr_pixels / math.pi)
    assert inside.sum() == pytest.approx(told.rr_pixels, rel=0.1)
    mean = electrons(image, sensor, WAVELENGTH)[torch.from_numpy(inside)]
    frames = digitise(mean.expand(2000, -1), sensor, np.random.default_rng(0)).astype(float)
    sums = (frames - sensor.offset).sum(1) / gain_of(sensor) - inside.sum() * told.dark_electrons
    # The Airy pattern's rings, 16 % of the light, lie outside of the first dark one.
    assert sums.mean() == pytest.approx(0.838 * told.electrons, rel=0.08)
    assert sums.std() == pytest.approx(told.noise_electrons, rel=0.1)


def test_rayleigh_range_of_a_wide_beam(validated) -> None:
    told = link_budget(scene(illumination={"diameter": "10 cm"}))
    assert told.rayleigh_range is not None
    error = abs(told.rayleigh_range - 12.27e3)
    validated("Radiometry", "Rayleigh range at 640 nm, 5 cm beam radius", error, 5.0, "π w²/λ = 12.27 km", "m")
    assert link_budget(scene(illumination=DIVERGING)).rayleigh_range is None


def test_every_step_of_the_chain() -> None:
    told = link_budget(scene(object_distance=math.inf))
    assert told.irradiance_at_target == pytest.approx(1e-3 / (math.pi * 0.025**2))
    assert told.field_of_view == pytest.approx(0.05) and told.field_angle == pytest.approx(0.01, rel=1e-4)
    assert told.accepted_watts == pytest.approx(1e-3 * (1.5 / 25) ** 2)
    assert told.reflected_watts == pytest.approx(0.1 * told.accepted_watts)
    assert told.leaving_watts == pytest.approx(told.reflected_watts)
    assert told.probe_watts == pytest.approx(
        told.leaving_watts * encircled_energy(0.025, 1.5e-3, WAVELENGTH, 5.0), rel=1e-3
    )
    assert told.sensor_watts == told.total_watts == pytest.approx(0.5 * told.probe_watts)
    assert told.photons == pytest.approx(told.sensor_watts * 1e-5 / photon_energy(WAVELENGTH))
    assert told.electrons == pytest.approx(0.5 * told.photons)
    assert told.rr_pixels == pytest.approx(math.pi * (1.22 * WAVELENGTH * 0.2 / 3e-3 / 8e-6) ** 2, rel=1e-6)
    assert told.snr == pytest.approx(told.electrons / told.noise_electrons)


def test_the_paper_s_divergence_lights_a_wider_field_farther_away() -> None:
    near, far = (link_budget(scene(distance=d, illumination=DIVERGING)) for d in (2.0, 8.0))
    assert near.field_angle == pytest.approx(math.radians(0.5)) == far.field_angle
    assert far.field_of_view == pytest.approx(4 * near.field_of_view)
    assert near.irradiance_at_target == pytest.approx(16 * far.irradiance_at_target)


def test_nothing_returns_past_the_cut_off() -> None:
    told = link_budget(scene(rotation=[0, 3.0]))
    assert told.sensor_watts == told.electrons == told.snr == told.peak_electrons == 0
    assert all(math.isfinite(x) for x in (told.noise_electrons, told.rr_pixels, told.reflections[0].radius_on_sensor))
    assert "share 0" in "\n".join(told.lines())


POSITIVE = st.floats(0.1, 10)


@settings(max_examples=30, deadline=None)
@given(power=POSITIVE, share=st.floats(0.01, 1), kept=st.floats(0.01, 1), time=POSITIVE, degrees=st.floats(0, 0.8))
def test_scaling_laws(power: float, share: float, kept: float, time: float, degrees: float) -> None:
    one = scene(rotation=[0, degrees])
    changes = {
        "illumination.power": 1e-3 * power,
        "target.sensor.reflectance": share,
        "probe.transmission": kept,
        "exposure": 1e-5 * time,
    }
    first, second = link_budget(one), link_budget(with_values(one, changes))
    watts = power * (share / 0.1) * (kept / 0.5)
    assert second.sensor_watts == pytest.approx(first.sensor_watts * watts, rel=1e-9)
    assert second.electrons == pytest.approx(first.electrons * watts * time, rel=1e-9)
    assert second.peak_electrons == pytest.approx(first.peak_electrons * watts * time, rel=1e-9)
    assert second.rr_pixels == pytest.approx(first.rr_pixels)
    # Where the light is shot noise, SNR grows with its root; never faster than with the light itself.
    gain = watts * time
    assert min(gain, math.sqrt(gain)) * (1 - 1e-9) <= second.snr / first.snr <= max(gain, math.sqrt(gain)) * (1 + 1e-9)


@settings(max_examples=30, deadline=None)
@given(
    st.floats(0, 0.85),
    st.floats(0, 0.85),
    st.floats(0, 2 * math.pi),
    st.sampled_from([math.inf, 5.0, 1.0]),
    st.sampled_from([{"mode": "collimated"}, DIVERGING]),
)
def test_turning_away_loses_light(a: float, b: float, way: float, focus: float, light: dict[str, Any]) -> None:
    small, large = (
        link_budget(scene(rotation=[x * math.cos(way), x * math.sin(way)], object_distance=focus, illumination=light))
        for x in sorted((a, b))
    )
    assert large.leaving_watts <= small.leaving_watts * (1 + 1e-9)
    for told in (small, large):
        chain = [told.laser_watts, told.accepted_watts, told.reflected_watts, told.leaving_watts, told.probe_watts]
        assert all(x >= y >= 0 for x, y in zip(chain, [*chain[1:], told.sensor_watts], strict=True))


@settings(max_examples=20, deadline=None)
@given(st.floats(1, 500), st.floats(1.05, 3), st.sampled_from([math.inf, 5.0]))
def test_farther_away_less_returns(distance: float, factor: float, focus: float) -> None:
    near, far = (
        link_budget(scene(distance=d, object_distance=focus, illumination=DIVERGING))
        for d in (distance, factor * distance)
    )
    assert far.accepted_watts == pytest.approx(near.accepted_watts / factor**2)
    assert far.sensor_watts < near.sensor_watts


def fresnel_share(disc: float, radius: float, spread: float, distance: float) -> float:
    """By one two-dimensional FFT of the aperture with its phase, on square pixels with antialiased edges."""
    count, width = 1024, 16 * radius
    fine = (np.arange(count) - count / 2 + 0.5) * width / count
    rho = np.hypot(fine[:, None], fine[None, :])
    amplitude = np.clip((radius - rho) * count / width + 0.5, 0, 1)
    phase = math.pi * rho**2 * spread / (radius * distance * WAVELENGTH)
    power = np.abs(np.fft.fftshift(np.fft.fft2(amplitude * np.exp(1j * phase)))) ** 2
    far = np.fft.fftshift(np.fft.fftfreq(count, width / count)) * WAVELENGTH * distance
    step = far[1] - far[0]
    inside = np.clip((disc - np.hypot(far[:, None], far[None, :])) / step + 0.5, 0, 1)
    return float((power * inside).sum() / power.sum())


def test_share_in_a_disc_against_a_two_dimensional_transform(validated) -> None:
    cases = [(5e-3, 1e-3, 4e-3, 20.0), (5e-3, 1e-3, 1e-3, 5.0), (3e-3, 2e-3, 6e-3, 8.0), (20e-3, 1e-3, 30e-3, 20.0)]
    error = max(abs(share_in_disc(*case[:3], WAVELENGTH, case[3]) - fresnel_share(*case)) for case in cases)
    what = "Share of a defocused return inside the probe's aperture, Fresnel numbers 0.2 to 3"
    validated("Radiometry", what, error, 5e-3, "two-dimensional FFT, 1024²", "of the light")


def test_share_in_a_disc_in_its_limits(validated) -> None:
    errors = [
        abs(share_in_disc(disc, 1e-3, 0.0, WAVELENGTH, d) - encircled_energy(disc, 1e-3, WAVELENGTH, d))
        for disc in (1e-4, 1e-3, 5e-3, 2e-2)
        for d in (0.5, 5.0, 100.0)
    ]
    what = "Share of a focused return inside the probe's aperture"
    validated("Radiometry", what, max(errors), 1e-10, "1 - J0² - J1² (Airy's encircled energy)", "of the light")
    # First dark ring: 83.8 %.
    assert encircled_energy(1.21967 * WAVELENGTH * 5 / 2e-3, 1e-3, WAVELENGTH, 5.0) == pytest.approx(0.8378, abs=1e-4)
    # On the axis a defocused round pupil has sinc² of half its Fresnel number.
    for spread in (1e-3, 5e-3, 1.2e-2):
        number = 1e-3 * spread / (WAVELENGTH * 5.0)
        axis = (math.pi * 1e-3**2 / (WAVELENGTH * 5.0)) ** 2 * np.sinc(number / 2) ** 2 / (math.pi * 1e-3**2)
        tiny = 1e-5
        assert share_in_disc(tiny, 1e-3, spread, WAVELENGTH, 5.0) == pytest.approx(math.pi * tiny**2 * axis, rel=1e-3)
    # Beams too wide and curved to integrate: the rays' areas.
    assert share_in_disc(25e-3, 12.7e-3, 0.1, WAVELENGTH, 5.0) == pytest.approx(1 / 16, rel=0.01)


@pytest.mark.parametrize("radians", [100.0, 200.0, 300.0])
def test_rays_take_over_from_the_integral_without_a_step(radians: float, monkeypatch: pytest.MonkeyPatch) -> None:
    case = (25e-3, 3e-3, radians / math.pi * WAVELENGTH * 5 / 3e-3, WAVELENGTH, 5.0)
    want = share_in_disc(*case)
    monkeypatch.setattr("tapetum.simulate.radiometry._MOST_RADIANS", 0.0)
    assert share_in_disc(*case) == pytest.approx(want, abs=0.03)


def matrices(*lengths: tuple[str, float]) -> np.ndarray:
    total = np.eye(2)
    for kind, value in lengths:
        step = np.array([[1, value], [0, 1]]) if kind == "free" else np.array([[1, 0], [-1 / value, 1]])
        total = step @ total
    return total


@given(st.floats(0.01, 0.2), st.floats(1.0, 1.2), st.one_of(st.just(0.0), st.floats(-5, 5)), st.floats(0.5, 50))
def test_return_radius_against_ray_matrices(focal: float, beyond: float, curvature: float, distance: float) -> None:
    radius, z = 2e-3, focal * beyond
    at_lens = matrices(("lens", focal), ("free", 2 * z))
    # The marginal ray that still passes the aperture on its way back.
    ray = np.array([radius, curvature * radius])
    ray /= max(1.0, abs((at_lens @ ray)[0]) / radius)
    want = abs((matrices(("lens", focal), ("free", distance)) @ at_lens @ ray)[0])
    assert return_radius_by_rays(radius, focal, z, curvature, distance) == pytest.approx(want, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("focus", [math.inf, 5.0, 1.0])
def test_return_radius_is_what_it_was(focus: float) -> None:
    one = scene(object_distance=focus, distance=20.0)
    curvature = 0.0 if math.isinf(focus) else 2 / (focus + 0.1)
    rays = 1.5e-3 * abs(1 - 20 * (curvature or 0.0))
    if math.isinf(focus):
        rays = 1.5e-3
    found = Camera(one, 0.0).metadata()["return_radius_at_probe"]
    assert found == pytest.approx(rays + 1.22 * WAVELENGTH * 20 / 3e-3)


def test_vergence_takes_the_mode_s_place() -> None:
    for light in ({"mode": "collimated"}, DIVERGING):
        assert illumination_curvature(scene(illumination={**light, "vergence": "-0.4 1/m"})) == -0.4
        assert illumination_curvature(scene(illumination={**light, "vergence": 0})) == 0
    assert illumination_curvature(scene()) == 0 and illumination_curvature(scene(illumination=DIVERGING)) == 0.2
    # Light as from the probe, whichever way it is said.
    same = link_budget(scene(illumination={"mode": "collimated", "vergence": 0.2}))
    fixed = link_budget(scene(illumination={"mode": "fixed_area", "diameter": "50 mm"}))
    assert same.sensor_watts == pytest.approx(fixed.sensor_watts)


@given(st.floats(-40, 40))
@settings(deadline=None, max_examples=60)
def test_no_vergence_breaks_the_budget(vergence: float) -> None:
    told = link_budget(scene(illumination={"vergence": vergence}))
    assert 0 <= told.sensor_watts <= told.accepted_watts * 0.05 * (1 + 1e-9)
    assert math.isfinite(told.snr) and told.rr_pixels >= 1


def test_light_that_crosses_over_in_the_lens_is_as_wide_as_diffraction() -> None:
    z = 1 / (1 / 0.1 - 1 / 5.0)
    told = link_budget(scene(illumination={"vergence": 1 / 0.1 - 1 / (2 * z)}))
    assert 0 < told.sensor_watts < told.accepted_watts * 0.05


def layered(*layers: dict[str, Any], **changes: Any) -> Scene:
    return scene(target__sensor__layers=list(layers), **changes)


def test_layers_dim_the_sensor_and_answer_themselves() -> None:
    near, far = {"depth": "0.3 mm", "reflectance": 0.04}, {"depth": "2 mm", "reflectance": 0.1, "transmittance": 0.8}
    bare, told = link_budget(scene()), link_budget(layered(near, far))
    assert [one.name for one in told.reflections] == ["sensor", "layers.0", "layers.1"]
    sensor, first, second = told.reflections
    assert sensor.transmittance == pytest.approx(0.96**2 * 0.8**2)
    assert (first.transmittance, second.transmittance) == (pytest.approx(0.64), 1.0)
    assert told.sensor_watts == pytest.approx(bare.sensor_watts * sensor.transmittance)
    assert told.total_watts == pytest.approx(sensor.watts + first.watts + second.watts)
    # Out of focus a layer's light is spread over more of the probe's sensor.
    sharp = link_budget(layered(near, far, object_distance=math.inf)).reflections
    assert sharp[0].radius_on_sensor < sharp[1].radius_on_sensor < sharp[2].radius_on_sensor
    # The order in which they are listed decides nothing.
    assert link_budget(layered(far, near)).reflections[2].watts == pytest.approx(first.watts)
    # What lies under glass seems nearer.
    glass = link_budget(layered({**near, "depth": "0.45 mm", "index": 1.5})).reflections[1]
    air = link_budget(layered(near)).reflections[1]
    assert glass.watts == pytest.approx(air.watts)


def test_a_specular_filter_makes_a_disc_of_the_probe_s_aperture() -> None:
    """0.3 mm before a 4 mm focus the light seems to come from 27 mm: it overfills the probe."""
    lens = {"focal_length": "4 mm", "aperture_radius": "1 mm"}
    one = layered({"depth": "0.3 mm"}, target__lens=lens, object_distance=math.inf)
    filtered = link_budget(one).reflections[1]
    rays = return_radius_by_rays(1e-3, 4e-3, 3.7e-3, 0.0, 5.0)
    assert rays == pytest.approx(1e-3 * abs(1 - 2 * 3.7 / 4) * 5 / (4e-3**2 / 0.6e-3 - 4e-3), rel=0.2)
    assert filtered.inside_probe == pytest.approx((25e-3 / rays) ** 2, rel=0.1)


def test_the_peak_is_called_an_estimate() -> None:
    (line,) = [one for one in link_budget(scene()).lines() if one.startswith("RR ")]
    assert "estimated in closed form, not from a picture" in line


def test_what_a_layer_lets_pass() -> None:
    assert layer_transmittance(Layer(depth=1e-3, reflectance=0.1), 640e-9) == pytest.approx(0.9)
    cut = Layer(depth=1e-3, reflectance=0.02, transmittance=((640e-9, 0.95), (785e-9, 0.05)))
    assert layer_transmittance(cut, 785e-9) == pytest.approx(0.05) and layer_transmittance(
        cut, 712.5e-9
    ) == pytest.approx(0.5)
    scatters = with_values(scene(), {"target.sensor.layers": [{"depth": 1e-3, "diffuse": {"albedo": 0.2}}]})
    assert layer_transmittance(scatters.target.sensor.layers[0], 640e-9) == pytest.approx(0.76)


@pytest.mark.parametrize(
    ("array", "share"),
    [
        (None, 1.0),
        (PixelArray(fill=0.5), 0.25),
        (PixelArray(fill=0.5, surround=1.0), 1.0),
        (PixelArray(fill=0.5, surround=1.0, phase=math.pi), 0.0),
        (PixelArray(fill=1.0, bayer=(1.0, 0.25, 0.25, 0.0)), 0.25),
        # The colours dim what lies between the photosites too: `surround` is over a photosite's reflectance.
        (PixelArray(fill=0.5, surround=0.25, bayer=(1.0, 0.25, 0.25, 0.0)), 0.25 * 0.75**2),
        (PixelArray(fill=0.4, surround=0.49, phase=math.pi, bayer=(0.36, 0.36, 0.36, 0.36)), 0.36 * 0.02**2),
        (PixelArray(fill=0.5, shape="round", surround=0.36, phase=math.pi / 2), 0.25 + 0.3**2),
    ],
)
def test_order_0_of_a_pixel_array(array: PixelArray | None, share: float) -> None:
    found = specular_reflectance(TargetSensor(reflectance=0.2, array=array), 640e-9)
    assert found == pytest.approx(0.2 * share, abs=1e-12)


@pytest.mark.parametrize("shift", [0.0, 1e-3])
@pytest.mark.parametrize(("fill", "surround", "phase"), [(1.0, 0.0, 0.0), (0.5, 0.5, 0.0), (0.3, 0.8, 2.1)])
@pytest.mark.parametrize("bayer", [None, (0.1, 0.2, 0.2, 0.1), (1.0, 0.5, 0.4, 0.0)])
def test_the_mirrors_direction_holds_what_a_sampled_plane_has_on_average(
    bayer: tuple[float, float, float, float] | None, fill: float, surround: float, phase: float, shift: float
) -> None:
    """Order 0 is the mean of the amplitude over a period: over a plane of points, with microlenses too."""
    array = PixelArray(fill=fill, surround=surround, phase=phase, bayer=bayer)
    pitch, focal, rim, n = 2.2e-6, 4e-6, 0.9 * 1.1e-6, 1000
    line = ((torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5) * pitch
    x, y = torch.meshgrid(line, line, indexing="xy")
    site = (x.abs().clamp_min(y.abs()) < pitch * math.sqrt(fill) / 2).double()
    cell = site + (1 - site) * math.sqrt(surround) * complex(math.cos(phase), math.sin(phase))
    bent = torch.exp(-1j * 2 * math.pi / 640e-9 / focal * torch.clamp(x**2 + y**2, max=rim**2))
    colours = 1.0 if bayer is None else sum(math.sqrt(one) for one in bayer) / 4
    for microlens, plane in ((None, cell), (Microlens(focal, 0.9, shift), cell * bent)):
        sensor = TargetSensor(reflectance=0.5, pixels=(649, 487), pitch=pitch, array=array, microlens=microlens)
        want = 0.5 * abs(complex(plane.mean()) * colours) ** 2
        assert specular_reflectance(sensor, 640e-9) == pytest.approx(want, rel=0.01, abs=2e-5)


def test_lines_of_other_wavelengths() -> None:
    one = scene(illumination__lines=[{"wavelength": "785 nm", "power": "3 mW"}], object_distance=math.inf)
    red, infrared = link_budget(one), link_budget(one, 785e-9)
    assert infrared.laser_watts == 3e-3 and infrared.accepted_watts == pytest.approx(3 * red.accepted_watts)
    assert infrared.photons / infrared.sensor_watts == pytest.approx(785 / 640 * red.photons / red.sensor_watts)
    assert infrared.reflections[0].radius_on_sensor == pytest.approx(785 / 640 * red.reflections[0].radius_on_sensor)
    with pytest.raises(InputError, match=r"wavelength: the scene has no light of 500 nm; choose one of 640, 785 nm"):
        link_budget(one, 500e-9)


def test_a_glass_defocuses_light_of_another_colour() -> None:
    plain = scene(object_distance=math.inf, illumination__lines=[{"wavelength": "785 nm", "power": "1 mW"}])
    dispersive = with_values(plain, {"target.lens.glass": "N-BK7", "target.lens.design_wavelength": "640 nm"})
    assert link_budget(dispersive) == link_budget(plain)
    blurred, sharp = link_budget(dispersive, 785e-9).reflections[0], link_budget(plain, 785e-9).reflections[0]
    # The sensor stays where red light is sharp: the rays of infrared light leave with a slope of 2 r (1/f - 1/f').
    f = focal_length_at(0.1, "N-BK7", 640e-9, 785e-9)
    slope = 2 * 1.5e-3 * (1 / 0.1 - 1 / f)
    assert blurred.radius_on_sensor - sharp.radius_on_sensor == pytest.approx(0.2 * slope, rel=0.1)


def test_what_a_scene_has_beyond_the_budget_is_named() -> None:
    assert link_budget(scene(object_distance=math.inf)).notes == ()
    rich = scene(
        illumination={
            "diameter": "1 mm",
            "second_beam": {"ratio": 0.1, "angle": [1e-3, 0]},
            "lines": [{"wavelength": "785 nm", "power": "1 mW"}],
        },
        distance=50.0,
        probe__sensor={"pixels": [8, 8], "hot_pixels": 0.1, "hot_current": 100},
        target__sensor={"array": {}, "microlens": {"focal_length": "5 um"}, "diffuse": {"albedo": 0.1}},
    )
    notes = " ".join(link_budget(rich).notes)
    for word in (
        "second beam",
        "wavelength",
        "array",
        "microlenses",
        "diffuse",
        "narrower",
        "Rayleigh",
        "hot",
        "larger",
    ):
        assert word in notes
    masked = scene(target__sensor__mask={"file": "mask.npy", "pitch": "2 um"})
    assert "mask" in " ".join(link_budget(masked).notes)
    assert link_budget(rich).accepted_watts == pytest.approx(1e-3)


def test_it_can_be_read_and_kept() -> None:
    told = link_budget(layered({"depth": "1 mm"}, illumination__lines=[{"wavelength": "785 nm", "power": 1e-3}]))
    kept = json.loads(json.dumps(told.as_dict(), allow_nan=False))
    assert kept["sensor_watts"] == told.sensor_watts and kept["reflections"][1]["name"] == "layers.0"
    assert kept["field_of_view"] == told.field_of_view and kept["notes"] == list(told.notes)
    lines = told.lines()
    assert lines[0] == "laser             1 mW at 640 nm, collimated, Rayleigh range 3.068 km"
    assert lines[1] == "lit at the target 50 mm wide, 0.573 deg, 5 m away"
    for word in ("irradiance", "reflected", "photons", "electrons", "SNR", "layers.0", "note", "µW", "nW"):
        assert any(word in line for line in lines), word
    assert all("\n" not in line and len(line) < 120 for line in lines)
    bright = link_budget(scene(exposure=1e-2))
    assert bright.saturation > 1 and any("clipped" in line for line in bright.lines())


def test_a_beam_narrower_than_the_aperture_goes_in_whole() -> None:
    light = Illumination(diameter=1e-3)
    one = with_values(scene(), {"illumination": {"diameter": light.diameter}})
    assert beam_radius(one) == 0.5e-3 and irradiance_at_target(one) > 1e3
    assert link_budget(one).accepted_watts == pytest.approx(1e-3)


def test_a_wavelength_of_single_precision_is_known() -> None:
    scene = load_scene("thin-lens")
    single: Any = np.float32(640e-9)
    assert link_budget(scene, single) == link_budget(scene)
    with pytest.raises(InputError, match="the scene has no light of 640"):
        link_budget(scene, 640.01e-9)
