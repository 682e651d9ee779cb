"""Free-space propagation against closed forms, direct quadrature and two other packages, on complex fields."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import LightPipes
import numpy as np
import pytest
import torch
from scipy.special import fresnel as fresnel_cs
from scipy.special import j1

from tapetum.errors import InputError
from tapetum.optics.fourier import phasor
from tapetum.optics.grid import Grid
from tapetum.optics.propagate import angular_spectrum, flux, fresnel, suitable_method

SECTION = "Propagation"
WAVELENGTH = 640e-9
K = 2 * math.pi / WAVELENGTH


def places(grid: Grid) -> tuple[torch.Tensor, torch.Tensor]:
    """x as a row and y as a column."""
    return grid.x()[None, :], grid.y()[:, None]


def difference(ours: torch.Tensor, other: torch.Tensor) -> float:
    """Largest distance of two complex fields, in fractions of the second one's peak."""
    return float((ours - other).abs().max() / other.abs().max())


def without_global_phase(ours: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """`other` turned by the one phase that brings it closest to `ours`."""
    product = torch.vdot(other.flatten(), ours.flatten())
    return other * product / product.abs()


def smooth_aperture(grid: Grid, radius: float, bend: float = 3.0) -> torch.Tensor:
    """A soft-edged, off-centre, aberrated complex field without symmetry, within `radius` (effectively)."""
    x, y = places(grid)
    u, v = (x - 0.1 * radius) / radius, (y + 0.07 * radius) / radius
    return torch.exp(-9 * (u**2 + v**2)) * (1 + 0.5 * u - 0.3 * v * u) * phasor(bend * (u**2 - 0.6 * v + u * v**2))


def point_source_beam(grid: Grid, z: float, waist: float) -> torch.Tensor:
    """A Gaussian beam that solves the wave equation exactly: a point source at the complex place z = -ib.

    Deschamps, Electron. Lett. 7, 684 (1971); b = k waist²/2, and the field at the waist's middle is 1.
    """
    x, y = places(grid)
    b, squared = K * waist**2 / 2, x**2 + y**2 + z**2
    root = -1j * torch.sqrt(torch.complex(b**2 - squared, torch.full_like(squared, 2 * z * b)))
    return -1j * b / root * torch.exp(1j * K * (root + 1j * b - z))


def rayleigh_sommerfeld(field: torch.Tensor, source: Grid, distance: float, output: Grid) -> torch.Tensor:
    """First Rayleigh-Sommerfeld integral summed point by point, without the carrier."""
    x, y = places(source)
    u, v = places(output)
    rows = []
    for below in v[:, 0]:
        across = u[0, :, None, None] - x
        r = (across**2 + (below - y) ** 2 + distance**2).sqrt()
        kernel = (1 / r - 1j * K) * distance / r**2 * torch.exp(1j * K * (r - distance)) / (2 * math.pi)
        rows.append((kernel * field).sum((1, 2)) * source.pitch**2)
    return torch.stack(rows)


def rectangle(output: Grid, width: float, height: float, z: float) -> torch.Tensor:
    """Fresnel diffraction by a rectangle, by Fresnel integrals (Goodman, 3rd ed., section 4.5.1)."""

    def edge(u: torch.Tensor, size: float) -> np.ndarray:
        ends = (math.sqrt(2 / (WAVELENGTH * z)) * (s * size / 2 - u.numpy()) for s in (1, -1))
        (s1, c1), (s0, c0) = (fresnel_cs(end) for end in ends)
        return ((c1 - c0) + 1j * (s1 - s0)) / np.sqrt(2j)

    return torch.from_numpy(np.outer(edge(output.y(), height), edge(output.x(), width)))


@pytest.mark.parametrize("z", [0.05, 0.5])
def test_fresnel_of_a_rectangle(z: float, validated: Callable[..., None]) -> None:
    # Pixels whose edges are the rectangle's: the sum is the midpoint rule, its error falls with the pitch squared.
    source, output = Grid(640, 960, 1e-6), Grid(90, 110, 12e-6, (150e-6, -80e-6))
    ours = fresnel(torch.ones(source.shape), source, WAVELENGTH, z, output)
    exact = rectangle(output, source.width, source.height, z)
    what = f"Fresnel integral of a 0.96 x 0.64 mm rectangle after {z * 1e3:g} mm, complex field, off-centre output"
    validated(SECTION, what, difference(ours, exact), 1e-4, "Fresnel integrals C and S (SciPy)")


def disc(grid: Grid, radius: float) -> torch.Tensor:
    """The share of each pixel that a centred disc covers; rows in 32 strips, along each of which it is exact."""
    strips = torch.arange(32, dtype=torch.float64).add(0.5).div(32).sub(0.5) * grid.pitch
    half = (radius**2 - (grid.y()[:, None] + strips) ** 2).clamp_min(0).sqrt()
    left = (grid.x()[None, None, :] - grid.pitch / 2).clamp_min(-half[..., None])
    right = (grid.x()[None, None, :] + grid.pitch / 2).clamp_max(half[..., None])
    return (right - left).clamp_min(0).mean(1) / grid.pitch


def airy(output: Grid, radius: float, focal: float) -> torch.Tensor:
    """A round lens's focus, complex."""
    u, v = places(output)
    q = (u**2 + v**2).sqrt()
    reduced = (K * radius * q / focal).numpy()
    jinc = torch.from_numpy(np.where(reduced == 0, 1, 2 * j1(reduced) / np.where(reduced == 0, 1, reduced)))
    return -1j * math.pi * radius**2 / (WAVELENGTH * focal) * jinc * phasor(K * q**2 / (2 * focal))


def test_fresnel_of_a_lens_is_airys_pattern(validated: Callable[..., None]) -> None:
    radius, focal = 1e-3, 0.1
    source, output = Grid(700, 700, 3e-6), Grid(81, 81, 4e-6)
    x, y = places(source)
    lens = disc(source, radius) * phasor(-K * (x**2 + y**2) / (2 * focal))
    ours = fresnel(lens, source, WAVELENGTH, focal, output)
    what = "focus of a round lens (r = 1 mm, f = 100 mm), complex field over 5 rings"
    validated(SECTION, what, difference(ours, airy(output, radius, focal)), 1e-4, "Airy's closed form")


@pytest.mark.parametrize("z", [0.3, -0.3])
def test_fresnel_of_a_gaussian(z: float, validated: Callable[..., None]) -> None:
    waist = 0.15e-3
    source, output = Grid(280, 300, 6e-6, (0.0, 20e-6)), Grid(60, 70, 20e-6, (0.1e-3, -0.05e-3))
    x, y = places(source)
    u, v = places(output)
    rayleigh = K * waist**2 / 2
    stretch = 1 + 1j * z / rayleigh
    exact = torch.exp(-(u**2 + v**2) / (waist**2 * stretch)) / stretch
    ours = fresnel(torch.exp(-(x**2 + y**2) / waist**2), source, WAVELENGTH, z, output)
    what = f"Fresnel integral of a Gaussian beam (waist 0.15 mm) over {z:g} m, other grid"
    validated(SECTION, what, difference(ours, exact), 1e-9, "closed form")


@pytest.mark.parametrize(
    ("waist", "source", "z", "output"),
    [
        (4e-6, Grid(64, 64, 1e-6), 0.2e-3, None),
        (20e-6, Grid(128, 128, 2e-6), -3e-3, Grid(40, 50, 5e-6, (5e-6, -3e-6))),
        (2e-6, Grid(64, 64, 0.4e-6), 30e-6, None),
    ],
)
def test_angular_spectrum_of_a_gaussian(
    waist: float, source: Grid, z: float, output: Grid | None, validated: Callable[..., None]
) -> None:
    ours = angular_spectrum(point_source_beam(source, 0.0, waist), source, WAVELENGTH, z, output)
    exact = point_source_beam(output or source, z, waist)
    where = "the same grid" if output is None else "another grid"
    what = f"angular spectrum of a Gaussian beam (waist {waist * 1e6:g} um) over {z * 1e3:g} mm, {where}"
    validated(SECTION, what, difference(ours, exact), 1e-9, "exact beam of a complex point source")


def test_a_band_that_must_end_leaves_little(validated: Callable[..., None]) -> None:
    # The beam grows to three times the window: most of its light has to leave, and none may come back in.
    source, z, waist = Grid(64, 64, 1e-6), 2e-3, 4e-6
    ours = angular_spectrum(point_source_beam(source, 0.0, waist), source, WAVELENGTH, z)
    what = "angular spectrum of a Gaussian beam (waist 4 um) over 2 mm, grown to three windows"
    error = difference(ours, point_source_beam(source, z, waist))
    validated(SECTION, what, error, 1e-5, "exact beam of a complex point source")


def test_angular_spectrum_is_the_rayleigh_sommerfeld_integral(validated: Callable[..., None]) -> None:
    source, output, z = Grid(60, 64, 0.5e-6), Grid(21, 23, 0.85e-6, (1.5e-6, -2.5e-6)), 100e-6
    field = smooth_aperture(source, 10e-6)
    ours = angular_spectrum(field, source, WAVELENGTH, z, output)
    what = "angular spectrum of an aberrated aperture 20 um wide after 100 um, other grid"
    exact = rayleigh_sommerfeld(field, source, z, output)
    validated(SECTION, what, difference(ours, exact), 1e-8, "Rayleigh-Sommerfeld integral, summed")


def test_evanescent_waves_decay(validated: Callable[..., None]) -> None:
    # Structures of 0.4 wavelengths, half a wavelength away. What is left are the waves at grazing angles, which no
    # padding holds: at 2.6 times the padding the error is 1e-4.
    pitch, z = WAVELENGTH / 10, WAVELENGTH / 2
    source, output = Grid(60, 64, pitch), Grid(21, 23, 1.7 * pitch, (3 * pitch, -5 * pitch))
    field = smooth_aperture(source, 20 * pitch)
    exact = rayleigh_sommerfeld(field, source, z, output)
    ours = angular_spectrum(field, source, WAVELENGTH, z, output)
    what = "angular spectrum of an aperture 4 wavelengths wide after half a wavelength, evanescent waves included"
    validated(SECTION, what, difference(ours, exact), 2e-3, "Rayleigh-Sommerfeld integral, summed")
    # A grating of 0.8 wavelengths loses exp(-2πz sqrt(1/period² - 1/λ²)).
    grid, period = Grid(160, 160, pitch), 0.8 * WAVELENGTH
    x, y = places(grid)
    ripple = torch.exp(-((x**2 + y**2) / (3 * WAVELENGTH) ** 2)) * torch.cos(2 * math.pi * x / period)
    middle = angular_spectrum(ripple, grid, WAVELENGTH, 0.2 * WAVELENGTH)[79:81, 79:81].abs().mean()
    lost = math.exp(-2 * math.pi * 0.2 * math.sqrt(1 / 0.8**2 - 1))
    assert float(middle / ripple[79:81, 79:81].abs().mean()) == pytest.approx(lost, rel=0.05)


def test_both_methods_agree_where_light_is_paraxial(validated: Callable[..., None]) -> None:
    source, output, z = Grid(200, 200, 6e-6), Grid(60, 64, 15e-6, (40e-6, 25e-6)), 0.4
    field = smooth_aperture(source, 0.55e-3)
    ours, exact = (method(field, source, WAVELENGTH, z, output) for method in (fresnel, angular_spectrum))
    assert suitable_method(source, WAVELENGTH, z, output) == "fresnel"
    what = "Fresnel integral of an aberrated aperture 1.1 mm wide after 0.4 m"
    # The neglected phase k D⁴/8z³ is 1e-5 rad at this aperture.
    validated(SECTION, what, difference(ours, exact), 1e-4, "angular spectrum")


def test_the_grids_are_held_to_the_very_limit() -> None:
    # The shortest distance that is accepted: replicas of light over the whole band just miss the output.
    source, output = Grid(400, 400, 2e-6), Grid(50, 50, 6e-6, (30e-6, 0.0))
    separation = (source.width - 2e-6 + output.width - 6e-6) / 2 + 30e-6
    limit = 2 * separation * source.pitch / WAVELENGTH
    field = smooth_aperture(source, 0.3e-3, bend=20.0)
    ours = fresnel(field, source, WAVELENGTH, limit, output)
    assert difference(ours, angular_spectrum(field, source, WAVELENGTH, limit, output)) < 1e-4
    with pytest.raises(InputError, match=r"source.pitch: .* too coarse: .* angular_spectrum"):
        fresnel(field, source, WAVELENGTH, 0.99 * limit, output)


def test_there_and_back() -> None:
    source, wide = Grid(64, 64, 1e-6), Grid(300, 300, 1e-6)
    field = smooth_aperture(source, 25e-6)
    there = angular_spectrum(field, source, WAVELENGTH, 150e-6, wide)
    assert difference(angular_spectrum(there, wide, WAVELENGTH, -150e-6, source), field) < 1e-8
    assert float(flux(there, wide, WAVELENGTH) / flux(field, source, WAVELENGTH)) == pytest.approx(1, abs=1e-10)
    at_once = angular_spectrum(field, source, WAVELENGTH, 150e-6)
    halfway = angular_spectrum(field, source, WAVELENGTH, 60e-6, wide)
    assert difference(angular_spectrum(halfway, wide, WAVELENGTH, 90e-6, source), at_once) < 1e-6
    assert difference(angular_spectrum(field, source, WAVELENGTH, 0.0, source), field) < 1e-12


def test_backwards_is_the_adjoint_of_forwards() -> None:
    # With evanescent waves in the band: they decay both ways.
    source = Grid(24, 20, 0.2e-6)
    generator = torch.Generator().manual_seed(5)
    a = torch.randn(source.shape, generator=generator, dtype=torch.complex128)
    c = torch.randn(source.shape, generator=generator, dtype=torch.complex128)
    forward = torch.vdot(c.flatten(), angular_spectrum(a, source, WAVELENGTH, 0.3e-6).flatten())
    back = torch.vdot(angular_spectrum(c, source, WAVELENGTH, -0.3e-6).flatten(), a.flatten())
    assert abs(forward - back) < 1e-12 * abs(forward)


@pytest.mark.parametrize("method", [fresnel, angular_spectrum])
def test_gradients_of_field_and_distance(method: Callable[..., torch.Tensor]) -> None:
    source, output = Grid(6, 7, 20e-6), Grid(5, 4, 30e-6, (10e-6, 0.0))
    generator = torch.Generator().manual_seed(6)
    field = torch.randn(2, *source.shape, generator=generator, dtype=torch.complex128, requires_grad=True)
    # In centimetres, so that the step of the numerical derivative is a small one.
    distance = torch.tensor(1.3, dtype=torch.float64, requires_grad=True)

    def far(field: torch.Tensor, distance: torch.Tensor) -> torch.Tensor:
        return method(field, source, WAVELENGTH, distance * 1e-2, output)

    assert torch.autograd.gradcheck(far, (field, distance), atol=1e-6)


@pytest.mark.parametrize("method", [fresnel, angular_spectrum])
def test_batches_and_single_precision(method: Callable[..., torch.Tensor]) -> None:
    source, output, z = Grid(48, 40, 10e-6), Grid(20, 30, 12e-6), 0.05
    fields = torch.stack([smooth_aperture(source, r) for r in (0.1e-3, 0.15e-3, 0.2e-3)]).reshape(3, 1, 48, 40)
    double = method(fields, source, WAVELENGTH, z, output)
    assert double.shape == (3, 1, 20, 30)
    assert difference(double[1, 0], method(fields[1, 0], source, WAVELENGTH, z, output)) < 1e-12
    single = method(fields, source, WAVELENGTH, z, output, dtype=torch.complex64)
    assert single.dtype == torch.complex64
    assert difference(single.to(torch.complex128), double) < 3e-6


def test_a_plane_wave_keeps_its_phase_over_kilometres() -> None:
    # k z is 1e10 radians here: with the carrier left in, its last digits would be gone.
    source, output, z = Grid(1500, 1500, 0.5e-3), Grid(3, 3, 1e-3), 2e3
    x, y = places(source)
    flat = torch.exp(-(((x**2 + y**2) / 0.2**2) ** 2))
    assert difference(fresnel(flat, source, WAVELENGTH, z, output), torch.ones(output.shape)) < 1e-3


def test_which_method_suits() -> None:
    grid = Grid(256, 256, 10e-6)
    assert suitable_method(grid, WAVELENGTH, 10.0) == "fresnel"
    # Not sampled, and then sampled but too steep for the Fresnel integral.
    assert suitable_method(grid, WAVELENGTH, 0.01) == "angular_spectrum"
    assert suitable_method(Grid(4096, 4096, 0.5e-6), WAVELENGTH, 0.0066) == "angular_spectrum"


@pytest.mark.parametrize("method", [fresnel, angular_spectrum])
def test_refusals(method: Callable[..., torch.Tensor]) -> None:
    grid = Grid(8, 8, 1e-5)
    field = torch.ones(grid.shape)
    bad = torch.full(grid.shape, math.nan)
    for args, where in (
        ((field[:4], grid, WAVELENGTH, 0.1, grid), "field"),
        ((bad, grid, WAVELENGTH, 0.1, grid), "field"),
        ((field, grid, -1.0, 0.1, grid), "wavelength"),
        ((field, grid, WAVELENGTH, math.inf, grid), "distance"),
        ((field, grid, WAVELENGTH, torch.ones(2), grid), "distance"),
    ):
        with pytest.raises(InputError, match=where):
            method(*args)


def test_refuses_what_its_grids_cannot_hold() -> None:
    grid = Grid(8, 8, 1e-6)
    with pytest.raises(InputError, match="distance: is zero"):
        fresnel(torch.ones(8, 8), grid, WAVELENGTH, 0.0, grid)
    with pytest.raises(InputError, match="use fresnel"):
        angular_spectrum(torch.ones(8, 8), grid, WAVELENGTH, 100.0)


def test_lightpipes(validated: Callable[..., None]) -> None:
    size, samples, z = 6e-3, 300, 0.5
    # LightPipes' axis goes through sample N/2. `Forvard` has samples size/N apart and is periodic: this field stays
    # far from the edges. `Fresnel` has them size/(N-1) apart and averages its kernel over each, which is where its
    # own error of some 1e-3 comes from: it falls fourfold with twice the samples.
    for name, propagate, pitch, tolerance in (
        ("Forvard", LightPipes.Forvard, size / samples, 1e-6),
        ("Fresnel", LightPipes.Fresnel, size / (samples - 1), 5e-3),
    ):
        grid = Grid(samples, samples, pitch, (-pitch / 2, -pitch / 2))
        field = smooth_aperture(grid, 1.2e-3)
        begin = LightPipes.Begin(size, WAVELENGTH, samples)
        begin.field = field.numpy()
        other = torch.from_numpy(propagate(begin, z).field)
        # All of the grid is too wide for the Fresnel kernel's sampling: its middle is compared.
        middle = slice(75, 225)
        output = Grid(150, 150, pitch, (-pitch / 2, -pitch / 2))
        other = other[middle, middle]
        for method in (angular_spectrum, fresnel):
            ours = method(field, grid, WAVELENGTH, z, output)
            what = f"{method.__name__} of an aberrated aperture 2.4 mm wide after 0.5 m, up to a global phase"
            error = difference(ours, without_global_phase(ours, other))
            validated(SECTION, what, error, tolerance, f"LightPipes {name}")


@pytest.fixture
def double_precision() -> Iterator[None]:
    """torchoptics computes in torch's default precision, where single loses the phase k z."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize("name", ["ASM", "DIM", "DIM_FRESNEL"])
def test_torchoptics(name: str, validated: Callable[..., None]) -> None:
    from torchoptics import Field

    grid, z = Grid(150, 150, 8e-6), 0.02 if name == "ASM" else 0.04
    field = smooth_aperture(grid, 0.4e-3)
    theirs = Field(field, WAVELENGTH, 0.0, grid.pitch).propagate(grid.shape, z, grid.pitch, propagation_method=name)
    method = fresnel if name == "DIM_FRESNEL" else angular_spectrum
    ours = method(field, grid, WAVELENGTH, z, grid)
    what = f"{method.__name__} of an aberrated aperture 0.8 mm wide after {z * 1e3:g} mm, up to a global phase"
    error = difference(ours, without_global_phase(ours, theirs.data))
    validated(SECTION, what, error, 1e-6, f"torchoptics {name}")


@pytest.mark.usefixtures("double_precision")
def test_torchoptics_focus_of_a_lens(validated: Callable[..., None]) -> None:
    from torchoptics import Field
    from torchoptics.elements import Lens

    # Their lens is round with a ragged edge, on a grid as wide as the lens.
    grid, focal = Grid(300, 300, 4e-6), 0.05
    output = Grid(64, 64, 4e-6)
    lit = Lens(grid.shape, focal, 0.0, grid.pitch)(Field(torch.ones(grid.shape), WAVELENGTH, 0.0, grid.pitch))
    for method, theirs_method in ((angular_spectrum, "DIM"), (fresnel, "DIM_FRESNEL")):
        theirs = lit.propagate(output.shape, focal, output.pitch, propagation_method=theirs_method).data
        ours = method(lit.data, grid, WAVELENGTH, focal, output)
        what = f"{method.__name__} to the focus of a lens (r = 0.6 mm, f = 50 mm), up to a global phase"
        against = f"torchoptics {theirs_method}, its lens"
        validated(SECTION, what, difference(ours, without_global_phase(ours, theirs)), 1e-6, against)
    # With the edge's pixels weighed by what the disc covers of them, ours is Airy's pattern and theirs is not.
    x, y = places(grid)
    chirp = phasor(-K * (x**2 + y**2) / (2 * focal))
    smooth = fresnel(disc(grid, grid.width / 2) * chirp, grid, WAVELENGTH, focal, output)
    exact = airy(output, grid.width / 2, focal)
    assert difference(smooth, exact) < 1e-4 < difference(without_global_phase(exact, theirs), exact)
