"""Grids and the lens maker's relation."""

from __future__ import annotations

import math

import pytest
import torch

from tapetum.errors import InputError
from tapetum.optics.grid import Grid, lens_numbers


def test_samples_lie_about_the_centre() -> None:
    grid = Grid(3, 4, 2e-6, centre=(1e-6, -5e-6))
    assert torch.allclose(grid.x(), torch.tensor([-2e-6, 0.0, 2e-6, 4e-6], dtype=torch.float64))
    assert torch.allclose(grid.y(), torch.tensor([-7e-6, -5e-6, -3e-6], dtype=torch.float64))
    assert grid.shape == (3, 4)
    assert (grid.width, grid.height) == pytest.approx((8e-6, 6e-6))
    assert "4 x 3 samples" in str(grid)


@pytest.mark.parametrize("values", [(0, 4, 1e-6), (4, 0, 1e-6), (4, 4, 0.0), (4, 4, -1e-6), (4, 4, math.nan)])
def test_a_grid_without_samples_or_pitch_is_refused(values: tuple[int, int, float]) -> None:
    with pytest.raises(InputError, match="grid"):
        Grid(*values)


def test_lens_makers_relation() -> None:
    z, excess = lens_numbers(0.1, 5.0)
    assert pytest.approx(1 / 5.0 + 1 / z) == 1 / 0.1
    assert excess == pytest.approx(z - 0.1)
    assert lens_numbers(0.1, math.inf) == (0.1, 0.0)
    with pytest.raises(InputError, match="beyond the focal length"):
        lens_numbers(0.1, 0.1)


@pytest.mark.parametrize(
    ("numbers", "where"),
    [
        ((math.nan, 5.0), "focal_length"),
        ((-0.1, 5.0), "focal_length"),
        ((0.0, 5.0), "focal_length"),
        ((math.inf, math.inf), "focal_length"),
        ((0.1, math.nan), "object_distance"),
        ((0.1, -5.0), "object_distance"),
    ],
)
def test_numbers_of_no_lens_are_refused(numbers: tuple[float, float], where: str) -> None:
    with pytest.raises(InputError, match=where):
        lens_numbers(*numbers)
