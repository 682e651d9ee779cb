"""From the entrance pupil to the probe's pixels: against the thin engine's way, and a plain sum."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from tapetum.optics.fourier import phasor
from tapetum.optics.grid import Grid
from tapetum.optics.pupil import disc_quadrature
from tapetum.simulate import aperture_crossing
from tapetum.simulate.foreshortening import foreshortening
from tapetum.simulate.probe_path import ProbeAperture, ProbePath, missed_by_chirps

SECTION = "Traced lenses"
WAVELENGTH, PROBE_FOCAL, REACH = 640e-9, 0.1, 1.2e-3
K = 2 * math.pi / WAVELENGTH
OUTPUT = Grid(13, 15, 6e-6)


def path(aperture: ProbeAperture | None = None, output: Grid = OUTPUT) -> ProbePath:
    ends = 1.5 * REACH * torch.tensor([-1.0, 1.0], dtype=torch.float64)
    return ProbePath(
        output,
        ends,
        ends,
        wavelength=WAVELENGTH,
        probe_focal_length=PROBE_FOCAL,
        aperture=aperture,
        dtype=torch.complex128,
    )


def pupil(middle: tuple[float, float], count: int = 48) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A smooth field off its middle, with a tilt and a curvature of its own: [1, n, n], x and y [1, n]."""
    line = (torch.arange(count, dtype=torch.float64) + 0.5) * 2 / count - 1
    x, y = (middle[0] + REACH * line)[None], (middle[1] + REACH * line)[None]
    across, along = x[:, None, :], y[:, :, None]
    field = torch.exp(-((across - middle[0]) ** 2 + (along - middle[1]) ** 2) / (0.3 * REACH) ** 2)
    return field * phasor(K * (2e-4 * across - 1e-4 * along + 0.05 * across**2)), x, y


def plain(
    field: torch.Tensor,
    x: torch.Tensor,
    y: torch.Tensor,
    sines: torch.Tensor,
    aperture: ProbeAperture | None,
    exact: bool = False,
    output: Grid = OUTPUT,
) -> torch.Tensor:
    """The same integrals in the pupil's own coordinates, e = R (x, y), every sample for itself; by exact distances."""
    rotation, triangle = foreshortening(sines)
    shortening = (rotation @ triangle)[0]
    place = torch.stack(torch.meshgrid(x[0], y[0], indexing="xy"), -1).reshape(-1, 2) @ rotation[0].T
    value = field.reshape(-1) * float((x[0, 1] - x[0, 0]) * (y[0, 1] - y[0, 0]))
    value = value * (1 - float((sines**2).sum())) ** 0.25
    q = torch.stack(torch.meshgrid(output.x(), output.y(), indexing="xy"), -1).reshape(-1, 2)
    constant = 1 / (1j * WAVELENGTH * PROBE_FOCAL)
    if aperture is None:
        seen = phasor(-K / PROBE_FOCAL * (q @ shortening.T) @ place.T) @ value * constant
        return seen.reshape(output.rows, output.columns)
    disc = disc_quadrature(aperture.radius, aperture.columns, aperture.rows)
    far = torch.stack(torch.meshgrid(disc.x, disc.y, indexing="xy"), -1).reshape(-1, 2)
    weights = disc.weights.reshape(-1)
    shown, seen = weights != 0, place @ shortening
    bend = K / (2 * aperture.distance)
    kernel = phasor(-2 * bend * far[shown] @ seen.T) @ (value * phasor(bend * (seen**2).sum(-1)))
    kernel = kernel * phasor(bend * (far[shown] ** 2).sum(-1))
    if exact:
        # Without the way of the middle: what the field that leaves has no tilt of.
        along = aperture.distance + place @ sines[0]
        beside = ((far[shown][:, None, :] - seen) ** 2).sum(-1)
        kernel = phasor(K * beside / (torch.sqrt(along**2 + beside) + along)) @ value
    arriving = kernel * weights[shown] / (1j * WAVELENGTH * aperture.distance)
    image = phasor(-K / PROBE_FOCAL * q @ far[shown].T) @ arriving * constant
    return image.reshape(output.rows, output.columns)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.0, 0.3), (0.25, 0.2)])
@pytest.mark.parametrize("distance", [None, 0.8], ids=["far", "near"])
def test_pupils_off_their_middle_against_a_plain_sum(
    tilt: tuple[float, float], distance: float | None, validated: Any
) -> None:
    sines = torch.tensor([tilt], dtype=torch.float64)
    aperture = None if distance is None else ProbeAperture(distance, 0.8e-3, 48, 48)
    field, x, y = pupil((2.5e-4, -3.5e-4))
    ours = path(aperture).carry(field, x, y, sines, None)[0]
    want = plain(field, x, y, sines, aperture)
    error = float((ours - want).abs().max() / want.abs().max())
    where = "far field" if distance is None else "0.8 m, aperture of 1.6 mm"
    validated(SECTION, f"exit path, {where}, tilt {tilt}", error, 1e-4, "a plain sum, phase and all")


def test_columns_by_a_fast_transform_are_those_by_products(monkeypatch: pytest.MonkeyPatch, validated: Any) -> None:
    """Both sum the same smooth light over the aperture, on columns of different steps."""
    sines = torch.tensor([[0.1, 0.05]], dtype=torch.float64)
    centres = torch.tensor([[2e-5, -3e-5]], dtype=torch.float64)
    field, x, y = pupil((2.5e-4, -3.5e-4))
    found: list[torch.Tensor] = []
    for fast in (True, False):

        def beats(*_: float, fast: bool = fast) -> bool:
            return fast

        monkeypatch.setattr(aperture_crossing, "fast_beats_products", beats)
        one = path(ProbeAperture(0.8, 0.8e-3, 96, 96))
        found.append(one.carry(field, x, y, sines, centres)[0])
        assert torch.allclose(found[-1].abs() ** 2, one.carry(field, x, y, sines, centres, squared=True)[0])
    error = float((found[0] - found[1]).abs().max() / found[1].abs().max())
    validated(SECTION, "columns of the probe's aperture by a fast transform", error, 1e-6, "products, phase and all")


def test_pixels_coarser_than_the_detail_see_all_of_the_aperture(
    monkeypatch: pytest.MonkeyPatch, validated: Any
) -> None:
    """A transform in steps of these pixels would not hold all columns, however fast it is."""

    def beats(*_: float) -> bool:
        return True

    monkeypatch.setattr(aperture_crossing, "fast_beats_products", beats)
    sines = torch.zeros(1, 2, dtype=torch.float64)
    field, x, y = pupil((0.0, 0.0))
    aperture = ProbeAperture(2.0, 6e-3, 900, 900)
    some = path(aperture, Grid(7, 7, 4e-5)).carry(field, x, y, sines, None)[0]
    each = path(aperture, Grid(49, 49, 4e-5 / 7)).carry(field, x, y, sines, None)[0, 3::7, 3::7]
    error = float((some - each).abs().max() / each.abs().max())
    validated(SECTION, "coarse pixels behind a wide aperture", error, 1e-9, "every seventh of finer ones")


def test_a_wide_aperture_is_the_far_field(validated: Any) -> None:
    """What passes whole shows the far field's picture, but for a bend of phase."""
    sines = torch.tensor([[0.02, 0.05]], dtype=torch.float64)
    field, x, y = pupil((2e-4, 1e-4))
    far = path().carry(field, x, y, sines, None)[0].abs()
    near = path(ProbeAperture(2.0, 6e-3, 200, 200)).carry(field, x, y, sines, None)[0].abs()
    error = float((far - near).abs().max() / far.max())
    # A part of the path of second order would show here: of light that leaves straight all parts cancel.
    validated(SECTION, "modulus through a wide aperture at 2 m", error, 1e-6, "the far field")


@pytest.mark.parametrize("aperture", [None, ProbeAperture(2.0, 6e-3, 200, 200)], ids=["far", "near"])
def test_centres_move_the_picture(aperture: ProbeAperture | None) -> None:
    sines = torch.zeros(1, 2, dtype=torch.float64)
    field, x, y = pupil((0.0, 0.0))
    step = OUTPUT.pitch
    still = path(aperture).carry(field, x, y, sines, None)[0].abs()
    moved = path(aperture).carry(field, x, y, sines, torch.tensor([[2 * step, -step]], dtype=torch.float64))[0].abs()
    assert torch.allclose(moved[:-1, 2:], still[1:, :-2], atol=2e-3 * float(still.max()))


@pytest.mark.parametrize(
    ("tilt", "distance", "radius", "bend"),
    [
        pytest.param(0.021, 0.07, 0.126e-3, -15.2, marks=pytest.mark.slow),
        (0.094, 0.1, 0.114e-3, -1.3),
        (0.246, 0.114, 0.135e-3, 0.0),
        pytest.param(0.255, 0.189, 0.53e-3, 26.3, marks=pytest.mark.slow),
        pytest.param(0.0, 0.06, 0.25e-3, 20.0, marks=pytest.mark.slow),
    ],
)
def test_what_the_way_to_the_probe_misses_is_within_the_bound(
    tilt: float, distance: float, radius: float, bend: float, validated: Any
) -> None:
    """A small pupil with a rim, whose light leaves with a curvature of its own, in 1/m."""
    reach, sines = 0.3e-3, torch.tensor([[0.6 * tilt, 0.8 * tilt]], dtype=torch.float64)
    # All that rays and a ring or two make of the picture.
    angle = min((radius + reach) / distance, abs(bend) * reach) + 1.5 * WAVELENGTH / min(radius, reach)
    output = Grid(17, 17, 2 * angle * PROBE_FOCAL / 17)
    window = angle + reach / distance
    aperture = ProbeAperture.behind_traced(distance, radius, WAVELENGTH, window, reach=reach, accuracy=1e-4)
    turn = 2 * reach * K * (abs(bend) * reach + (reach + radius) / distance)
    count = 40 + math.ceil(turn)
    x = y = (reach * ((torch.arange(count, dtype=torch.float64) + 0.5) * 2 / count - 1))[None]
    rho_squared = x[:, None, :] ** 2 + y[:, :, None] ** 2
    field = (rho_squared <= reach**2) * phasor(K * bend / 2 * rho_squared)
    ours = path(aperture, output).carry(field, x, y, sines, None)[0].abs() ** 2
    want = plain(field, x, y, sines, aperture, exact=True, output=output).abs() ** 2
    error = float((ours - want).abs().max() / want.max())
    missed = missed_by_chirps(distance, radius, reach=reach, angle=abs(bend) * reach, sine=tilt, wavelength=WAVELENGTH)
    degrees = math.degrees(math.asin(tilt))
    what = f"the way to the probe, d = {distance:g} m, a = {radius * 1e3:g} mm, tilt {degrees:.3g}°"
    validated(SECTION, what, error / missed, 1.0, "exact distances, sample by sample", "of the stated error")


@pytest.mark.parametrize("accuracy", [0.02, 1e-3])
@pytest.mark.parametrize(
    ("distance", "radius", "reach", "bend", "seen"),
    [
        (2.0, 4e-3, 1.6e-3, -1.6, 1.0),
        (1.5, 2e-3, 1.1e-3, -3.0, 1.0),
        (0.8, 2.5e-3, 0.6e-3, 4.0, 0.4),
        (3.0, 3e-3, 2e-3, 1.0, 3.0),
    ],
)
def test_samples_of_the_aperture_behind_a_traced_lens(
    distance: float, radius: float, reach: float, bend: float, seen: float, accuracy: float, validated: Any
) -> None:
    """They once left out the pupil's own width, and small apertures had too few: pictures were off by 1 %, unsaid."""
    angle = (radius + reach) / distance
    output = Grid(33, 33, 2 * PROBE_FOCAL * seen * angle / math.sqrt(2) / 33)
    count = 60 + math.ceil(1.2 * 2 * reach * K * (abs(bend + 1 / distance) * reach + (1 + seen) * angle))
    x = y = (reach * ((torch.arange(count, dtype=torch.float64) + 0.5) * 2 / count - 1))[None]
    rho_squared = x[:, None, :] ** 2 + y[:, :, None] ** 2
    field = torch.sigmoid((reach - rho_squared.sqrt()) / (2 * reach / count)) * phasor(K * bend / 2 * rho_squared)
    sines = torch.tensor([[0.03, 0.02]], dtype=torch.float64)
    given = ProbeAperture.behind_traced(distance, radius, WAVELENGTH, seen * angle, reach=reach, accuracy=accuracy)
    samples = 3 * given.columns
    ours, want = (
        path(one, output).carry(field, x, y, sines, None)[0].abs() ** 2
        for one in (given, ProbeAperture(distance, radius, samples, samples))
    )
    error = float((ours - want).abs().max() / want.max())
    what = f"samples of the aperture, d = {distance:g} m, a = {radius * 1e3:g} mm, pupil {reach * 1e3:g} mm"
    validated(SECTION, f"{what}, {accuracy:g} of the peak", error / accuracy, 0.15, "three times as many",
              "of the accuracy asked for")  # fmt: skip
