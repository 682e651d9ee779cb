"""The window on the sensor: what its fade takes from the light of a pupil's rim, and gives back."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import fresnel

from tapetum.simulate.spot_window import RimLight, SpotWindow

CHIRP = 1e9


@pytest.mark.parametrize("end", [1e-5, 1e-4, 3e-4])
def test_the_rims_light_beyond_a_window_in_focus_is_fresnels_integral(end: float) -> None:
    """∫ exp(i chirp v²)/v² dv from the end on, by parts."""
    sine, cosine = fresnel(end * math.sqrt(2 * CHIRP / math.pi))
    rest = math.sqrt(math.pi / (2 * CHIRP)) * complex(0.5 - cosine, 0.5 - sine)
    want = np.exp(1j * CHIRP * end**2) / end + 2j * CHIRP * rest
    assert abs(RimLight(CHIRP, 0.0).beyond(end) / want - 1) < 1e-10


def test_out_of_focus_it_is_the_sum_over_the_sensor() -> None:
    """The same integral over v² less the square of where the rim's rays land, by brute force, faded out far away."""
    end, landing = 1e-4, 9e-5
    v = np.linspace(end, 40 * end, 2_000_001)
    faded = np.cos(math.pi / 2 * np.clip(v / (20 * end) - 1, 0, 1)) ** 2
    want = np.trapezoid(faded * np.exp(1j * CHIRP * v**2) / (v**2 - landing**2), v)
    assert abs(RimLight(CHIRP, landing).beyond(end) / want - 1) < 1e-6


def of_the_rim(window: torch.Tensor, v: torch.Tensor, rim: RimLight) -> complex:
    """What a window [N] at places v [N] leaves of the light that comes back to the rim."""
    light = torch.exp(1j * rim.chirp * v**2) / (v**2 - rim.landing**2)
    return complex(torch.trapezoid(window * light, v))


@pytest.mark.parametrize("landing", [0.0, 4e-5])
def test_the_bump_gives_back_what_the_fade_takes(landing: float) -> None:
    """From where the fade begins on: without the bump a tenth of it is lost here."""
    window, rim = SpotWindow(64, 1.2e-4, 7e-5), RimLight(CHIRP / 4, landing)
    v = torch.linspace(window.flat, window.half_width, 200_001, dtype=torch.float64)
    want = rim.beyond(window.flat)
    assert abs(of_the_rim(window.fade_with_rim(v, rim), v, rim) / want - 1) < 1e-3
    assert abs(of_the_rim(window.fade(v), v, rim) / want - 1) > 0.1


def test_no_bump_where_the_rims_rays_land_in_the_fade_or_it_would_turn_many_times() -> None:
    """Where the rays land the integral has no value, and a bump over whole turns would be a mountain."""
    v = torch.linspace(0, 2e-3, 100, dtype=torch.float64)
    inside, narrow = SpotWindow(64, 1.2e-4, 7e-5), SpotWindow(64, 1e-3, 9.4e-4)
    assert torch.equal(inside.fade_with_rim(v, RimLight(CHIRP, 8e-5)), inside.fade(v))
    turned = RimLight(CHIRP, 5e-5)
    assert torch.equal(narrow.fade_with_rim(v, turned), narrow.fade(v))
