"""Tilted planes against a tilted plane wave, exact beams, direct quadrature and the operator's own symmetries."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from tapetum.errors import InputError
from tapetum.optics import tilted
from tapetum.optics.fourier import MatrixFourier, phasor
from tapetum.optics.grid import Grid
from tapetum.optics.propagate import angular_spectrum, flux
from tapetum.optics.tilted import TiltedPlane, far_field_on_tilted, tilt_directions

SECTION = "Tilted planes"
WAVELENGTH = 640e-9
K = 2 * math.pi / WAVELENGTH


def places(grid: Grid) -> tuple[torch.Tensor, torch.Tensor]:
    """x and y of every sample, [rows, columns] both."""
    return grid.x()[None, :].expand(grid.shape), grid.y()[:, None].expand(grid.shape)


def points(grid: Grid, angle: float, axis: str = "x", distance: float = 0.0) -> tuple[torch.Tensor, ...]:
    """x, y, z in the untilted frame of the samples on a tilted plane."""
    x, y = places(grid)
    if axis == "x":
        return x, y * math.cos(angle), distance + y * math.sin(angle)
    return x * math.cos(angle), y, distance + x * math.sin(angle)


def difference(ours: torch.Tensor, other: torch.Tensor) -> float:
    """Largest distance of two complex fields, in fractions of the second one's peak."""
    return float((ours - other).detach().abs().max() / other.detach().abs().max())


def wave(grid: Grid, sines: tuple[float, float]) -> torch.Tensor:
    """exp(ik(s_x x + s_y y))."""
    x, y = places(grid)
    return phasor(K * (sines[0] * x + sines[1] * y))


def aperture(grid: Grid, radius: float, bend: float = 3.0) -> torch.Tensor:
    """A soft-edged, off-centre, aberrated complex field without symmetry, within `radius` (effectively)."""
    x, y = places(grid)
    u, v = (x - 0.1 * radius) / radius, (y + 0.07 * radius) / radius
    return torch.exp(-9 * (u**2 + v**2)) * (1 + 0.5 * u - 0.3 * v * u) * phasor(bend * (u**2 - 0.6 * v + u * v**2))


def beam(at: tuple[torch.Tensor, ...], sines: tuple[float, float], waist: float, past: float) -> torch.Tensor:
    """A Gaussian beam along `sines` whose waist lies `past` metres before the origin, at points x, y, z, exactly.

    A point source at a complex place (Deschamps, Electron. Lett. 7, 684 (1971)) solves the wave equation without the
    paraxial approximation.
    """
    x, y, z = at
    along = sines[0] * x + sines[1] * y + math.sqrt(1 - sines[0] ** 2 - sines[1] ** 2) * z
    b, far = K * waist**2 / 2, along + past
    squared = x**2 + y**2 + z**2 - along**2 + far**2
    root = -1j * torch.sqrt(torch.complex(b**2 - squared, 2 * far * b))
    return -1j * b / root * torch.exp(1j * K * (root + 1j * b))


def paraxial_beam(at: tuple[torch.Tensor, ...], sines: tuple[float, float], waist: float, past: float) -> torch.Tensor:
    """The same beam by the textbook's paraxial form."""
    x, y, z = at
    along = sines[0] * x + sines[1] * y + math.sqrt(1 - sines[0] ** 2 - sines[1] ** 2) * z
    stretch = 1 + 1j * (along + past) / (K * waist**2 / 2)
    return torch.exp(-(x**2 + y**2 + z**2 - along**2) / (waist**2 * stretch)) / stretch * phasor(K * (along + past))


def softly(coordinate: torch.Tensor, half: float, edge: float) -> torch.Tensor:
    """One inside ±half, zero outside, falling over `edge`."""
    return (torch.erf((coordinate + half) / edge) - torch.erf((coordinate - half) / edge)) / 2


def test_a_tilted_plane_wave(validated: Callable[..., None]) -> None:
    # Soft-edged windows 120 samples wide; in their middle the wave is a plane one. Nothing is taken out of the field,
    # or, in the last case, a carrier 3 degrees beside it.
    worst = 0.0
    for axis, degrees, pitch, out in (
        ("x", 1.0, 9e-6, None),
        ("y", 1.0, 9e-6, None),
        ("x", -20.0, 0.6e-6, None),
        ("y", 35.0, 0.4e-6, None),
        ("y", 50.0, 0.8e-6, 47.0),
    ):
        theta = math.radians(degrees)
        grid, output = Grid(200, 200, pitch), Grid(21, 21, pitch)
        x, y = places(grid)
        window = softly(x, 60 * pitch, 12 * pitch) * softly(y, 60 * pitch, 12 * pitch)
        carrier = None if out is None else (math.sin(math.radians(out)), 0.0)
        sine = math.sin(theta) - (carrier or (0.0,))[0]
        field = window * wave(grid, (0.0, sine) if axis == "x" else (sine, 0.0))
        # On the plane normal to the wave, and on one 5 degrees from there.
        for angle in (-theta, -theta + math.radians(5) * math.copysign(1, theta) * (pitch < 1e-6)):
            plane = TiltedPlane(grid, WAVELENGTH, angle, axis, output, carrier=carrier)
            seen = math.sin(theta + angle) - plane.output_carrier[axis == "x"]
            exact = wave(output, (0.0, seen) if axis == "x" else (seen, 0.0))
            worst = max(worst, difference(plane(field), exact))
    what = "plane wave at 1, -20, 35 and 50 degrees about x or y, on the plane normal to it and 5 degrees off"
    validated(SECTION, what, worst, 1e-6, "closed form: constant, and exp(iky' sin(θ + angle))")


BEAMS = [
    # waist, pitch, samples, degrees, sines of the beam, output, distance, waist's place
    (6e-6, 0.8e-6, 96, 20.0, (0.0, 0.0), None, 0.0, 0.0),
    (6e-6, 0.8e-6, 96, 20.0, (0.0, -0.342), None, 0.0, 0.1e-3),
    (6e-6, 0.8e-6, 96, -40.0, (0.1, 0.3), Grid(100, 90, 0.7e-6, (3e-6, 5e-6)), 20e-6, 0.1e-3),
    (6e-6, 0.8e-6, 96, 70.0, (0.0, 0.0), Grid(300, 96, 0.8e-6), 0.0, 0.0),
    (60e-6, 8e-6, 96, 1.0, (0.0, -math.sin(math.radians(1))), None, 0.0, 5e-3),
]


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize(("waist", "pitch", "samples", "degrees", "sines", "output", "distance", "past"), BEAMS)
def test_a_gaussian_beam(
    axis: str,
    waist: float,
    pitch: float,
    samples: int,
    degrees: float,
    sines: tuple[float, float],
    output: Grid | None,
    distance: float,
    past: float,
    validated: Callable[..., None],
) -> None:
    angle, grid = math.radians(degrees), Grid(samples, samples, pitch)
    output = output or grid
    if axis == "y":
        sines = (sines[1], sines[0])
        output = Grid(output.columns, output.rows, output.pitch, (output.centre[1], output.centre[0]))
    plane = TiltedPlane(grid, WAVELENGTH, angle, axis, output, carrier=sines, distance=distance)
    field = beam(points(grid, 0.0), sines, waist, past) * wave(grid, sines).conj()
    ours = plane(field)
    cosine = math.sqrt(1 - sines[0] ** 2 - sines[1] ** 2)
    left_out = wave(output, plane.output_carrier) * phasor(torch.tensor(K * cosine * distance, dtype=torch.float64))
    exact = beam(points(output, angle, axis, distance), sines, waist, past) * left_out.conj()
    what = f"Gaussian beam (waist {waist * 1e6:g} um, sines {sines[0]:.3g}, {sines[1]:.3g}) on a plane {degrees:g} deg "
    what += f"about {axis}, {distance * 1e6:g} um on, its carrier out; phase included"
    validated(SECTION, what, difference(ours, exact), 1e-9, "exact beam of a complex point source")
    power = float(flux(ours, output, WAVELENGTH, plane.output_carrier) / flux(field, grid, WAVELENGTH, sines))
    what = f"power through a plane {degrees:g} deg about {axis} (waist {waist * 1e6:g} um)"
    validated(SECTION, what, abs(power - 1), 1e-8, "power through the untilted plane", measure="of it")


def test_the_carrier_may_stay_in() -> None:
    # The same light with and without the carrier; with it, the samples have to be finer.
    fine, angle, sines = Grid(180, 180, 0.4e-6), math.radians(20), (0.05, -0.25)
    field = beam(points(fine, 0.0), sines, 6e-6, 20e-6)
    whole = TiltedPlane(fine, WAVELENGTH, angle)(field)
    plane = TiltedPlane(fine, WAVELENGTH, angle, carrier=sines)
    taken = plane(field * wave(fine, sines).conj()) * wave(fine, plane.output_carrier)
    assert difference(whole, taken) < 1e-9
    assert plane.output_carrier[1] == pytest.approx(
        math.sin(math.asin(-0.25 / math.sqrt(1 - 0.05**2)) + angle) * math.sqrt(1 - 0.05**2)
    )
    with pytest.raises(InputError, match=r"output.pitch: .* take the carrier out"):
        TiltedPlane(Grid(60, 60, 1.2e-6), WAVELENGTH, angle)(field[::3, ::3])


def test_a_paraxial_beam_at_one_degree(validated: Callable[..., None]) -> None:
    grid, angle, waist = Grid(128, 128, 24e-6), math.radians(1), 0.3e-3
    sines = (0.0, -math.sin(angle))
    at = points(grid, 0.0)
    plane = TiltedPlane(grid, WAVELENGTH, angle, carrier=sines)
    ours = plane(paraxial_beam(at, sines, waist, 0.3) * wave(grid, sines).conj())
    exact = paraxial_beam(points(grid, angle), sines, waist, 0.3) * wave(grid, plane.output_carrier).conj()
    what = "Gaussian beam (waist 0.3 mm, 0.3 m past it) at 1 deg, on the plane normal to it"
    # The textbook's beam is a solution of the paraxial equation only, to (λ/(π waist))² = 5e-7 of the phase.
    validated(SECTION, what, difference(ours, exact), 1e-6, "paraxial closed form")


def rayleigh_sommerfeld(field: torch.Tensor, source: Grid, at: tuple[torch.Tensor, ...]) -> torch.Tensor:
    """First Rayleigh-Sommerfeld integral at points x, y, z, summed point by point."""
    x, y = places(source)
    out = []
    for u, v, z in zip(*(a.flatten() for a in at), strict=True):
        r = ((u - x) ** 2 + (v - y) ** 2 + z**2).sqrt()
        out.append(((1 / r - 1j * K) * z / r**2 * torch.exp(1j * K * r) * field).sum() * source.pitch**2)
    return torch.stack(out).reshape(at[0].shape) / (2 * math.pi)


@pytest.mark.parametrize(("degrees", "axis"), [(30.0, "x"), (-30.0, "x"), (55.0, "y")])
def test_the_rayleigh_sommerfeld_integral(degrees: float, axis: str, validated: Callable[..., None]) -> None:
    angle, distance = math.radians(degrees), 80e-6
    grid, output = Grid(64, 60, 0.8e-6), Grid(21, 23, 1.7e-6, (3e-6, -4e-6))
    field = aperture(grid, 17e-6)
    # The output's pitch holds the beam once its carrier is out.
    plane = TiltedPlane(grid, WAVELENGTH, angle, axis, output, carrier=(0.0, 0.0), distance=distance)
    exact = rayleigh_sommerfeld(field, grid, points(output, angle, axis, distance))
    left_out = wave(output, plane.output_carrier) * phasor(torch.tensor(K * distance, dtype=torch.float64))
    what = f"aberrated aperture 34 um wide on a plane {degrees:g} deg about {axis}, 80 um on"
    error = difference(plane(field), exact * left_out.conj())
    validated(SECTION, what, error, 1e-5, "Rayleigh-Sommerfeld integral, summed")


def test_at_no_angle_it_is_the_angular_spectrum() -> None:
    grid, output = Grid(64, 60, 1e-6), Grid(40, 41, 0.9e-6, (2e-6, 1e-6))
    field = aperture(grid, 20e-6)
    there = angular_spectrum(field, grid, WAVELENGTH, 90e-6, output)
    assert difference(TiltedPlane(grid, WAVELENGTH, 0.0, output=output, distance=90e-6)(field), there) < 1e-6
    assert difference(TiltedPlane(grid, WAVELENGTH, 0.0)(field), field) < 1e-8


@pytest.mark.parametrize(("degrees", "axis"), [(1.0, "x"), (-25.0, "x"), (60.0, "y")])
def test_there_and_back(degrees: float, axis: str, validated: Callable[..., None]) -> None:
    pitch = 5e-6 if abs(degrees) < 5 else 1e-6
    grid, angle = Grid(80, 72, pitch), math.radians(degrees)
    wide = Grid(240, 240, pitch)
    field = aperture(grid, 27 * pitch, bend=1.0)
    there = TiltedPlane(grid, WAVELENGTH, angle, axis, wide, carrier=(0.05, -0.02))
    back = TiltedPlane(wide, WAVELENGTH, -angle, axis, grid, carrier=there.output_carrier)
    assert back.output_carrier == pytest.approx((0.05, -0.02), abs=1e-14)
    error = difference(back(there(field)), field)
    what = f"aberrated field turned by {degrees:g} deg about {axis} and back"
    validated(SECTION, what, error, 1e-6, "the field itself")


@pytest.mark.parametrize("axis", ["x", "y"])
def test_adjoint_by_the_dot_product(axis: str, validated: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    grid, output = Grid(20, 24, 2e-6), Grid(18, 22, 1.9e-6, (3e-6, 1e-6))
    generator = torch.Generator().manual_seed(2)
    a = torch.randn(2, *grid.shape, generator=generator, dtype=torch.complex128)
    b = torch.randn(2, *output.shape, generator=generator, dtype=torch.complex128)
    settings: dict[str, Any] = {"axis": axis, "output": output, "carrier": (0.02, 0.1), "distance": 30e-6, "leak": 1.0}
    plane = TiltedPlane(grid, WAVELENGTH, 0.3, **settings)
    forward = torch.vdot(b.flatten(), plane(a).flatten())
    back = torch.vdot(plane.adjoint(b).flatten(), a.flatten())
    error = abs(forward - back) / abs(forward)
    validated(SECTION, f"adjoint, about {axis}, by the dot product", error, 1e-10, "the operator", measure="of it")
    # Kernels too large to keep are formed in pieces, to the same result.
    monkeypatch.setattr(tilted, "KEPT_BYTES", 20_000)
    pieces = TiltedPlane(grid, WAVELENGTH, 0.3, **settings)
    assert plane._kept is not None and pieces._kept is None
    assert difference(pieces(a), plane(a)) < 1e-13
    assert difference(pieces.adjoint(b), plane.adjoint(b)) < 1e-13


def test_gradients_and_batches_pass_through() -> None:
    grid = Grid(8, 7, 2e-6)
    plane = TiltedPlane(grid, WAVELENGTH, 0.1, "y", carrier=(0.0, 0.0), leak=1.0)
    generator = torch.Generator().manual_seed(9)
    fields = torch.randn(2, 1, 8, 7, generator=generator, dtype=torch.complex128, requires_grad=True)
    assert torch.autograd.gradcheck(plane, (fields,))
    assert difference(plane(fields)[1, 0], plane(fields[1, 0])) < 1e-12
    single = TiltedPlane(grid, WAVELENGTH, 0.1, "y", carrier=(0.0, 0.0), leak=1.0, dtype=torch.complex64)
    assert difference(single(fields).to(torch.complex128), plane(fields)) < 3e-6


def test_opposite_angles_mirror_each_other(validated: Callable[..., None]) -> None:
    grid = Grid(64, 64, 2e-6)
    field = aperture(grid, 45e-6)
    one = TiltedPlane(grid, WAVELENGTH, 0.2, carrier=(0.01, 0.05))(field)
    other = TiltedPlane(grid, WAVELENGTH, -0.2, carrier=(0.01, -0.05))(field.flip(-2)).flip(-2)
    validated(SECTION, "tilt by -0.2 rad of the mirrored field", difference(other, one), 1e-11, "mirrored tilt by 0.2")
    # A tilt about y is one about x with the two coordinates exchanged.
    turned = TiltedPlane(grid, WAVELENGTH, 0.2, "y", carrier=(0.05, 0.01))(field.mT).mT
    assert difference(turned, one) < 1e-12


@pytest.mark.parametrize(
    ("degrees", "axis", "sines"), [(2.0, "x", None), (30.0, "x", (0.05, -0.4)), (-45.0, "y", (0.0, 0.0))]
)
def test_the_map_of_directions(
    degrees: float, axis: str, sines: tuple[float, float] | None, validated: Callable[..., None]
) -> None:
    # Spectrum of the tilted field, by its Fourier integral, against the map applied to the untilted field.
    angle, grid, wide = math.radians(degrees), Grid(70, 72, 1e-6), Grid(160, 164, 0.9e-6)
    field = aperture(grid, 25e-6)
    plane = TiltedPlane(grid, WAVELENGTH, angle, axis, wide, carrier=sines)
    sx, sy = (torch.linspace(-0.06, 0.07, n, dtype=torch.float64) for n in (15, 17))
    if sines is None:
        sy = sy + math.sin(angle)
    mapped = far_field_on_tilted(field, grid, WAVELENGTH, angle, sx, sy, axis, carrier=sines)
    direct = MatrixFourier(wide.x(), wide.y(), sx, sy, K)(plane(field)) * wide.pitch**2
    carrier = "carrier in" if sines is None else f"carrier ({sines[0]:g}, {sines[1]:g}) out"
    what = f"map of directions at {degrees:g} deg about {axis}, {carrier}, complex spectrum"
    validated(SECTION, what, difference(mapped, direct), 1e-6, "Fourier integral of the tilted field")


def test_the_map_keeps_the_power_and_its_own_inverse() -> None:
    grid, angle, sines = Grid(64, 64, 2e-6), 0.5, (0.02, -0.3)
    field = aperture(grid, 45e-6)
    axis = torch.linspace(-0.12, 0.12, 241, dtype=torch.float64)
    spectrum = far_field_on_tilted(field, grid, WAVELENGTH, angle, axis, axis, carrier=sines)
    far = TiltedPlane(grid, WAVELENGTH, angle, carrier=sines).output_carrier
    cosine = (1 - (axis[None, :] + far[0]) ** 2 - (axis[:, None] + far[1]) ** 2).sqrt()
    power = (spectrum.abs() ** 2 * cosine).sum() * (0.001 / WAVELENGTH) ** 2
    assert float(power / flux(field, grid, WAVELENGTH, sines)) == pytest.approx(1, abs=1e-8)
    x, y, jacobian = tilt_directions(axis[None, :], axis[:, None], angle)
    again_x, again_y, inverse = tilt_directions(x, y, -angle)
    assert torch.allclose(again_x, axis[None, :].expand(241, 241)) and torch.allclose(
        again_y, axis[:, None].expand(241, 241)
    )
    assert torch.allclose(jacobian * inverse, torch.ones(()).double())


def test_refuses_bad_arguments() -> None:
    grid = Grid(16, 16, 2e-6)
    for change, where in (
        ({"angle": math.pi / 2}, "angle"),
        ({"angle": math.nan}, "angle"),
        ({"axis": "z"}, "axis"),
        ({"wavelength": 0.0}, "wavelength"),
        ({"distance": math.inf}, "distance"),
        ({"carrier": (0.8, 0.7)}, "carrier"),
        ({"carrier": (0.0, 0.99), "angle": 0.5}, "carrier"),
        ({"grid": Grid(1, 16, 2e-6)}, "grid"),
        ({"leak": math.nan}, "leak"),
        ({"band": 1.5, "carrier": (0.0, 0.0)}, "band"),
    ):
        arguments: dict[str, Any] = {"grid": grid, "wavelength": WAVELENGTH, "angle": 0.1} | change
        with pytest.raises(InputError, match=f"^{where}"):
            TiltedPlane(**arguments)
    with pytest.raises(InputError, match=r"^field"):
        TiltedPlane(grid, WAVELENGTH, 0.01)(torch.ones(8, 8))


def test_refuses_what_would_alias_or_evanesce() -> None:
    coarse, coarser = Grid(32, 32, 10e-6), Grid(32, 32, 12e-6)
    # At 10 degrees the light has a fringe every 3.7 um on the tilted plane.
    with pytest.raises(InputError, match=r"output.pitch: 1e-05 m .* 10 degrees .* carrier"):
        TiltedPlane(coarse, WAVELENGTH, math.radians(10))
    # With the carrier out it fits, but not the whole of the source's band.
    with pytest.raises(InputError, match=r"output.pitch: .* cannot hold the band 1.0"):
        TiltedPlane(coarse, WAVELENGTH, 0.2, output=coarser, carrier=(0.0, 0.0), band=1.0)
    noise = torch.randn(32, 32, generator=torch.Generator().manual_seed(1), dtype=torch.complex128)
    with pytest.raises(InputError, match=r"field: has .* of its power outside the band"):
        TiltedPlane(coarse, WAVELENGTH, 0.2, output=coarser, carrier=(0.0, 0.0))(noise)
    # Evanescent waves, and waves that meet the tilted plane from behind.
    with pytest.raises(InputError, match=r"band: 1.0 holds waves"):
        TiltedPlane(Grid(32, 32, 0.3e-6), WAVELENGTH, 0.1, carrier=(0.0, 0.0), band=1.0)
    with pytest.raises(InputError, match=r"band: 0.8 holds waves"):
        TiltedPlane(Grid(32, 32, 0.5e-6), WAVELENGTH, 1.3, carrier=(0.0, 0.0), band=0.8)
    with pytest.raises(InputError, match=r"output: .* more than 8192"):
        TiltedPlane(Grid(32, 32, 1e-6), WAVELENGTH, 0.1, output=Grid(32, 32, 1e-3), carrier=(0.0, 0.0), band=1e-4)
    grid, axis = Grid(32, 32, 10e-6), torch.linspace(-0.1, 0.1, 5, dtype=torch.float64)
    with pytest.raises(InputError, match=r"directions: reach .* holds 0.032"):
        far_field_on_tilted(torch.ones(32, 32), grid, WAVELENGTH, 0.0, axis, axis)
    with pytest.raises(InputError, match="directions: some do not cross"):
        tilt_directions(torch.tensor([0.9]), torch.tensor([0.5]), 0.1)
