"""What is not built as drawn: tilted sensors, decentred lenses, shifted microlenses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from tapetum.bench import Layer, Microlens, PixelArray, Scene, TargetSensor, load_scene, with_values
from tapetum.errors import InputError
from tapetum.optics.fourier import phasor
from tapetum.optics.grid import Grid, lens_numbers
from tapetum.optics.grid_sampling import plan_double_pass
from tapetum.optics.sampling import DoublePassGeometry, plan_round
from tapetum.simulate import Camera, gaze_of, sign_dprime, tilt_of_gaze
from tapetum.simulate.double_pass import DoublePass
from tapetum.simulate.hypotheses import point_of_symmetry
from tapetum.simulate.reflections import specular_groups
from tapetum.simulate.round_pass import RoundPass
from tapetum.simulate.sensor_plane import orders_of, reflectance_at
from tapetum.simulate.surfaces import Order, Surface

SECTION = "Tilt, decentre and microlens shift"
WAVELENGTH, PITCH = 640e-9, 30e-6
K = 2 * math.pi / WAVELENGTH
FOCAL, RADIUS, FOCUSED = 0.05, 0.8e-3, 3.0
OUTPUT = Grid(24, 24, 12e-6)
Validated = Callable[..., None]
Mask = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def geometry(sine: float) -> DoublePassGeometry:
    z, _ = lens_numbers(FOCAL, FOCUSED)
    return DoublePassGeometry(WAVELENGTH, RADIUS, FOCAL, z, 0.2, math.hypot(OUTPUT.width, OUTPUT.height) / 2, sine)


def scene_of(sensor: TargetSensor) -> Scene:
    scene = with_values(
        load_scene("thin-lens"),
        {"target.lens": {"focal_length": FOCAL, "aperture_radius": RADIUS}, "target.object_distance": FOCUSED},
    )
    return replace(scene, target=replace(scene.target, sensor=sensor))


def by_orders(sensor: TargetSensor, tilt: torch.Tensor) -> torch.Tensor:
    """Complex field on the probe, without the mirror's own phase, which the grids leave out."""
    turn = math.hypot(*sensor.tilt)
    g = geometry(float(tilt.norm()) + turn)
    widest = 1.35 * (g.return_radius + g.radius) / g.image_distance + 2 * g.tangent
    z = torch.tensor(g.image_distance, dtype=torch.float64)
    (surfaces,) = specular_groups(scene_of(sensor), WAVELENGTH, z, widest)
    plan = plan_round(g, 1e-3, pixels=OUTPUT.rows * OUTPUT.columns)
    field = RoundPass(g, plan, OUTPUT, surfaces, dtype=torch.complex128).field(tilt[None])[0]
    if len(surfaces[0].orders) == 1:
        # One order alone keeps no phase of its own.
        return field
    return field * phasor(-K * z * (tilt**2).sum() / (1 - (tilt**2).sum()))


def by_samples(mask: Mask, tilt: torch.Tensor, turn: float, finest: float) -> torch.Tensor:
    g = geometry(float(tilt.norm()) + turn)
    plan = plan_double_pass(g, 3e-3, pixels=OUTPUT.rows * OUTPUT.columns, finest=finest)
    return DoublePass(g, plan, OUTPUT, mask=mask, dtype=torch.complex128).field(tilt[None])[0]


def apart(got: torch.Tensor, want: torch.Tensor, *, phase: bool = True) -> float:
    if not phase:
        overlap = (got.conj() * want).sum()
        got = got * overlap / overlap.abs()
    return float((got - want).abs().max() / want.abs().max())


TILT = torch.tensor([0.003, -0.004], dtype=torch.float64)


def test_a_tilted_mirror_is_a_sampled_phase(validated: Validated) -> None:
    a = (0.004, 0.002)

    def mask(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return phasor(2 * K * (a[0] * x[..., None, :] + a[1] * y[..., :, None]))

    one = TargetSensor(1.0, (649, 487), PITCH, tilt=a)
    got, want = by_orders(one, TILT), by_samples(mask, TILT, math.hypot(*a), 40e-6)
    what = "Mirror tilted by (4, 2) mrad, f = 50 mm, x_d = 3 m: complex field"
    validated(SECTION, what, apart(got, want, phase=False), 1e-3, "the mask exp(2ik a·u) sampled, double pass by grids")
    straight = by_orders(replace(one, tilt=(0.0, 0.0)), TILT)
    assert apart(straight, want, phase=False) > 0.02


def test_a_tilted_sensor_changes_its_focus_along_itself(validated: Validated) -> None:
    """Each gaze of one batch meets it at another distance: z + a·u0, u0 = z t/(1 - a·t)."""
    a, radius = (0.006, -0.01), 2e-3
    at = torch.tensor([[0.005, -0.02], [-0.01, 0.036], [0.0, 0.0]], dtype=torch.float64)
    g = replace(geometry(0.04), radius=radius)
    z = torch.tensor(g.image_distance, dtype=torch.float64)
    ((surface,),) = specular_groups(scene_of(TargetSensor(1.0, tilt=a)), WAVELENGTH, z, 0.2)
    got = RoundPass(g, plan_round(g, 1e-3), OUTPUT, (surface,), dtype=torch.complex128)(at)
    flat = RoundPass(g, plan_round(g, 1e-3), OUTPUT, (replace(surface, tilt=(0.0, 0.0)),), dtype=torch.complex128)(at)
    for tilt, ours, without in zip(at, got, flat, strict=True):
        slope = tilt / torch.sqrt(1 - (tilt**2).sum())
        there = replace(g, image_distance=float(z / (1 - slope @ torch.tensor(a, dtype=torch.float64))))

        def mask(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
            return phasor(2 * K * (a[0] * x[..., None, :] + a[1] * y[..., :, None]))

        grids = plan_double_pass(there, 3e-3, pixels=OUTPUT.rows * OUTPUT.columns, finest=80e-6)
        want = DoublePass(there, grids, OUTPUT, mask=mask, dtype=torch.complex128)(tilt[None])[0]
        what = f"Sensor tilted by (6, -10) mrad, f = 50 mm, f/12, tilt ({tilt[0]:g}, {tilt[1]:g})"
        error = (ours - want).abs().max() / want.max()
        # The grids claim 3e-3.
        validated(SECTION, f"{what}: image", error, 3e-3, "a mirror where the gaze meets it, double pass by grids")
        if bool(tilt.any()):
            assert float((without - want).abs().max()) > 0.015 * float(want.max())


def test_gradients_follow_the_focus_along_a_tilted_sensor() -> None:
    g = replace(geometry(0.04), radius=0.5e-3)
    surface = Surface(g.image_distance, (Order((0.02, -0.03)),), tilt=(0.01, -0.015))
    one = RoundPass(g, plan_round(g, 1e-2), Grid(3, 3, 30e-6), (surface,), dtype=torch.complex128)

    def image(tilt: torch.Tensor) -> torch.Tensor:
        return one(tilt * 1e-2)

    tilt = torch.tensor([[0.9, 1.7], [-1.7, 0.3]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(image, (tilt,), eps=1e-6, atol=1e-6, rtol=2e-3)


def test_a_tilted_filter_is_a_sampled_phase_at_its_depth(validated: Validated) -> None:
    a, depth = (0.004, 0.002), 0.4e-3

    def mask(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return phasor(2 * K * (a[0] * x[..., None, :] + a[1] * y[..., :, None]))

    sensor = TargetSensor(0.0, (649, 487), PITCH, layers=(Layer(depth, 1.0, tilt=a),))
    g = geometry(float(TILT.norm()) + math.hypot(*a))
    z = torch.tensor(g.image_distance, dtype=torch.float64)
    ((surface,),) = specular_groups(scene_of(sensor), WAVELENGTH, z, 0.1)
    before = replace(g, image_distance=g.image_distance - depth)
    plan = plan_round(before, 1e-3, pixels=OUTPUT.rows * OUTPUT.columns)
    got = RoundPass(before, plan, OUTPUT, (surface,), dtype=torch.complex128).field(TILT[None])[0]
    grids = plan_double_pass(before, 3e-3, pixels=OUTPUT.rows * OUTPUT.columns, finest=40e-6)
    want = DoublePass(before, grids, OUTPUT, mask=mask, dtype=torch.complex128).field(TILT[None])[0]
    what = "Filter tilted by (4, 2) mrad, 0.4 mm before the sensor, f = 50 mm: complex field"
    validated(SECTION, what, apart(got, want, phase=False), 1e-3, "the mask exp(2ik a·u) sampled, double pass by grids")


def test_a_tilted_filter_close_to_the_sensor_is_the_sensor_tilted() -> None:
    """Behind a traced lens too."""
    lens = {"kind": "prescription", "name": "la1509", "focal_length": 0.02, "f_number": 16}
    scene = with_values(load_scene("rotation"), {"sampling.accuracy": 0.3, "target.lens": lens})
    grid, sines = Grid(41, 41, 8.8e-6), torch.tensor([[0.005, -0.012]], dtype=torch.float64)

    def picture(sensor: TargetSensor) -> torch.Tensor:
        return Camera(replace(scene, target=replace(scene.target, sensor=sensor)), 0.02, output=grid)(sines)

    a, pixels, pitch = (0.006, -0.003), (2000, 1500), 2e-6
    want = picture(TargetSensor(0.5, pixels, pitch, tilt=a))
    got = picture(TargetSensor(0.0, pixels, pitch, layers=(Layer(1e-9, 0.5, tilt=a),)))
    straight = picture(TargetSensor(0.5, pixels, pitch))
    peak = float(want.max())
    assert float((got - want).abs().max()) < 1e-3 * peak
    assert float((straight - want).abs().max()) > 0.05 * peak


def test_a_tilt_only_moves_the_point_of_symmetry(validated: Validated) -> None:
    """Focused on infinity, in parallel light: the exit angle of a tilted plane's return is then nothing."""
    pixels = {"probe.sensor.pixels": [160, 120]}
    scene = with_values(load_scene("thin-lens"), {"target.object_distance": math.inf, "accuracy": 1e-3, **pixels})
    tilted = with_values(scene, {"target.sensor": {"tilt": [0.006, -0.002]}})
    sines = torch.tensor([[0.004, 0.003]], dtype=torch.float64)
    a = torch.tensor([[0.006, -0.002]], dtype=torch.float64)
    one, other = Camera(tilted, 0.02), Camera(scene, 0.02)
    (got, twin, opposite), want = one(torch.cat([sines, -2 * a - sines, -sines])), other(sines + a)[0]
    peak = float(want.max())
    # What is left is the probe's picture, foreshortened by the cosine of another tilt.
    validated(SECTION, "Tilted by a: image", (got - want).abs().max() / peak, 1e-3, "straight, at the tilt s + a")
    validated(
        SECTION, "Tilted by a: image", (got - twin).abs().max() / peak, 7e-3, "itself at -2a - s, to 1/Fresnel number"
    )
    assert float((got - opposite).abs().max()) > 0.05 * peak


def test_a_decentred_array_is_the_array_moved(validated: Validated) -> None:
    array = PixelArray(fill=0.5)
    one = TargetSensor(1.0, (649, 487), PITCH, array)
    d = (11e-6, -7e-6)
    plane = reflectance_at(one, WAVELENGTH)
    got = by_orders(replace(one, decentre=d), TILT)
    want = by_samples(lambda x, y: plane(x + d[0], y + d[1]), TILT, 0.0, PITCH / 5)
    against = "the array sampled at u + d, double pass by grids"
    validated(SECTION, "Decentre (11, -7) um, photosites of 30 um: complex field", apart(got, want), 1e-3, against)
    assert apart(by_orders(one, TILT), want) > 0.02
    # Orders of a moved lattice turn by its place, and by nothing else.
    for still, moved in zip(
        orders_of(one, WAVELENGTH, 0.05), orders_of(replace(one, decentre=d), WAVELENGTH, 0.05), strict=True
    ):
        turn = complex(phasor(torch.tensor(K * (still.direction[0] * d[0] + still.direction[1] * d[1])).double()))
        assert moved.amplitude == pytest.approx(still.amplitude * turn, abs=1e-7)


def shifted_plane(sensor: TargetSensor, place: tuple[float, float]) -> Mask:
    """One cell drawn with its lens moved as at the place, and what of it turns slowly enough to be sampled."""
    assert sensor.microlens is not None and sensor.array is not None
    lens, p, n, most = sensor.microlens, sensor.pitch, 360, 2
    u = ((torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5) * p
    site = u.abs() < p * math.sqrt(sensor.array.fill) / 2
    across, down = (torch.remainder(u + lens.shift * at + p / 2, p) - p / 2 for at in place)
    square = (across[None, :] ** 2 + down[:, None] ** 2).clamp_max((lens.fill * p / 2) ** 2)
    cell = phasor(-K / lens.focal_length * square) * (site[:, None] & site[None, :])
    turns = 2 * math.pi / p * torch.arange(-most, most + 1, dtype=torch.float64)
    kernel = phasor(-turns[:, None] * u) / n
    found = kernel @ cell @ kernel.T

    def mask(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return phasor(y[..., :, None] * turns) @ found @ phasor(x[..., None, :] * turns[:, None])

    return mask


def test_a_microlens_shift_is_a_sampled_plane_with_its_lenses_moved(validated: Validated) -> None:
    one = TargetSensor(1.0, (649, 487), PITCH, PixelArray(fill=0.5), Microlens(150e-6, 0.95, 0.02))
    z, _ = lens_numbers(FOCAL, FOCUSED)
    place = z * float(TILT[0]), z * float(TILT[1])
    got, want = by_orders(one, TILT), by_samples(shifted_plane(one, place), TILT, 0.0, PITCH / 5)
    what = f"Shift 0.02, spot {1e6 * math.hypot(*place):.0f} um from the middle: complex field"
    validated(SECTION, what, apart(got, want), 1e-2, "a cell drawn as at the spot, sampled, double pass by grids")
    assert one.microlens is not None
    still = by_orders(replace(one, microlens=replace(one.microlens, shift=0.0)), TILT)
    assert apart(still, want) > 0.1


def test_the_series_is_the_shifted_cell(validated: Validated) -> None:
    """Amplitudes at a place against sums over one cell with its lens moved, drawn afresh; a Bayer cell is two wide."""
    p, shift, place = 2.2e-6, 0.01, (45e-6, -30e-6)
    for bayer in (None, (1.0, 0.5, 0.4, 0.1)):
        lens = Microlens(6e-6, 0.9, shift)
        one = TargetSensor(
            0.3, (649, 487), p, PixelArray(fill=0.5, surround=0.2, bayer=bayer), lens, decentre=(1e-6, 0)
        )
        n, cells = 400, 1 if bayer is None else 2
        u = (torch.arange(n * cells, dtype=torch.float64) + 0.5) / n * p
        # Places on the sensor, from its upper left corner.
        w = [u - count * p / 2 for count in one.pixels]
        sites, moved = [], []
        for axis, at, d in zip(w, place, one.decentre, strict=True):
            far = torch.remainder(axis + p / 2, p) - p / 2
            sites.append(far.abs() < p * math.sqrt(0.5) / 2)
            from_lens = axis + shift * (at + d)
            moved.append(torch.remainder(from_lens + p / 2, p) - p / 2)
        site = torch.where(sites[1][:, None] & sites[0][None, :], 1.0, math.sqrt(0.2))
        square = (moved[0][None, :] ** 2 + moved[1][:, None] ** 2).clamp_max((0.45 * p) ** 2)
        plane = math.sqrt(0.3) * site * phasor(-K / 6e-6 * square)
        if bayer is not None:
            tiles = torch.tensor(bayer, dtype=torch.float64).sqrt().reshape(2, 2)
            plane = plane * tiles.repeat_interleave(n, 0).repeat_interleave(n, 1)
        error = 0.0
        for order in orders_of(one, WAVELENGTH, 3.01 * WAVELENGTH / p):
            x, y = w[0] - one.decentre[0], w[1] - one.decentre[1]
            across, down = (phasor(-K * tau * at) / len(at) for tau, at in zip(order.direction, (x, y), strict=True))
            got = order.at(torch.tensor([place], dtype=torch.float64))
            assert isinstance(got, torch.Tensor)
            error = max(error, abs(complex(down @ plane @ across) - complex(got[0])))
        case = "Bayer" if bayer else "photosites"
        validated(SECTION, f"Shift 0.01, {case} of 2.2 um: amplitudes", error, 3e-3, "sums over a drawn cell", "of 1")


def test_no_shift_is_the_plain_array() -> None:
    plain = TargetSensor(1.0, (648, 486), 2.2e-6, PixelArray(fill=0.5), Microlens(6e-6, 0.9))
    tiny = replace(plain, microlens=Microlens(6e-6, 0.9, 1e-12))
    at = torch.tensor([[1e-3, -1e-3]], dtype=torch.float64)
    moved = {order.direction: order for order in orders_of(tiny, WAVELENGTH, 0.6)}
    for order in orders_of(plain, WAVELENGTH, 0.6):
        assert complex(torch.as_tensor(moved[order.direction].at(at))[0]) == pytest.approx(order.amplitude, abs=1e-3)


@pytest.mark.parametrize("lens", [None, {"kind": "prescription", "name": "la1509"}])
def test_gaze_counts_from_the_middle_of_the_sensor(lens: dict[str, object] | None) -> None:
    base = with_values(load_scene("thin-lens"), {"target.sensor.pixels": [300, 220]})
    base = base if lens is None else with_values(base, {"target.lens": lens})
    d = torch.tensor([20e-6, -30e-6], dtype=torch.float64)
    scene = with_values(base, {"target.sensor": {"decentre": d.tolist(), "pixels": [300, 220]}})
    gaze = torch.tensor([[0.0, 0.0], [0.1, -0.05]], dtype=torch.float64)
    sines = tilt_of_gaze(scene, gaze)
    assert torch.allclose(gaze_of(scene, sines), gaze, atol=1e-9)
    field = torch.tensor(base.target.sensor.pixels, dtype=torch.float64) * base.target.sensor.pitch
    assert torch.allclose(gaze_of(base, sines), gaze - d / field, atol=1e-9)
    assert torch.allclose(gaze_of(scene, torch.zeros(1, 2).double())[0], d / field, atol=1e-9)
    assert torch.allclose(point_of_symmetry(scene), d / field, atol=1e-9)


def test_the_sign_behind_a_tilted_sensor() -> None:
    """Against the opposite about the field's middle it is plain; about the point of symmetry it is as without tilt."""
    far = {"target.object_distance": math.inf, "illumination": {"mode": "collimated", "power": 2e-7}}
    scene = with_values(load_scene("thin-lens"), far)
    tilted = with_values(scene, {"target.sensor": {"tilt": [0.004, 0.0]}})
    gaze, centre = torch.tensor([[0.2, 0.1]], dtype=torch.float64), point_of_symmetry(tilted)
    assert centre.tolist() == pytest.approx([-0.004 * 0.1 / (648 * 8.8e-6), 0.0])
    plain, about_axis = sign_dprime(scene, gaze, accuracy=1e-3), sign_dprime(tilted, gaze, accuracy=1e-3)
    about_symmetry = sign_dprime(tilted, gaze + centre, accuracy=1e-3, centre=centre)
    assert float(about_axis[0]) > 5 * float(plain[0])
    assert float(about_symmetry[0]) == pytest.approx(float(plain[0]), rel=0.1, abs=0.1)


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ({"tilt": ["20 deg", 0]}, r"sensor\.tilt"),
        ({"decentre": ["4 mm", 0]}, "off the sensor along x"),
        ({"microlens": {"focal_length": "3 um", "shift": 0.2}}, r"microlens\.shift"),
        ({"tilt": ["1 deg", 0], "mask": {"file": "a.npy", "pitch": "1 um"}}, "a mask is not tilted by itself"),
    ],
)
def test_refusals(sensor: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        with_values(load_scene("thin-lens"), {"target.sensor": sensor})
