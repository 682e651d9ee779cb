"""Rays into a lens, off a mirror and out again, against the waves: paths, energy, cut-offs."""

from __future__ import annotations

import functools
import math
from typing import Any

import pytest
import torch
from traced_cases import WAVELENGTH, Case, along_y, energy, finer, picture, planned, traced

from tapetum.bench import PrescriptionLens, load_scene, with_values
from tapetum.optics.focus import FocusedLens
from tapetum.optics.grid import Grid
from tapetum.optics.rays import to_plane, trace_out
from tapetum.simulate import retroreflect, traced_return
from tapetum.simulate.probe_path import ProbeAperture
from tapetum.simulate.pupil_fits import PupilFits, TiltNodes, fit_pupils, values_at
from tapetum.simulate.pupil_rim import leaving_by
from tapetum.simulate.traced_light import Way, accuracy_above, followed, traced_scene
from tapetum.simulate.traced_return import Returned, check_return, corrected, trace_return

SECTION = "Traced lenses"
LENSES = [
    Case("phone-a", 6.0),
    Case("phone-d", 5.0),
    Case("compact-6mm-f1.9", 12.0),
    Case("cmount-12mm-f1.4", 15.0, focal_length=3.8e-3),
    Case("zoom-18-140mm", 3.0, focal_length=0.05),
]
NEAR = [
    Case("phone-a", 6.0, 1.0),
    Case("phone-d", 5.0, 1.0),
    Case("cmount-12mm-f1.4", 12.0, 1.0, focal_length=3.8e-3),
    Case("zoom-5-15mm", 8.0, 1.0, focal_length=5.2e-3),
]
# RMS of a return's paths beyond which the planner claims no accuracy.
MOST_ALLOWED = 0.05 * WAVELENGTH


def tilts(case: Case) -> torch.Tensor:
    return torch.linspace(0, 0.8 * case.steepest, 4, dtype=torch.float64)


@pytest.mark.parametrize("case", [*LENSES, *NEAR], ids=str)
def test_rays_come_back_on_the_paths_that_waves_take(case: Case, validated: Any) -> None:
    """Through the reversed prescription: the model's reciprocity within a twentieth of a wave."""
    focused, fits = traced(case)
    back = check_return(focused, fits, tilts(case))
    told = back.opd[~back.opd.isnan()]
    assert len(told) >= 2
    validated(SECTION, f"path of the return, {case}", float(told.max()) / WAVELENGTH, 0.05,
              "rays through the reversed lens", "waves RMS")  # fmt: skip


def test_light_far_out_of_focus_comes_back_another_way() -> None:
    """A 50 mm f/1.8 focused on 0.8 m before collimated light: reciprocity fails, and the check sees it."""
    case = Case("photo-50mm-f1.8", 3.0, 0.8)
    focused, fits = traced(case)
    departure = float(check_return(focused, fits, tilts(case)).opd.max())
    assert departure > 0.3 * WAVELENGTH


@pytest.mark.parametrize("case", [*LENSES, NEAR[-1]], ids=str)
def test_waves_bring_back_the_energy_of_the_rays(case: Case, validated: Any) -> None:
    focused, _ = traced(case)
    output = picture(case, 15)
    one = finer(planned(case, output, 3e-2, pictures=1).passes[0], output, 1.1, window=3.0)
    worst = 0.0
    for share in (0.0, 0.3, 0.6, 0.9):
        sine = torch.tensor([share * case.steepest], dtype=torch.float64)
        back = trace_return(focused, sine, count=101)
        overlap = float(back.passing.sum() / back.bundle.passing.sum())
        bundle = back.bundle
        side = bundle.e[0].amax(0) - bundle.e[0].amin(0)
        entering = float(bundle.passing.sum()) * float(side.prod()) / 100**2 * math.sqrt(1 - float(sine) ** 2)
        returned = float(energy(one, torch.stack([torch.zeros_like(sine), sine], -1))[0])
        worst = max(worst, abs(returned / entering - overlap))
    what = f"returned power over four fields, {case}"
    # Of the smallest pupil more is diffracted past its own edge: the sum over rays with exact distances loses as much.
    allowed = 0.035 if case.name == "phone-d" else 0.02
    validated(SECTION, what, worst, allowed, "overlap of rays", "of the entering power")


@pytest.mark.parametrize(
    ("case", "low", "high"),
    [
        (Case("phone-a", 13.0), 6.0, 11.0),
        (Case("phone-d", 12.0), 5.5, 11.0),
        (Case("zoom-18-140mm", 6.5, focal_length=0.05), 4.5, 6.0),
        (Case("zoom-18-140mm", 3.0, focal_length=0.135), 1.0, 2.3),
    ],
    ids=str,
)
def test_the_chief_ray_in_image_space_sets_the_cut_off(case: Case, low: float, high: float) -> None:
    """Rays cease to return where the pupil no longer holds the direction that meets the sensor upright."""
    focused = case.lens.focused(WAVELENGTH, case.distance)
    sines = torch.linspace(0, case.steepest, 40, dtype=torch.float64)
    back = trace_return(focused, sines)
    share = back.passing.sum(-1) / back.bundle.passing.sum(-1)
    assert float(share[0]) > 0.9
    first = int(torch.nonzero(share < 0.005)[0])
    assert bool((share[first:] < 0.005).all())
    assert low < float(torch.rad2deg(torch.asin(sines[first]))) < high
    # |s_c| has reached NA there: nothing of the pupil lies beyond the upright direction.
    upright = torch.where(back.bundle.passing, back.bundle.s[..., 1], torch.full_like(back.bundle.psi, torch.inf))
    edge = upright.amin(-1)
    assert float(edge[first - 4]) < 0 < float(edge[min(first + 3, len(sines) - 1)])


def test_nothing_returns_past_the_cut_off() -> None:
    case = Case("phone-d", 10.0)
    one = planned(case, picture(case)).passes[0]
    inside, outside = energy(one, along_y(0.0, 9.5)).tolist()
    assert outside < 2e-3 * inside


@pytest.mark.parametrize(
    "case",
    [Case("compact-6mm-f1.9", 6.0, 1.0), Case("zoom-5-15mm", 3.0, 1.0, focal_length=14e-3)],
    ids=str,
)
def test_corrected_pupils_hold_the_rays_own_paths(case: Case, validated: Any) -> None:
    """What `corrected` fits is the path of the rays that return: at other tilts than it was fitted to as well."""
    focused, fits = traced(case)
    mended = corrected(focused, fits)
    assert mended is not None
    sines = 0.8 * torch.linspace(0, mended.nodes.steepest, 5, dtype=torch.float64)
    before = check_return(focused, fits, sines).opd.nan_to_num().max()
    after = float(check_return(focused, mended, sines).opd.nan_to_num().max())
    validated(SECTION, f"path of the return, corrected, {case}", after / WAVELENGTH, 5e-3, "rays", "waves RMS")
    assert after < float(before)


def test_the_exit_curvature_of_a_lens_focused_elsewhere(validated: Any) -> None:
    """A ray that enters at e leaves at -e (1 + 2x_i/f) with slope 2e x_i/f²: LA1509, near its axis."""
    case = Case("la1509", 0.5, 2.0, f_number=100 / 3)
    focused = case.lens.focused(WAVELENGTH, case.distance)
    back = trace_return(focused, torch.zeros(1, dtype=torch.float64))
    e, turned = back.bundle.e[0], back.turned[0]
    some = torch.linalg.vector_norm(e, dim=-1) < 1.2e-3
    slope = float((e[some] * turned[some]).sum() / (e[some] ** 2).sum())
    f = focused.focal_length
    x_i = focused.image - (focused.exit_pupil + f)
    validated(SECTION, f"exit curvature, {case}", abs(abs(slope) / (2 * x_i / f**2) - 1), 5e-3, "2 x_i/f²", "relative")


@pytest.fixture(scope="module")
def far_out() -> FocusedLens:
    """135 mm focused at 3 m, which a probe at 5.5 m lights: far out of focus."""
    return PrescriptionLens("zoom-18-140mm", focal_length=0.135).focused(640e-9, 3.0)


@functools.lru_cache(maxsize=2)
def far_out_pupils(lens: FocusedLens, steepest: float) -> PupilFits:
    nodes = TiltNodes.up_to(steepest).denser()
    return fit_pupils(lens, steepest, curvature=1 / 5.5, nodes=nodes)


@functools.lru_cache(maxsize=2)
def far_out_corrected(lens: FocusedLens, steepest: float) -> PupilFits:
    """Those pupils with the paths of rays, at the tilts that they were fitted at."""
    fits = far_out_pupils(lens, steepest)
    found = corrected(lens, fits, curvature=1 / 5.5, nodes=fits.nodes)
    assert found is not None
    return found


def test_a_correction_that_is_right_at_its_nodes_alone_is_found_out(
    far_out: FocusedLens, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Few rays return at the steepest tilts, and lower polynomials do not hold their paths.
    monkeypatch.setattr(traced_return, "_RETURN_DEGREE", 12)
    fits = fit_pupils(far_out, 0.030373151772768472, curvature=1 / 5.5)
    found = corrected(far_out, fits, curvature=1 / 5.5)
    assert found is None or found.misfit > 10 * MOST_ALLOWED


@pytest.mark.parametrize("steepest", [0.0295, 0.030373151772768472, 0.0185])
def test_a_correction_knows_its_paths_at_tilts_between_its_nodes(
    steepest: float, far_out: FocusedLens, validated: Any
) -> None:
    found = far_out_corrected(far_out, steepest)
    # Most of them steep, where few rays return.
    sines = steepest * torch.cat([torch.linspace(0.02, 0.7, 7), torch.linspace(0.75, 0.98, 24)]).to(torch.float64)
    error = float(check_return(far_out, found, sines, curvature=1 / 5.5).opd.max())
    what = f"path of the return, 135 mm at 3 m seen from 5.5 m, up to {math.degrees(math.asin(steepest)):.3g}°"
    validated(SECTION, what, error / found.misfit, 1.0, "rays at other tilts", "of the stated misfit")


def test_a_correction_knows_its_paths_at_shallow_tilts_too(validated: Any) -> None:
    """There the worst paths lay at a quarter of the steepest tilt, halfway between two nodes."""
    lens, steepest = PrescriptionLens("zoom-18-140mm", focal_length=0.1).focused(640e-9, 2.0), 0.012
    nodes = TiltNodes.up_to(steepest)
    found = corrected(lens, fit_pupils(lens, steepest, curvature=1 / 4, nodes=nodes), curvature=1 / 4, nodes=nodes)
    assert found is not None
    sines = steepest * torch.linspace(0.1, 0.5, 9, dtype=torch.float64)
    error = float(check_return(lens, found, sines, curvature=1 / 4).opd.max())
    what = "path of the return, 100 mm at 2 m seen from 4 m, tilts from 0.07° to 0.34°"
    validated(SECTION, what, error / found.misfit, 1.0, "rays at other tilts", "of the stated misfit")


class Landings:
    """Rays that leave from where rays of a tilt, `back` of one field, met the sensor, under any directions."""

    def __init__(self, lens: FocusedLens, fits: PupilFits, sine: torch.Tensor, back: Returned) -> None:
        self.lens, self.fits, self.sine, self.back = lens, fits, sine, back
        rays = back.bundle.rays
        self.mirrored = rays.direction[0, :, :2]
        self.landing, self.way = to_plane(rays.position, rays.direction, lens.image)
        self.tilt = fits.nodes.terms(sine)

    def sent(self, which: torch.Tensor, cosines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Where rays off the landings of `which` [N] cross the pupil, [N, 2], and what their paths exceed the model's
        by, [N]."""
        bundle = self.back.bundle
        towards = torch.cat([cosines, -torch.sqrt(1 - (cosines**2).sum(-1, keepdim=True))], -1)[None]
        out = trace_out(self.lens.lens, self.landing[:, which], towards)
        e, more = leaving_by(self.lens, self.sine, out.position, out.direction)
        path = (bundle.before + bundle.rays.path + self.way)[:, which] + out.path + more
        v = bundle.beside[:, which]
        even, odd = values_at(self.fits.leaving, self.tilt, e)
        s = bundle.s[:, which] + torch.stack([odd[:, 0], even[:, 1]], -1)
        model = bundle.psi[:, which] + even[:, 0] + (s * v).sum(-1) + self.fits.bend * (v**2).sum(-1)
        return e[0], (path - model)[0]

    def aimed(self, which: torch.Tensor, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The same, under the directions that lead to places [N, 2], by Newton's method."""
        cosines, step = self.mirrored[which].clone(), 1e-5
        for _ in range(4):
            e = self.sent(which, cosines)[0]
            slopes = [(self.sent(which, cosines + step * one)[0] - e) / step for one in torch.eye(2).double()]
            cosines = cosines + torch.linalg.solve(torch.stack(slopes, -1), places - e)
        return self.sent(which, cosines)


@pytest.mark.parametrize("share", [0.55, 0.8])
def test_beyond_the_rays_light_comes_from_where_the_rim_s_rays_land(
    share: float, far_out: FocusedLens, validated: Any
) -> None:
    """Paths beyond were 0.06 and 0.03 rad off, where polynomials of the rays inside were continued."""
    fits, found = far_out_pupils(far_out, 0.0185), far_out_corrected(far_out, 0.0185)
    sine = share * torch.tensor([0.0185], dtype=torch.float64)
    tilt = fits.nodes.terms(sine)
    back = trace_return(far_out, sine, curvature=1 / 5.5, middle=tilt @ fits.middle, count=61)
    coming, leaving = back.height[0].tensor_split([back.bundle.height.shape[-1]], -1)
    rim = torch.nonzero(back.passing[0] & (coming.amax(-1) > 0.97) & (leaving.amax(-1) < 0.9))[:, 0]
    rim = rim[:: max(1, len(rim) // 8)]
    start, inside = back.e[0, rim], back.e[0, back.passing[0]]
    outwards = start - inside.mean(0)
    outwards = float(inside.abs().max()) * outwards / torch.linalg.vector_norm(outwards, dim=-1, keepdim=True)
    landings, worst = Landings(far_out, fits, sine, back), 0.0

    def ours(e: torch.Tensor) -> torch.Tensor:
        return (values_at(found.leaving, tilt, e[None])[0] - values_at(fits.leaving, tilt, e[None])[0])[0, 0]

    truth_there = landings.aimed(rim, start)[1]
    for farther in (0.04, 0.08, 0.12):
        e, truth = landings.aimed(rim, start + farther * outwards)
        worst = max(worst, float((ours(e) - ours(start) - truth + truth_there).abs().max()))
    what = f"path a tenth of the pupil beyond the rays, 135 mm at 3 m seen from 5.5 m, at {share:g} of 1.06°"
    validated(SECTION, what, 2 * math.pi * worst / 640e-9, 0.02, "rays from where the rim's light lands", "rad")


def test_a_correction_may_be_fitted_at_other_tilts_than_its_pupils(far_out: FocusedLens) -> None:
    fits = far_out_pupils(far_out, 0.0185)
    found = corrected(far_out, fits, curvature=1 / 5.5)
    assert found is not None and found.nodes.count != fits.nodes.count
    sines = torch.tensor([0.004, 0.009, 0.014], dtype=torch.float64)
    assert float(check_return(far_out, found, sines, curvature=1 / 5.5).opd.max()) <= found.misfit


def test_light_far_out_of_focus_is_known_to_an_eightieth(far_out: FocusedLens) -> None:
    """Its paths were once known to 0.025 radians at best, and the way to the probe to 0.021; both to 0.0148, while a
    guess of the paths where no ray returns counted, too."""
    aperture = ProbeAperture.behind_traced(5.5, 12.5e-3, 640e-9, 800 * 2.2e-6 / 0.1 / 2, reach=0.0107, accuracy=0.02)
    way = Way(wavelength=640e-9, probe_focal_length=0.1, curvature=1 / 5.5, aperture=aperture)
    scene = traced_scene(far_out, fit_pupils(far_out, 0.0185, curvature=1 / 5.5), Grid(800, 800, 2.2e-6), **way)
    light = followed(scene, 0.02)
    assert light.unsure - light.rims <= 1 / 80


def test_light_that_is_followed_to_its_last_ray_leaves_by_the_whole_pupil() -> None:
    """Even where the rim's light may be left out. Paths of a part of it were known to 0.006 rad RMS, here to 0.0005."""
    lens, steepest = PrescriptionLens("zoom-18-140mm", focal_length=0.1).focused(640e-9, 2.0), 0.0185
    aperture = ProbeAperture.behind_traced(4.0, 3e-3, 640e-9, 800 * 2.2e-6 / 0.1 / 2, reach=0.008, accuracy=0.03)
    way = Way(wavelength=640e-9, probe_focal_length=0.1, curvature=1 / 4, aperture=aperture, rim_light=False)
    scene = traced_scene(lens, fit_pupils(lens, steepest, curvature=1 / 4), Grid(800, 800, 2.2e-6), **way)
    light = followed(scene, 0.03)
    assert light.by_rays and light.accepted is None and light.fits.part is None
    assert light.unsure - light.rims < 0.003


def test_a_correction_keeps_the_waves_beyond_the_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays come back within 0.91 of the pupil, and little off the model's paths: the picture hardly changes.

    The fits once ended where the rays do, and the light diffracted beyond them was cut off: 0.29 of the peak.
    """
    lens = {"kind": "prescription", "name": "la1509", "f_number": 5.24, "focal_length": 0.02}
    changes = {
        "target.lens": lens,
        "target.object_distance": 54.3,
        "target.rotation": [-0.0143, -0.0243],
        "target.sensor.pixels": [2000, 1500],
        "illumination": {"mode": "diverging", "wavelength": 810e-9, "divergence": 0.098, "power": 1e-3},
        "distance": 0.613,
        "probe.lens": {"focal_length": 0.0555, "aperture_radius": 0.005},
        "probe.sensor.pixels": [33, 33],
        "probe.sensor.pitch": 3.26e-6,
        "sampling": {"accuracy": 0.01, "propagation": "finite"},
    }
    scene = with_values(load_scene("thin-lens"), changes)
    ours = retroreflect(scene).irradiance
    monkeypatch.setattr("tapetum.simulate.traced_light.corrected", lambda *given, **named: None)
    usual = retroreflect(scene).irradiance
    assert 0 < float((ours - usual).abs().max() / usual.max()) < 0.01


@pytest.mark.parametrize(("error", "asked"), [(0.1125, 0.12), (0.1, 0.1), (0.0349, 0.035), (1.01e-3, 1.1e-3)])
def test_the_accuracy_that_a_refusal_names_is_enough(error: float, asked: float) -> None:
    assert accuracy_above(error) == pytest.approx(asked) and accuracy_above(error) >= error
