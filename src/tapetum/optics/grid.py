"""Sampling grids, independent of the fields on them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from tapetum.errors import InputError

__all__ = ["Grid", "lens_numbers"]


@dataclass(frozen=True)
class Grid:
    """A regular grid of `rows` by `columns` sample centres.

    Parameters
    ----------
    rows, columns
        Number of samples along y (down) and x (right).
    pitch
        Distance between neighbouring samples, in metres.
    centre
        (x, y) of the grid's middle, in metres.

    Raises
    ------
    InputError
        For a count below one, or a pitch that is not positive and finite.
    """

    rows: int
    columns: int
    pitch: float
    centre: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1:
            raise InputError(f"needs at least one sample a side, has {self.rows} x {self.columns}", where="grid")
        if not (math.isfinite(self.pitch) and self.pitch > 0):
            raise InputError(f"must be positive, is {self.pitch} m", where="grid.pitch")

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.rows, self.columns

    @property
    def width(self) -> float:
        """Full width along x, in metres, pixel edges included."""
        return self.columns * self.pitch

    @property
    def height(self) -> float:
        """Full height along y, in metres, pixel edges included."""
        return self.rows * self.pitch

    def x(self, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> torch.Tensor:
        """Sample centres along x, in metres, shape [columns]."""
        return _centres(self.columns, self.pitch, self.centre[0], dtype, device)

    def y(self, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> torch.Tensor:
        """Sample centres along y, in metres, shape [rows]."""
        return _centres(self.rows, self.pitch, self.centre[1], dtype, device)

    def __str__(self) -> str:
        size = f"{self.width * 1e3:.4g} x {self.height * 1e3:.4g} mm"
        return f"{self.columns} x {self.rows} samples, {self.pitch * 1e6:.4g} um apart, {size}"


def _centres(count: int, pitch: float, middle: float, dtype: torch.dtype, device: torch.device | str) -> torch.Tensor:
    steps = torch.arange(count, dtype=torch.float64, device=device) - (count - 1) / 2
    return (steps * pitch + middle).to(dtype)


def lens_numbers(focal_length: float, object_distance: float) -> tuple[float, float]:
    """Sensor distance z and its excess x_i over the focal length, in metres (paper, equation 7).

    Raises
    ------
    InputError
        When the object is not farther away than the focal length: there is no real image. For a focal length that is
        not positive and finite.
    """
    if not 0 < focal_length < math.inf:
        what = f"must be positive and finite, is {focal_length:g} m"
        raise InputError(what, where="focal_length", remedy="give metres")
    if math.isnan(object_distance):
        raise InputError("must be positive, is nan m", where="object_distance", remedy="give metres")
    if object_distance <= focal_length:
        raise InputError(
            f"{object_distance:g} m is not beyond the focal length {focal_length:g} m, so nothing can be in focus",
            where="object_distance",
            remedy="move the object farther away or shorten the focal length",
        )
    excess = 0.0 if math.isinf(object_distance) else focal_length**2 / (object_distance - focal_length)
    return focal_length + excess, excess
