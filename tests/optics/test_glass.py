"""Indices against their makers' figures, and a lens that one can buy."""

from __future__ import annotations

import itertools
import math
import typing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapetum.bench import ThinLens
from tapetum.errors import InputError
from tapetum.optics.glass import GLASSES, abbe_number, focal_length_at, refractive_index

D_LINE = 587.562e-9


def test_glasses_are_those_a_scene_may_name() -> None:
    hint = typing.get_type_hints(ThinLens)["glass"]
    names = {name for one in typing.get_args(hint) for name in typing.get_args(one)}
    assert names == set(GLASSES)


# Of the data sheets; Malitson gives the silica's Abbe number to one decimal.
@pytest.mark.parametrize(
    ("glass", "index", "abbe", "digits"),
    [("N-BK7", 1.51680, 64.17, 0.005), ("N-SF11", 1.78472, 25.68, 0.005), ("fused silica", 1.45846, 67.8, 0.05)],
)
def test_indices_and_abbe_numbers(glass: str, index: float, abbe: float, digits: float, validated) -> None:
    error = abs(refractive_index(glass, D_LINE) - index)
    validated("Radiometry", f"Refractive index n_d of {glass}", error, 6e-6, GLASSES[glass].source, "in n")
    assert abs(abbe_number(glass) - abbe) <= digits + 1e-9


def test_bk7_at_a_laser_s_line() -> None:
    assert refractive_index("N-BK7", 632.8e-9) == pytest.approx(1.51509, abs=6e-6)


# Sultanova, Kasarova, Nikolov, Acta Phys. Pol. A 116, 585 (2009), stated to 0.001.
MEASURED = {436.8: 1.502, 486.1: 1.497, 587.6: 1.491, 632.8: 1.489, 703: 1.486, 833: 1.484, 879: 1.483, 1052: 1.481}


def test_pmma_against_measured_indices(validated) -> None:
    error = max(abs(refractive_index("PMMA", nm * 1e-9) - n) for nm, n in MEASURED.items())
    against = "indices measured by Sultanova et al. (2009), stated to 0.001"
    validated("Radiometry", "Refractive index of PMMA, 437 to 1052 nm", error, 1e-3, against, "in n")


@pytest.mark.parametrize(("nm", "millimetres"), [(640, 100.03), (785, 100.77)])
def test_a_plano_convex_lens_by_its_radius(nm: float, millimetres: float, validated) -> None:
    """LA1509-B: N-BK7, R = 51.5 mm. A plano-convex lens has f = R/(n - 1), whatever its thickness."""
    focal = 51.5 / (refractive_index("N-BK7", nm * 1e-9) - 1)
    what = f"Focal length of Thorlabs LA1509-B at {nm} nm, {millimetres} mm"
    validated("Radiometry", what, abs(focal / millimetres - 1), 1e-4, "R/(n - 1) with R = 51.5 mm", "of it")
    assert focal_length_at(100.03, "N-BK7", 640e-9, nm * 1e-9) == pytest.approx(millimetres, abs=0.01)


@pytest.mark.parametrize("glass", sorted(GLASSES))
def test_normal_dispersion_all_over_the_range(glass: str) -> None:
    known = GLASSES[glass]
    steps = [known.shortest + (known.longest - known.shortest) * i / 400 for i in range(401)]
    indices = [refractive_index(glass, w) for w in steps]
    assert all(b < a for a, b in itertools.pairwise(indices))
    assert all(math.isfinite(n) and 1.3 < n < 2 for n in indices)


@pytest.mark.parametrize("glass", sorted(GLASSES))
def test_wavelengths_without_a_formula_are_refused(glass: str) -> None:
    known = GLASSES[glass]
    for wavelength in (0.99 * known.shortest, 1.01 * known.longest, math.nan, -1.0, math.inf):
        with pytest.raises(InputError, match=rf"wavelength: .* outside of the formula of {glass}; stay within"):
            refractive_index(glass, wavelength)


def test_an_unknown_glass_is_refused() -> None:
    with pytest.raises(InputError, match=r"glass: unknown glass 'BK8'; use N-BK7, N-SF11, fused silica, PMMA"):
        refractive_index("BK8", 640e-9)
    with pytest.raises(InputError, match="glass"):
        focal_length_at(0.1, "BK8", 587e-9, 640e-9)


@given(
    st.sampled_from(sorted(GLASSES)),
    st.floats(1e-3, 1.0),
    st.floats(0.44e-6, 1.05e-6),
    st.floats(0.44e-6, 1.05e-6),
)
def test_focal_lengths_there_and_back(glass: str, focal: float, first: float, second: float) -> None:
    there = focal_length_at(focal, glass, first, second)
    assert focal_length_at(there, glass, second, first) == pytest.approx(focal, rel=1e-12)
    # Red light meets the weaker lens.
    assert (there - focal) * (second - first) >= 0
    assert focal_length_at(focal, None, first, second) == focal
