"""The catalogue's lenses: the numbers their sources state come out of the trace."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tapetum.bench import lens_names, load_lens
from tapetum.bench.prescription import PrescriptionLens
from tapetum.bench.zoom import focal_range
from tapetum.optics.focus import best_focus, bundle, pupil_height, wavefront
from tapetum.optics.glass import GLASSES, abbe_number, index_from_abbe, refractive_index
from tapetum.optics.rays import to_plane, trace

# Focal lengths in millimetres and F-numbers: at the d line where the patent or the maker states them, else at 640 nm,
# as the collection of these tables has them.
STATED = {
    "cmount-12mm-f1.4": [(11.98, 1.45)],
    "compact-6mm-f1.9": [(6.00, 1.93)],
    "la1509": [(99.7, 3.92)],
    "phone-a": [(5.729, 2.86)],
    "phone-b": [(5.126, 2.35)],
    "phone-c": [(5.56, 3.5)],
    "phone-d": [(3.76, 3.3)],
    "phone-e": [(5.70, 3.1)],
    "phone-f": [(4.07, 2.31)],
    "photo-50mm-f1.8": [(51.36, 1.84)],
    "zoom-18-140mm": [(18.54, 3.6), (50.034, 5.0), (135.845, 6.3)],
    "zoom-5-15mm": [(5.14, 2.8), (10.00, 3.7), (14.83, 4.6)],
}
D_LINE = 587.56e-9
PATENTED = {"cmount-12mm-f1.4", "compact-6mm-f1.9", "la1509", "zoom-18-140mm", "zoom-5-15mm"}


def test_the_catalogue_is_complete() -> None:
    assert lens_names() == sorted(STATED)


@pytest.mark.parametrize("name", sorted(STATED))
def test_every_lens_says_where_it_is_from(name: str) -> None:
    lens = load_lens(name)
    assert lens.name == name and lens.source and lens.use and lens.assumed
    assert lens.patent or "DeepLens" in lens.source or "maker" in lens.source
    assert all(state.half_field for state in lens.states)


@pytest.mark.parametrize("name", sorted(STATED))
def test_focal_lengths_and_f_numbers(name: str, validated) -> None:
    """The file's F-number is what real rays pass; so is every state of a zoom."""
    prescription = load_lens(name)
    stated = name in PATENTED
    for k, (focal, f_number) in enumerate(STATED[name]):
        own = focal_range(prescription, D_LINE if stated else 640e-9)[k]
        error = abs(own / (1e-3 * focal) - 1)
        against = "its patent or maker" if stated else "the note beside the collected table"
        validated("Lenses", f"Focal length of {name}, {focal:g} mm", error, 2e-3, against, "of it")
        lens = PrescriptionLens(name, focal_length=focal_range(prescription, D_LINE)[k])
        error = abs(lens.focal_length / (2 * lens.aperture_radius) / f_number - 1)
        assert prescription.states[k].f_number == f_number
        assert error < 1e-2
        # Elsewhere the number was read off the semi-diameters.
        if stated or name in ("phone-c", "phone-e"):
            validated(
                "Lenses", f"F-number of {name} at {focal:g} mm, f/{f_number:g}", error, 1e-2, "its source", "of it"
            )


@pytest.mark.parametrize("name", sorted(set(STATED) - {"la1509"}))
def test_images_on_the_axis_are_sharp(name: str) -> None:
    """A wrong sign or digit anywhere in a table spoils this by orders of magnitude."""
    focal = {"zoom-18-140mm": 85e-3, "zoom-5-15mm": 8e-3}.get(name)
    focused = PrescriptionLens(name, focal_length=focal).focused(640e-9, math.inf)
    lens = focused.lens
    image, edge = best_focus(lens, math.inf), pupil_height(lens)
    nodes, weights = np.polynomial.legendre.leggauss(24)
    heights = torch.tensor(edge * np.sqrt((nodes + 1) / 2))
    waves = wavefront(lens, math.inf, image, heights).numpy() / 640e-9
    rms = math.sqrt(np.average((waves - np.average(waves, weights=weights)) ** 2, weights=weights))
    position, direction, _ = bundle(heights, focused.entrance_pupil, math.inf)
    rays = trace(lens, position, direction)
    spot = to_plane(rays.position, rays.direction, image)[0][:, 1].numpy()
    assert rms < 0.3
    assert math.sqrt(np.average(spot**2, weights=weights)) < 8e-6


@pytest.mark.parametrize("name", sorted(STATED))
def test_chief_rays_pass_all_over_the_field(name: str) -> None:
    """From somewhere in the entrance pupil light of every field angle that a lens covers reaches the sensor."""
    for k, state in enumerate(load_lens(name).states):
        focal = focal_range(load_lens(name), D_LINE)[k]
        focused = PrescriptionLens(name, focal_length=focal).focused(640e-9, math.inf)
        assert state.half_field is not None
        reach = 3 * focused.entrance_radius
        height = torch.linspace(-reach, reach, 601, dtype=torch.float64)
        zero = torch.zeros_like(height)
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            angle = share * state.half_field
            position = torch.stack([zero, height, zero + focused.entrance_pupil], -1)
            direction = torch.stack([zero, zero + math.sin(angle), zero + math.cos(angle)], -1)
            rays = trace(focused.lens, position, direction)
            passed = rays.good & (rays.height <= 1).all(-1)
            assert bool(passed.any()), f"{name}, {math.degrees(angle):.1f} deg"


def test_la1509_is_the_lens_of_the_paper_s_figures(validated) -> None:
    """Curved side to the light; its paraxial focus lies n R/(n-1) - d/n... behind the flat by the closed form."""
    n = refractive_index("N-BK7", 640e-9)
    focused = PrescriptionLens("la1509", f_number=60, design_wavelength=640e-9).focused(640e-9, math.inf)
    closed = 51.5e-3 / (n - 1) - 3.6e-3 / n
    behind = focused.image - float(focused.lens.z[-1])
    validated(
        "Lenses",
        "Back focal length of LA1509 at f/60, 640 nm",
        abs(behind / closed - 1),
        1e-4,
        "R/(n - 1) - d/n",
        "of it",
    )


@pytest.mark.parametrize("glass", sorted(GLASSES))
def test_glasses_by_two_numbers(glass: str, validated) -> None:
    nd, vd = refractive_index(glass, 587.562e-9), abbe_number(glass)
    error = max(abs(index_from_abbe(nd, vd, w) - refractive_index(glass, w)) for w in (640e-9, 785e-9))
    tolerance = 6e-4 if glass == "PMMA" else 8e-5
    what = f"Index of {glass} at 640 and 785 nm from n_d and its Abbe number"
    validated("Lenses", what, error, tolerance, "its dispersion formula", "in n")
    assert index_from_abbe(nd, vd, 587.562e-9) == pytest.approx(nd, abs=1e-15)
    abbe = (nd - 1) / (index_from_abbe(nd, vd, 486.133e-9) - index_from_abbe(nd, vd, 656.273e-9))
    assert abbe == pytest.approx(vd, rel=1e-9)
