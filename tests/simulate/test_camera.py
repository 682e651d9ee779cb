"""One target before one probe: layers, light of many kinds, and the power that comes of it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import j1

from tapetum.bench import Scene, load_scene, with_values
from tapetum.errors import InputError
from tapetum.optics.glass import refractive_index
from tapetum.optics.grid import Grid
from tapetum.simulate import Camera, retroreflect
from tapetum.simulate.light import directions
from tapetum.simulate.radiometry import photoelectrons

FOCAL, RADIUS, WAVELENGTH, PROBE_FOCAL = 0.02, 1e-3, 640e-9, 0.1
TARGET = "f = 20 mm, r = 1 mm"
# An Airy ring on the probe's sensor.
RING = WAVELENGTH * PROBE_FOCAL / (2 * RADIUS)
SECTION = "Layers and light"
ON_AXIS = torch.zeros(1, 2, dtype=torch.float64)


def scene(**changes: Any) -> Scene:
    """A small target focused at infinity, in a beam of 20 mm; fields by their names, dots written as two lines."""
    values = {
        "target.lens.focal_length": FOCAL,
        "target.lens.aperture_radius": RADIUS,
        "target.object_distance": "inf",
        "probe.lens.focal_length": PROBE_FOCAL,
        "probe.lens.aperture_radius": 0.02,
        "probe.sensor.pixels": [64, 64],
        "probe.sensor.pitch": RING / 3,
        "illumination.diameter": 0.02,
    }
    return with_values(load_scene("thin-lens"), values | {key.replace("__", "."): one for key, one in changes.items()})


def image(one: Scene, accuracy: float | None = None, sines: torch.Tensor = ON_AXIS) -> torch.Tensor:
    """Irradiance [H, W], float64."""
    steepest = float(sines.norm(dim=1).max())
    return Camera(one, steepest, accuracy=accuracy, dtype=torch.complex128, device="cpu")(sines)[0].double()


def watts(one: Scene) -> float:
    """What falls onto the probe's sensor."""
    return float(image(one).sum()) * one.probe.sensor.pitch**2


def layered(depth: float, **light: Any) -> Scene:
    layer = {"depth": depth, "index": 1.5, "reflectance": 0.06}
    return scene(target__sensor__layers=[layer], **{f"illumination__{key}": one for key, one in light.items()})


def test_planes_beyond_the_coherence_length_add_as_intensity(validated: Any) -> None:
    depth = 0.2e-3
    both = image(layered(depth, coherence_length=0.5e-3))
    behind = scene(target__sensor__layers=[{"depth": depth, "index": 1.5, "reflectance": 0, "transmittance": 0.94}])
    before = layered(depth)
    before = with_values(before, {"target.sensor.reflectance": 0.0})
    error = (both - image(behind) - image(before)).abs().max() / both.max()
    validated(SECTION, f"layer beyond the coherence length, {TARGET}", error, 1e-6, "sum of both planes' images")


def test_planes_within_the_coherence_length_interfere(validated: Any) -> None:
    """Four depths a quarter of a fringe apart: their mean is the incoherent image, and one by one they differ."""
    depth, fringe = 0.2e-3, WAVELENGTH / (2 * 1.5)
    shown = [image(layered(depth + i * fringe / 4, coherence_length=1e-3)) for i in range(4)]
    apart = image(layered(depth, coherence_length=1e-6))
    error = (torch.stack(shown).mean(0) - apart).abs().max() / apart.max()
    validated(SECTION, f"fringes of a layer, mean over four quarters of one, {TARGET}", error, 2e-3,
              "the layer beyond the coherence length")  # fmt: skip
    totals = [float(one.sum()) for one in shown]
    assert max(totals) > 1.05 * min(totals)
    # The next fringe looks the same.
    again = image(layered(depth + fringe, coherence_length=1e-3))
    assert float((again - shown[0]).abs().max()) < 5e-3 * float(apart.max())


def test_a_layer_dims_what_lies_behind_it_twice() -> None:
    clear = {"depth": 1e-4, "reflectance": 0}
    bare = image(scene())
    half = image(scene(target__sensor__layers=[{**clear, "transmittance": 0.5}]))
    assert torch.allclose(half, bare / 4, rtol=1e-9)
    by_colour = [["500 nm", 0.2], ["600 nm", 0.6], ["700 nm", 1.0]]
    dim = image(scene(target__sensor__layers=[{**clear, "transmittance": by_colour}]))
    assert torch.allclose(dim, bare * 0.76**2, rtol=1e-9)


def _edge(picture: torch.Tensor, pitch: float) -> float:
    """Radius of a disc of light: a sharp edge's own place has a quarter of the irradiance inside."""
    half = picture.shape[0] // 2
    inside = picture[half - 8 : half + 8, half - 8 : half + 8].mean()
    return math.sqrt(float((picture > inside / 4).sum()) / math.pi) * pitch


FILTER: dict[str, Any] = {
    "target__lens__focal_length": 4e-3,
    "target__lens__aperture_radius": 0.5e-3,
    "target__sensor__reflectance": 0.0,
    "target__sensor__layers": [{"depth": 0.3e-3, "reflectance": 0.1}],
    "probe__lens__focal_length": 0.05,
    "probe__sensor__pixels": [80, 80],
}


def test_a_filter_before_the_focus_returns_light_as_from_a_point(validated: Any) -> None:
    """Half-angle 2rt/f² of the return: as from a point f²/2t = 26.7 mm away."""
    one = scene(**FILTER, probe__sensor__pitch=30e-6, sampling__propagation="far field")
    want = 0.05 * 0.5e-3 * 2 * 0.3e-3 / 4e-3**2
    error = abs(_edge(image(one), 30e-6) / want - 1)
    validated(SECTION, "spread of a filter's return, 0.3 mm before the focus of f = 4 mm, r = 0.5 mm", error, 0.03,
              "rays as from a point f²/2t = 26.7 mm away", "relative")  # fmt: skip


@pytest.mark.parametrize("distance", [1.0, 2.0])
def test_a_filter_shows_the_probe_s_own_aperture(distance: float, validated: Any) -> None:
    """PHYSICS: a disc of D_p f_p/d, that diffuse light is not alone in giving."""
    pitch = 8e-6 / distance
    one = scene(**FILTER, probe__sensor__pitch=pitch, distance=distance, probe__lens__aperture_radius=5e-3)
    assert "finite" in Camera(one, 0.0).metadata()["propagation"]
    error = abs(_edge(image(one), pitch) / (5e-3 * 0.05 / distance) - 1)
    validated(SECTION, f"a filter's return at {distance:g} m, seen through a probe of 10 mm", error, 0.04,
              "the aperture's picture D_p f_p/d", "relative")  # fmt: skip


def test_a_wide_source_blurs_and_keeps_the_power(validated: Any) -> None:
    sharp, wide = scene(), scene(illumination__source_size=4 * WAVELENGTH / (2 * RADIUS))
    blurred, point = (Camera(one, 0.0, device="cpu")(ON_AXIS)[0].double() for one in (wide, sharp))
    error = abs(float(blurred.sum() / point.sum()) - 1)
    validated(SECTION, f"power of a source 4 λ/2r wide, {TARGET}", error, 0.01, "a point source's", "relative")
    assert float(blurred.max()) < 0.4 * float(point.max())
    # An even disc of four rings' width: its middle is flat.
    middle = blurred[29:35, 29:35]
    assert float(middle.min()) > 0.8 * float(middle.max())


@pytest.mark.parametrize("wide", [0.3, 1.0, 6.0])
def test_directions_of_a_source_are_those_of_a_disc(wide: float) -> None:
    """Moments of an even disc, and what it makes of the finest fringes: 2 J1(t)/t for a turn of t at its rim."""
    airy = WAVELENGTH / (2 * RADIUS)
    x, y, share = np.array(directions(scene(illumination__source_size=wide * airy).illumination, airy)).T
    radius, turn = wide * airy / 2, math.pi * wide
    assert share.sum() == pytest.approx(1) and (share * x).sum() == pytest.approx(0, abs=1e-9 * radius)
    assert (share * x**2).sum() == pytest.approx(radius**2 / 4) == pytest.approx((share * y**2).sum())
    for angle in (0.0, 0.4, 1.3):
        along = x * math.cos(angle) + y * math.sin(angle)
        assert (share * np.cos(turn * along / radius)).sum() == pytest.approx(2 * j1(turn) / turn, abs=1e-3)


def test_an_led_s_bandwidth_fills_dark_rings_and_keeps_the_power(validated: Any) -> None:
    laser, led = scene(), scene(illumination__bandwidth=40e-9)
    error = abs(watts(led) / watts(laser) - 1)
    validated(SECTION, f"power of light of 40 nm bandwidth, {TARGET}", error, 0.01, "a laser's", "relative")
    half = scene(probe__sensor__pixels=[257, 1], probe__sensor__pitch=RING / 12)
    many = with_values(half, {"illumination.bandwidth": 40e-9})
    ring = slice(128 + 90, 128 + 120)
    assert float(image(many)[0, ring].min()) > 4 * float(image(half)[0, ring].min())


def test_wavelengths_add_and_photons_are_counted(validated: Any) -> None:
    lines = [{"wavelength": "785 nm", "power": "2 mW"}, {"wavelength": "532 nm", "power": "0.3 mW"}]
    one = scene(illumination__lines=lines)
    both = retroreflect(one, dtype=torch.complex128, device="cpu")
    alone = [("640 nm", "1 mW")] + [(line["wavelength"], line["power"]) for line in lines]
    parts = [
        retroreflect(
            scene(illumination__wavelength=wavelength, illumination__power=power), dtype=torch.complex128, device="cpu"
        )
        for wavelength, power in alone
    ]
    summed = torch.stack([part.irradiance for part in parts]).sum(0)
    error = (both.irradiance - summed).abs().max() / summed.max()
    validated(SECTION, f"light of 640, 785 and 532 nm, {TARGET}", error, 1e-9, "sum of three scenes of one line")
    sensor = one.probe.sensor
    want = sum(photoelectrons(part.irradiance, sensor, part.metadata["wavelength"]) for part in parts)
    assert both.equivalent is not None
    got = photoelectrons(both.equivalent, sensor, both.metadata["wavelength"])
    validated(SECTION, f"photo-electrons of 640, 785 and 532 nm, {TARGET}", (got - want).abs().max() / want.max(), 1e-9,
              "sum of each line's own")  # fmt: skip


@pytest.mark.parametrize("name", ["power", "distance", "focal_length", "object_distance"])
@pytest.mark.parametrize("value", [-4.0, 0.0, math.nan])
def test_values_in_place_of_the_scene_s_are_checked(name: str, value: float) -> None:
    for given in (value, torch.tensor(value, dtype=torch.float64, requires_grad=True)):
        with pytest.raises(InputError, match=f"{name}: must be positive"):
            Camera(scene(), 0.0, device="cpu", **{name: given})
    if name != "object_distance":
        with pytest.raises(InputError, match=f"{name}: must be positive and finite, is inf"):
            Camera(scene(), 0.0, device="cpu", **{name: math.inf})


@pytest.mark.parametrize("steepest", [-0.1, 1.0, math.nan, math.inf])
def test_a_steepest_tilt_that_is_none_is_refused(steepest: float) -> None:
    with pytest.raises(InputError, match="steepest: must be a sine from 0, below 1, is"):
        Camera(scene(), steepest, device="cpu")


@pytest.mark.parametrize("sine", [0.02, -0.02, 1.5, math.nan, math.inf])
def test_tilts_beyond_the_planned_ones_are_refused(sine: float) -> None:
    camera = Camera(scene(), 0.01, device="cpu")
    camera(torch.tensor([[0.006, 0.008]], dtype=torch.float32))
    with pytest.raises(InputError, match=r"sines: holds a tilt of sine .* is planned for 0\.01 at most"):
        camera(torch.tensor([[0.0, 0.0], [0.0, sine]], dtype=torch.float64))


def test_gradients_flow_at_the_steepest_tilt() -> None:
    sines = torch.tensor([[0.0, 0.01]], dtype=torch.float64, requires_grad=True)
    Camera(scene(), 0.01, device="cpu")(sines).square().sum().backward()
    assert sines.grad is not None and bool(torch.isfinite(sines.grad).all()) and float(sines.grad.abs().max()) > 0


def test_the_focus_moves_with_the_wavelength(validated: Any) -> None:
    """Of a singlet set at 532 nm, light of 785 nm comes back best where its vergence makes the return collimated."""
    glass = {"target__lens__glass": "N-BK7", "target__lens__design_wavelength": "532 nm"}
    changed = {**glass, "target__lens__aperture_radius": 3e-3, "illumination__wavelength": "785 nm"}
    focal = FOCAL * (refractive_index("N-BK7", 532e-9) - 1) / (refractive_index("N-BK7", 785e-9) - 1)
    assert Camera(scene(**changed), 0.0).geometry.focal_length == pytest.approx(focal, rel=1e-9)
    # A ray's slope after its way back, 1/f - v + (1 - 2z(1/f - v))/f, is zero.
    want = 1 / focal + 1 / (focal - 2 * FOCAL)
    found = _best_vergence(changed, want + np.linspace(-0.06, 0.06, 5))
    validated(SECTION, "vergence of the brightest return, N-BK7, f = 20 mm at 532 nm, light of 785 nm",
              abs(found - want), 0.01, "1/f + 1/(f - 2z)", "1/m")  # fmt: skip
    assert abs(want) > 0.5


def _peaks(changes: dict[str, Any], vergences: Any) -> list[float]:
    small = {**changes, "probe__sensor__pixels": [15, 15], "probe__sensor__pitch": RING / 6}
    return [float(image(scene(**small, illumination__vergence=float(v)), 1e-2).max()) for v in vergences]


def _best_vergence(changes: dict[str, Any], vergences: Any) -> float:
    peaks = _peaks(changes, vergences)
    best = int(np.argmax(peaks))
    a, b, c = np.polyfit(vergences[best - 1 : best + 2], peaks[best - 1 : best + 2], 2)
    del c
    return float(-b / (2 * a))


def test_a_vergence_scan_finds_the_sensor_and_a_layer(validated: Any) -> None:
    """Paper, section 6. The probe looks to infinity: each plane is brightest where its return is collimated."""
    depth = 0.1e-3
    both = {
        "target__lens__aperture_radius": 3e-3,
        "target__sensor__layers": [{"depth": depth, "reflectance": 0.1, "transmittance": 0.9}],
        "illumination__coherence_length": 1e-6,
    }
    layer = 1 / FOCAL - 1 / (FOCAL - 2 * depth)
    step = np.linspace(-0.06, 0.06, 5)
    for name, want in (("sensor", 0.0), ("layer 0.1 mm before it", layer)):
        found = _best_vergence(both, want + step)
        validated(SECTION, f"vergence of the brightest return, {name}, f = 20 mm, r = 3 mm", abs(found - want), 0.01,
                  "the rays' own: 1/f - 1/(f - 2t)", "1/m")  # fmt: skip
    sensor, between, before = _peaks(both, (0.0, layer / 2, layer))
    assert between < 0.4 * min(sensor, before)


@pytest.mark.parametrize("narrower", [3, 12])
def test_a_beam_narrower_than_the_aperture_is_its_own_aperture(narrower: int, validated: Any) -> None:
    """In focus, head on, the lens cuts off but a few 1e-3 of what the beam's edge diffracts: Airy's picture of it."""
    lit, pitch = RADIUS / narrower, RING * narrower / 8
    changes = {"illumination__diameter": 2 * lit, "probe__sensor__pitch": pitch, "sampling__propagation": "far field"}
    one = scene(**changes)
    at = (np.arange(64) - 31.5) * pitch
    v = 2 * math.pi / WAVELENGTH * lit * np.hypot(at[:, None], at[None, :]) / PROBE_FOCAL
    airy = torch.from_numpy((2 * j1(v) / v) ** 2) * (math.pi * lit**2 / (WAVELENGTH * PROBE_FOCAL)) ** 2
    airy = airy * 1e-3 / (math.pi * lit**2) * one.target.sensor.reflectance * one.probe.transmission
    error = (image(one) - airy).abs().max() / airy.max()
    validated(SECTION, f"beam of 1/{narrower} of the aperture, head on, {TARGET}", error, 5e-3,
              "Airy's pattern of the beam")  # fmt: skip
    # The plan is made for the whole aperture, whose rings are finer than the beam's.
    fine = image(one, 1e-4)
    error = (image(one, 1e-2) - fine).abs().max() / fine.max()
    validated(SECTION, f"the same beam of 1/{narrower}, accuracy of 1e-2 asked for", error, 1e-2, "accuracy of 1e-4")


def test_a_narrow_beam_has_a_cut_off_of_its_own() -> None:
    """Turned so far that its middle lands beside the lens: the rest of the aperture would still return light."""
    sine = math.sin(math.atan(1.2 * RADIUS / (2 * FOCAL)))
    assert math.isfinite(Camera(scene(), sine).plan.expected_error)
    assert math.isinf(Camera(scene(illumination__diameter=2e-4), sine).plan.expected_error)


def test_diverging_light_fades_with_the_square_of_the_distance() -> None:
    light = {"mode": "diverging", "divergence": "0.5 deg", "vergence": 0.0}
    near, far = (image(scene(illumination=light, distance=d, sampling__propagation="far field")) for d in (2.0, 8.0))
    assert torch.allclose(near, 16 * far, rtol=1e-9)


def test_an_overfilled_probe_is_propagated_to_and_says_so() -> None:
    fits = Camera(scene(), 0.0).metadata()
    assert fits["propagation"] == "far field"
    near = {"target__object_distance": 0.5, "distance": 4.0, "probe__lens__aperture_radius": 3e-3}
    over = scene(**near)
    told = Camera(over, 0.0).metadata()
    assert told["propagation"].startswith("finite")
    assert told["return_radius_at_probe"] > 3e-3
    forced = scene(**near, sampling__propagation="far field")
    assert "overfills" in Camera(forced, 0.0).metadata()["propagation"]
    assert watts(over) < 0.9 * watts(forced)


@pytest.mark.parametrize("degrees", [0.0, 0.7, 1.4])
@pytest.mark.parametrize("mode", ["collimated", "diverging"])
def test_energy_is_never_gained(degrees: float, mode: str, validated: Any) -> None:
    light = {"mode": mode, "power": 1e-3} | ({"divergence": "0.5 deg"} if mode == "diverging" else {"diameter": 0.02})
    one = scene(illumination=light, target__object_distance=5.0, probe__sensor__pixels=[120, 120])
    beam = 0.01 if mode == "collimated" else 5.0 * math.tan(math.radians(0.25))
    entered = 1e-3 * (RADIUS / beam) ** 2 * one.target.sensor.reflectance * one.probe.transmission
    sines = torch.tensor([[0.0, math.sin(math.radians(degrees))]], dtype=torch.float64)
    shown = float(image(one, sines=sines).sum()) * one.probe.sensor.pitch**2
    gained = max(0.0, shown / entered - 1)
    validated(SECTION, f"power gained, {mode} light, {degrees:g}°, {TARGET}, x_d = 5 m", gained, 1e-3,
              "what entered the aperture", "of the power")  # fmt: skip
    assert shown > 0.2 * entered


def test_light_that_a_narrow_beam_scatters_is_the_beam_s() -> None:
    """Of a beam narrower than the aperture no more is scattered than arrives: as bright as the whole beam's power."""
    plane: dict[str, Any] = {"target__sensor__reflectance": 0.0, "target__sensor__diffuse": {"albedo": 0.5}}
    broad = scene(**plane, illumination__diameter=2 * RADIUS)
    narrow = scene(**plane, illumination__diameter=RADIUS)
    assert watts(narrow) == pytest.approx(watts(broad), rel=0.1)


@pytest.mark.parametrize(("beam", "power"), [(RADIUS, 1), (0.02, 2)])
def test_scattered_light_goes_by_the_width_that_the_tilt_leaves(beam: float, power: int) -> None:
    """The tilted lens looks narrower to the probe; what it takes in of a beam within it stays the whole beam."""
    plane: dict[str, Any] = {"target__sensor__reflectance": 0.0, "target__sensor__diffuse": {"albedo": 0.5}}
    one = scene(**plane, illumination__diameter=beam, target__sensor__pixels=[9000, 9000])
    sines = torch.tensor([[0.0, 0.0], [0.0, 0.5]], dtype=torch.float64)
    first, tilted = Camera(one, 0.5, dtype=torch.complex128, device="cpu")(sines).double().sum((1, 2))
    assert float(tilted / first) == pytest.approx(0.75 ** (power / 2), rel=5e-3)


def test_a_mask_lies_behind_the_layers(tmp_path: Any) -> None:
    path = tmp_path / "mask.npy"
    np.save(path, np.ones((16, 16), np.complex128))
    mask: dict[str, Any] = {"target__sensor__mask": {"file": str(path), "pitch": 20e-6}, "sampling__accuracy": 1e-2}
    bare = image(scene(**mask))
    dimmed = image(scene(**mask, target__sensor__layers=[{"depth": 1e-4, "reflectance": 0, "transmittance": 0.5}]))
    assert torch.allclose(dimmed, bare / 4, rtol=1e-9)
    with pytest.raises(InputError, match=r"illumination: a beam .* does not fill"):
        assert Camera(scene(**mask, illumination__diameter=RADIUS), 0.0).plan
    # Fields of a mask and of a layer are not added: in laser light they interfere, over a short coherence they do not.
    glass: dict[str, Any] = {"target__sensor__layers": [{"depth": 1e-4, "reflectance": 0.2}]}
    with pytest.raises(
        InputError, match=r"target\.sensor\.mask: light of the layer 0\.0001 m before the mask interferes"
    ):
        image(scene(**mask, **glass))
    short: dict[str, Any] = {**glass, "illumination__coherence_length": 1e-4}
    uniform = image(scene(**short, sampling__accuracy=1e-2))
    assert float((image(scene(**mask, **short)) - uniform).abs().max()) < 0.02 * float(uniform.max())


def test_a_spot_beside_a_mask_states_what_its_faint_picture_is_off_by(tmp_path: Path) -> None:
    """Some rings beside it what returns is the spot's outer rings, of which the window cuts off its share."""
    dice, path = np.random.default_rng(5), tmp_path / "mask.npy"
    np.save(path, dice.random((45, 45)) * np.exp(2j * math.pi * dice.random((45, 45))))
    one = scene(target__sensor__mask={"file": str(path), "pitch": 10e-6}, sampling__propagation="far field")
    # The mask reaches 225 um from the axis, a dark ring takes 6.4 um.
    sines = torch.tensor([[0.0, 0.0], [0.0, 270e-6 / FOCAL]], dtype=torch.float64)
    rough, fine = (Camera(one, 0.02, accuracy=a, device="cpu") for a in (3e-2, 1e-3))
    middle, beside = rough(sines[:1])[0], rough(sines[1:])[0]
    assert float(beside.max()) < 1e-4 * float(middle.max())
    want = fine(sines[1:])[0]
    error = float((beside - want).abs().max() / want.max())
    assert 0 < error < rough.metadata()["expected_error"]
    assert rough.metadata()["expected_error"] > rough.plan.expected_error


@pytest.mark.parametrize("rings", [pytest.param(16, marks=pytest.mark.slow), 25])
def test_a_spot_beside_the_sensor_states_what_its_faint_picture_is_off_by(rings: int) -> None:
    """The sampled plane's error is one of a mirror's picture: of this one's it is up to a quarter."""
    one = scene(target__sensor__pixels=[100, 100], target__sensor__pitch=2e-6, sampling__propagation="far field")
    across = 100e-6 + rings * WAVELENGTH * FOCAL / (2 * RADIUS)
    sines = torch.tensor([[0.0, math.sin(math.atan(across / FOCAL))]], dtype=torch.float64)
    rough, fine = (Camera(one, float(sines.max()), accuracy=a, device="cpu") for a in (1e-2, 1e-3))
    found, want = rough(sines)[0], fine(sines)[0]
    error, stated = float((found - want).abs().max() / want.max()), rough.metadata()["expected_error"]
    assert 0 < error < stated < math.inf and stated > 2 * rough.plan.expected_error


def test_forced_samples_are_refused_behind_a_traced_lens() -> None:
    """They were not looked at, while the image's metadata named others."""
    scene = load_scene("rotation", ["sampling.pupil=64"])
    with pytest.raises(InputError, match=r"sampling\.pupil"):
        Camera(scene, 0.01)


@pytest.mark.parametrize("propagation", ["far field", "finite"])
@pytest.mark.parametrize("case", ["filter", "array", "scattering"])
def test_the_window_holds_what_every_plane_returns(case: str, propagation: str, validated: Any) -> None:
    """A filter sends light as from a point before the focus, orders of an array meet the lens elsewhere."""
    sensors: dict[str, dict[str, Any]] = {
        "filter": {"reflectance": 0.01, "layers": [{"depth": 3e-4, "reflectance": 0.5}]},
        "array": {"array": {"pitch": 2e-6, "fill": 0.5}},
        "scattering": {"reflectance": 0.0, "diffuse": {"albedo": 0.3, "spread": 3e-6}},
    }
    scene = with_values(
        load_scene("thin-lens"),
        {
            "distance": 0.5,
            "target.lens": {"focal_length": 4e-3, "aperture_radius": 1e-3},
            "target.object_distance": 1.0,
            "target.sensor": sensors[case],
            "probe.lens.aperture_radius": 2e-3,
            "probe.sensor.pitch": 50e-6,
            "sampling": {"accuracy": 1e-2, "propagation": propagation},
        },
    )
    at = torch.tensor([[0.06, -0.03]], dtype=torch.float64)

    def power(grid: Grid) -> float:
        return float(Camera(scene, 0.07, output=grid, device="cpu")(at).double().sum())

    window = Camera(scene, 0.07, device="cpu").window()
    lost = 1 - power(window) / power(Grid(2 * window.rows + 1, 2 * window.columns + 1, window.pitch))
    what = f"Light beside the window, a lens of 4 mm with {case}, {propagation}"
    validated("Windows", what, lost, 0.01, "a window twice as wide", "of the light")
