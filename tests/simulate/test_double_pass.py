"""The sampled double pass against closed forms, an independent radial method, LightPipes, and its own symmetries.

Closed forms are those of docs/conventions.md that hold for a thin lens before a mirror.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.special import j0, j1

from tapetum.bench import Scene, load_scene, with_values
from tapetum.optics.fourier import phasor
from tapetum.optics.grid import Grid, lens_numbers
from tapetum.optics.grid_sampling import plan_double_pass
from tapetum.optics.sampling import DoublePassGeometry, disc_overlap
from tapetum.simulate import Camera
from tapetum.simulate.double_pass import DoublePass

SECTION = "Double pass"
WAVELENGTH, PROBE_FOCAL = 640e-9, 0.2
K = 2 * math.pi / WAVELENGTH
Validated = Callable[..., None]


def passing(
    focal: float = 0.1,
    radius: float = 3e-3,
    distance: float = math.inf,
    *,
    sine: float = 0.0,
    output: Grid | None = None,
    accuracy: float = 1e-3,
    curvature: float = 0.0,
    dtype: torch.dtype = torch.complex128,
    mask: Callable[[torch.Tensor, torch.Tensor], torch.Tensor] | None = None,
    finest: float | None = None,
) -> DoublePass:
    """A double pass by its numbers."""
    output = output or Grid(64, 64, 4e-6)
    z, _ = lens_numbers(focal, distance)
    window = math.hypot(output.width, output.height) / 2
    geometry = DoublePassGeometry(WAVELENGTH, radius, focal, z, PROBE_FOCAL, window, sine, curvature)
    plan = plan_double_pass(geometry, accuracy, pixels=output.rows * output.columns, finest=finest)
    return DoublePass(geometry, plan, output, mask=mask, dtype=dtype)


def tilts(*degrees: tuple[float, float]) -> torch.Tensor:
    """Sines of tilts about y and about x."""
    return torch.sin(torch.deg2rad(torch.tensor(degrees, dtype=torch.float64)))


def exit_power(one: DoublePass, sines: torch.Tensor) -> torch.Tensor:
    """∫|U|² over the exit pupil, in the pupil's areas."""
    field, _, _ = one.exit_pupil(sines)
    inside = one.pupil.exit.abs() > 0
    density = torch.where(inside, field.abs() ** 2 / one.pupil.exit.abs().clamp_min(1e-30), torch.zeros(()).double())
    # The field carries the weights once and the constant of the last transform.
    scale = (WAVELENGTH * PROBE_FOCAL) ** 2
    return density.sum((1, 2)) * scale / (math.pi * one.geometry.radius**2)


def airy_error(focal: float, radius: float = 3e-3) -> float:
    """Largest difference of the focused field, head on, from Airy's, in fractions of its peak."""
    output = Grid(61, 61, 4e-6)
    field = passing(focal, radius, output=output, accuracy=6e-4).field(tilts((0, 0)))[0].numpy()
    q = np.hypot(*np.meshgrid(output.x().numpy(), output.y().numpy()))
    argument = np.maximum(K * radius * q / PROBE_FOCAL, 1e-12)
    peak = math.pi * radius**2 / (WAVELENGTH * PROBE_FOCAL)
    # In focus the returning pupil is the entering one, inverted, and 2z farther on: one phase for all.
    turned = field / np.exp(1j * np.angle(field[30, 30]))
    first_zero = 1.22 * WAVELENGTH * PROBE_FOCAL / (2 * radius)
    ring = np.abs(turned[30])[30:] ** 2
    assert output.x().numpy()[30:][np.argmin(ring[:12])] == pytest.approx(first_zero, abs=output.pitch)
    return float(np.abs(turned - peak * 2 * j1(argument) / argument).max() / peak)


def test_focused_head_on_is_an_airy_field(validated: Validated) -> None:
    """As far as the mirror is near: over the 2z there and back the edge diffracts, as 1/√(Fresnel number)."""
    near, far = airy_error(0.01), airy_error(0.1)
    what = "Focused, head on, f = {} mm, r = 3 mm: complex field"
    validated(SECTION, what.format(10), near, 0.01, "Airy's field; what differs is the edge diffracted over 2z")
    validated(SECTION, what.format(100), far, 0.03, "Airy's field; what differs is the edge diffracted over 2z")
    assert far / near == pytest.approx(math.sqrt(10), rel=0.25)


@pytest.mark.parametrize(("focal", "degrees"), [(0.02, 0.5), (0.02, 1.0), (0.1, 0.5)])
def test_returning_pupil_is_displaced_by_2z_tan(validated: Validated, focal: float, degrees: float) -> None:
    """PHYSICS: 0.349 and 0.698 mm for f = 20 mm. What leaves is the overlap, its middle half as far out."""
    radius = 2e-3
    one = passing(focal, radius, sine=math.sin(math.radians(degrees)))
    weights = one.exit_pupil(tilts((0, degrees)))[0][0].abs() ** 2 / one.pupil.exit.abs().clamp_min(1e-30)
    middle = float((weights * one.pupil.y[:, None]).sum() / weights.sum())
    shift = 2 * focal * math.tan(math.radians(degrees))
    what = f"Displacement of the returning pupil, f = {focal * 1e3:g} mm, {degrees:g} deg"
    validated(SECTION, what, abs(2 * middle / shift - 1), 0.03, "2z tan θ", "of the displacement")
    assert float((weights * one.pupil.x[None]).sum() / weights.sum()) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("degrees", [0.3, 0.8, 1.3])
def test_returned_power_is_the_overlap_of_two_discs(validated: Validated, degrees: float) -> None:
    focal, radius = 0.1, 3e-3
    one = passing(focal, radius, sine=math.sin(math.radians(degrees)))
    want = disc_overlap(radius, radius, 2 * focal * math.tan(math.radians(degrees)))
    error = abs(float(exit_power(one, tilts((0, degrees)))) - want)
    what = f"Returned power in focus, f = 100 mm, r = 3 mm, {degrees:g} deg"
    validated(SECTION, what, error, 0.01, "the area that two discs 2z tan θ apart share", "of the power that enters")


def test_nothing_returns_past_the_cut_off() -> None:
    focal, radius = 0.1, 3e-3
    cutoff = math.degrees(math.atan(radius / focal))
    one = passing(focal, radius, sine=math.sin(math.radians(1.2 * cutoff)))
    assert float(exit_power(one, tilts((0, 1.2 * cutoff)))) < 1e-3


def test_head_on_all_light_returns_and_none_is_made() -> None:
    for distance in (math.inf, 20.0):
        power = float(exit_power(passing(0.1, 3e-3, distance, accuracy=6e-4), tilts((0, 0))))
        # Light that the sharp edge diffracts past the aperture on the way back is lost.
        assert 0.96 < power < 1.001


def test_what_enters_the_probe_reaches_its_sensor() -> None:
    one = passing(0.05, 1.5e-3, output=Grid(200, 200, 6e-6))
    image = one(tilts((0, 0.2)))[0]
    on_sensor = float(image.sum()) * one.output.pitch**2 / (math.pi * one.geometry.radius**2)
    assert on_sensor == pytest.approx(float(exit_power(one, tilts((0, 0.2)))), rel=0.02)


@pytest.mark.parametrize("distance", [1.1, 2.6])
def test_exit_curvature(validated: Validated, distance: float) -> None:
    """A ray that entered at x leaves at -x (1 + 2 x_i/f) with slope 2 x x_i/f²: converging, 2/(x_d + f)."""
    want = 2 / (distance + 0.1)
    one = passing(0.1, 4e-3, distance, accuracy=6e-4)
    row = int(one.pupil.y.abs().argmin())
    inner = (one.pupil.x > 0) & (one.pupil.x < 2.5e-3)
    field = (one.exit_pupil(tilts((0, 0)))[0][0] / one.pupil.exit.abs().clamp_min(1e-30))[row, inner].numpy()
    slope = np.polyfit(one.pupil.x[inner].numpy() ** 2, np.unwrap(np.angle(field)), 1)[0]
    what = f"Curvature of the leaving wave, f = 100 mm, x_d = {distance:g} m"
    validated(SECTION, what, abs(-2 * slope / K / want - 1), 0.01, "2/(x_d + f)", "of the curvature")


def test_against_a_radial_method(validated: Validated) -> None:
    """Head on everything is round: three Hankel transforms by Gauss-Legendre quadrature, to 1e-3 of the peak."""
    focal, radius, distance = 0.1, 2e-3, 3.0
    output = Grid(41, 41, 10e-6)
    one = passing(focal, radius, distance, output=output, accuracy=6e-4)
    got = one.field(tilts((0, 0)))[0].numpy()[20]
    want = _radial(focal, radius, distance, np.abs(output.x().numpy()))
    error = np.abs(got - want).max() / np.abs(want).max()
    what = "Head on, f = 100 mm, r = 2 mm, x_d = 3 m: complex field"
    validated(SECTION, what, error, 1e-3, "three Hankel transforms by Gauss-Legendre quadrature")


def _radial(focal: float, radius: float, distance: float, q: np.ndarray) -> np.ndarray:
    z, excess = lens_numbers(focal, distance)
    rings, count = 200, 1600

    def nodes(upto: float, n: int) -> tuple[np.ndarray, np.ndarray]:
        x, w = np.polynomial.legendre.leggauss(n)
        return (x + 1) * upto / 2, w * upto / 2

    rho, rho_weight = nodes(radius, 500)
    defocus = np.exp(1j * K / 2 * (1 / z - 1 / focal) * rho**2) * rho * rho_weight
    v, v_weight = nodes(radius * excess / focal + rings * WAVELENGTH * z / (2 * radius), count)
    back = np.zeros(len(rho), complex)
    for part in np.array_split(np.arange(count), 12):
        kernel = j0(K / z * v[part, None] * rho)
        spot = kernel @ defocus * (2 * np.pi / (1j * WAVELENGTH * z))
        chirped = spot * np.exp(1j * K * v[part] ** 2 / z) * v[part] * v_weight[part]
        back += (chirped @ kernel) * (2 * np.pi / (1j * WAVELENGTH * z))
    image = j0(K / PROBE_FOCAL * q[:, None] * rho) @ (back * defocus)
    return image * (2 * np.pi / (1j * WAVELENGTH * PROBE_FOCAL))


# LightPipes' own error, from its binary edge and fixed grid, grows with defocus: hence the tolerances.
@pytest.mark.parametrize(("case", "tolerance"), [(0, 2e-3), (1, 4e-3), (2, 8e-3)])
def test_against_lightpipes(validated: Validated, case: int, tolerance: float) -> None:
    stored = np.load(Path(__file__).parents[1] / "references" / "lightpipes.npz", allow_pickle=False)
    want, pitch = stored["images"][case], float(stored["pitch"])
    degrees, distance = stored["cases"][case]
    side = want.shape[0]
    output = Grid(side, side, pitch, centre=(-pitch / 2, -pitch / 2))
    sine = math.sin(math.radians(degrees))
    got = passing(0.1, 3e-3, float(distance), sine=sine, output=output)(tilts((0, degrees)))[0].numpy()
    error = np.abs(got - want).max() / want.max()
    what = f"f = 100 mm, r = 3 mm, {degrees:g} deg, x_d = {distance:g} m: irradiance"
    validated(SECTION, what, error, tolerance, "LightPipes Forvard, N = 4096")
    if degrees:
        # The sign of the tilt is pinned: upside down the two do not agree at all.
        flipped = want[1:, 1:][::-1, ::-1]
        assert np.abs(got[1:, 1:] - flipped).max() > 0.2 * want.max()


def test_reciprocity(validated: Validated) -> None:
    """Swapping the ways in and out: I(q; s) = I(-q; s - q/f_p), exactly; point-symmetric it is in focus alone."""
    output = Grid(81, 81, 10e-6)
    one = passing(0.1, 3e-3, 5.0, sine=0.02, output=output, accuracy=6e-4)
    tilt = torch.tensor([[0.004, 0.009]], dtype=torch.float64)
    image, errors = one(tilt)[0], list[float]()
    for row, column in ((45, 38), (30, 55), (52, 52), (20, 44)):
        q = torch.stack([output.x()[column], output.y()[row]]) / PROBE_FOCAL
        other = one(tilt - q)[0]
        errors.append(float((image[row, column] - other[80 - row, 80 - column]).abs() / image.max()))
    what = "f = 100 mm, r = 3 mm, x_d = 5 m, tilt (0.004, 0.009): irradiance"
    validated(SECTION, what, max(errors), 1e-4, "reciprocity, I(q; s) = I(-q; s - q/f_p)")
    assert float((image - image.flip(0, 1)).abs().max()) > 0.01 * float(image.max())


def test_symmetries_of_a_round_lens() -> None:
    one = passing(0.1, 2e-3, 3.0, sine=0.01)
    up, down, right, diagonal, mirrored = one(tilts((0, 0.4), (0, -0.4), (0.4, 0), (0.2, 0.3), (0.3, 0.2)))
    peak = float(up.max())
    assert torch.allclose(up, down.flip(0), atol=1e-9 * peak)
    assert torch.allclose(up, up.flip(1), atol=1e-9 * peak)
    # The quadrature treats rows and columns differently: its error is what is left.
    assert torch.allclose(up, right.T, atol=1e-3 * peak)
    assert torch.allclose(diagonal, mirrored.T, atol=1e-3 * peak)


def _summed(one: DoublePass, pupil: torch.Tensor, shear: torch.Tensor) -> torch.Tensor:
    """Field on the pixels, sheared: of each pixel the sum over all of the exit pupil."""
    y, x = torch.meshgrid(one.output.y(), one.output.x(), indexing="ij")
    u, w = shear @ torch.stack([x.flatten(), y.flatten()])
    columns, rows = (
        phasor(-K / PROBE_FOCAL * torch.outer(at, axis)) for at, axis in ((u, one.pupil.x), (w, one.pupil.y))
    )
    return ((rows @ pupil) * columns).sum(-1).reshape(x.shape)


def test_foreshortening_in_any_direction(validated: Validated) -> None:
    """The fast way (QR factors), and the one for masks, against a plain sum over the exit pupil."""
    output = Grid(9, 9, 60e-6)
    one = passing(0.03, 2e-3, 0.4, sine=0.06, output=output)
    tilt = torch.tensor([[0.045, 0.04]], dtype=torch.float64)
    fast = one(tilt)[0]
    cosine = math.sqrt(1 - float((tilt**2).sum()))
    unit = tilt[0] / tilt[0].norm()
    matrix = torch.eye(2, dtype=torch.float64) - (1 - cosine) * unit[:, None] * unit[None, :]
    offset = 2 * K * tilt[0] / cosine
    assert one._spot is not None
    spot = one._spot * phasor(offset[0] * one._v[None, :] + offset[1] * one._v[:, None])
    to_pupil = [phasor(-K / one.pupil.z * torch.outer(axis, one._v)) for axis in (one.pupil.y, one.pupil.x)]
    # The lens takes in cosθ of the light, and sends it onto a picture foreshortened by cosθ.
    pupil = (to_pupil[0] @ spot[0] @ to_pupil[1].T) * one.pupil.exit * cosine

    def plain(shear: torch.Tensor) -> torch.Tensor:
        return _summed(one, pupil, shear).abs() ** 2

    peak, foreshortened = float(fast.max()), plain(matrix)
    what = "Foreshortened picture, tilt (0.045, 0.04): irradiance"
    validated(SECTION, what, (fast - foreshortened).abs().max() / peak, 1e-4, "a plain sum over the exit pupil")
    mirror = passing(0.03, 2e-3, 0.4, sine=0.06, output=output, mask=lambda x, y: torch.ones(len(x), 1, 1))
    masked = mirror(tilt)[0]
    validated(SECTION, f"{what}, the way of masks", (masked - foreshortened).abs().max() / peak, 1e-4, "the same")
    # A picture moved by its centre, as a second beam's is, keeps its shape.
    moved = torch.tensor([[2 * output.pitch, -3 * output.pitch]], dtype=torch.float64)
    what = f"{what}, 2 and 3 pixels aside"
    for way, one_pass, middle in (("", one, fast), (", the way of masks", mirror, masked)):
        aside = one_pass(tilt, moved)[0]
        apart = (aside[:-3, 2:] - middle[3:, :-2]).abs().max() / peak
        validated(SECTION, f"{what}{way}", apart, 1e-9, "the picture in the middle")
    # Without foreshortening the picture is another one: the test can fail.
    assert float((fast - plain(torch.eye(2, dtype=torch.float64))).abs().max()) > 1e-3 * peak


def test_single_precision_agrees_with_double(validated: Validated) -> None:
    for distance in (1.0, math.inf):
        both = [
            passing(0.1, 3e-3, distance, sine=0.02, dtype=d)(tilts((0.3, 0.6)))
            for d in (torch.complex64, torch.complex128)
        ]
        error = (both[0] - both[1]).abs().max() / both[1].max()
        what = f"complex64, f = 100 mm, r = 3 mm, x_d = {distance:g} m, tilt (0.3, 0.6) deg: irradiance"
        validated(SECTION, what, error, 1e-5, "complex128")


def test_a_mask_lies_in_the_sensors_own_coordinates(validated: Validated) -> None:
    """Any mask, under a tilt that foreshortens, in any direction: sums over the sensor and the pupil, term by term."""
    output = Grid(5, 4, 90e-6)

    def mask(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        u, w = x[:, None, :] / 20e-6, y[:, :, None] / 20e-6
        return (0.5 + 0.3 * torch.sin(u + 0.4 * w)) * phasor(torch.cos(0.7 * w - 0.2 * u))

    one = passing(0.01, 0.7e-3, 0.3, sine=0.06, output=output, mask=mask, finest=10e-6)
    tilt = torch.tensor([[0.045, 0.03]], dtype=torch.float64)
    cosine = math.sqrt(1 - float((tilt**2).sum()))
    got, (sx, sy) = one.field(tilt)[0], tilt[0] / cosine
    # The mirror's spot, its mask where the gaze puts it, and the pupil by the plain kernel.
    assert one._spot is not None
    seen = one._spot[0] * mask(one.pupil.z * sx + one._v[None, :], one.pupil.z * sy + one._v[None, :])[0]
    seen = seen * phasor(2 * K * (sx * one._v[None, :] + sy * one._v[:, None]))
    to_x, to_y = (phasor(-K / one.pupil.z * torch.outer(axis, one._v)) for axis in (one.pupil.x, one.pupil.y))
    pupil = torch.einsum("yv,vu,xu->yx", to_y, seen, to_x) * one.pupil.exit * cosine
    unit = tilt[0] / tilt[0].norm()
    matrix = torch.eye(2, dtype=torch.float64) - (1 - cosine) * unit[:, None] * unit[None, :]
    want = _summed(one, pupil, matrix)
    error = (got - want).abs().max() / want.abs().max()
    validated(SECTION, "A mask under the tilt (0.045, 0.03): complex field", error, 1e-9, "sums term by term")
    # Another gaze sees another piece of it.
    assert float((one(tilt)[0] - one(-tilt)[0].flip(0, 1)).abs().max()) > 0.05 * float(one(tilt).max())


def test_gradients_pass_a_mask() -> None:
    def mask(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return torch.sin(x[:, None, :] / 30e-6) * torch.cos(y[:, :, None] / 30e-6) + 1j * 0.3

    one = passing(0.02, 1e-3, 1.0, sine=0.03, output=Grid(6, 6, 30e-6), mask=mask, finest=20e-6, accuracy=1e-2)
    tilt = torch.tensor([[0.01, 0.02]], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(one(tilt)[0, 2, 3], tilt)
    step = torch.tensor([[1e-7, 0.0]], dtype=torch.float64)
    # Both with the cosine: without gradients the engine leaves it out where it moves nothing.
    both = [one(((tilt + sign * step).detach()).requires_grad_())[0, 2, 3].item() for sign in (1, -1)]
    assert float(slope[0, 0]) == pytest.approx((both[0] - both[1]) / 2e-7, rel=1e-5)


def test_a_batch_is_its_parts_and_centres_move_the_picture() -> None:
    one = passing(0.1, 2e-3, 4.0, sine=0.01)
    many = tilts((0, 0.1), (0.2, 0.3), (-0.4, 0.2))
    together = one(many)
    apart = torch.cat([one(many[i : i + 1]) for i in range(3)])
    assert torch.allclose(together, apart, atol=1e-9 * float(apart.max()))
    step = one.output.pitch
    moved = one(many, torch.tensor([[2 * step, -3 * step]] * 3, dtype=torch.float64))
    assert torch.allclose(moved[:, :-3, 2:], together[:, 3:, :-2], atol=1e-9 * float(apart.max()))


def beamed(**second: object) -> Scene:
    return with_values(
        load_scene("thin-lens"),
        {"illumination.second_beam": second, "probe.sensor.pixels": [200, 200], "object_distance": math.inf},
    )


def test_the_second_beam_lies_beside_and_sees_another_gaze() -> None:
    angle = (0.4e-3, 0.0)
    scene = beamed(ratio=0.25, angle=list(angle))
    camera = Camera(scene, 0.01, dtype=torch.complex128)
    tilt = torch.tensor([[0.002, 0.003]], dtype=torch.float64)
    both = camera(tilt)[0]
    ideal = replace(scene, illumination=replace(scene.illumination, second_beam=None))
    alone = Camera(ideal, 0.01, dtype=torch.complex128)
    place = torch.tensor([[-PROBE_FOCAL * math.tan(angle[0]), 0.0]], dtype=torch.float64)
    second = alone(tilt + torch.tensor([[math.sin(angle[0]), 0.0]]), place)[0]
    assert torch.allclose(both, alone(tilt)[0] + 0.25 * second, atol=2e-3 * float(both.max()))
    columns = torch.arange(200, dtype=torch.float64) - 99.5
    offset = float((second.sum(0) * columns).sum() / second.sum()) * scene.probe.sensor.pitch
    # Displaced by -f_p tan δ, up to the RR's own asymmetry.
    assert offset == pytest.approx(-PROBE_FOCAL * angle[0], abs=0.25 * PROBE_FOCAL * angle[0])
