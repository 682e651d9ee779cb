"""A thin lens as the sampled pass sees it: directions are linear in columns and rows, the same for all gazes.

The quadratic phases of lens and free space are removed before sampling; defocus and a tilt remain (paper, equations 1
to 6, in the form of docs/conventions.md, "The double pass"). A sample at x has the direction -x/z.
"""

from __future__ import annotations

import torch

from tapetum.optics.fourier import phasor
from tapetum.optics.grid_sampling import SamplingPlan
from tapetum.optics.pupil import Quadrature
from tapetum.optics.sampling import DoublePassGeometry
from tapetum.simulate.foreshortening import cosines, foreshortening, foreshortens, tangents
from tapetum.simulate.probe_path import ProbePath
from tapetum.simulate.pupils import Entering, Leaving
from tapetum.simulate.true_paths import Leg, TruePaths

__all__ = ["ThinPupil"]


class ThinPupil:
    """The pupil of a thin lens.

    Parameters
    ----------
    geometry, plan
        Lengths of the scene, as numbers, and its grids.
    disc
        Samples of the aperture and their weights.
    focal_length, image_distance
        In metres, float64 scalars, which may carry gradients.
    path
        From the disc's columns and rows to the probe's pixels.
    paths
        Paths to follow beyond those of the paraxial lens.
    dtype
        Of the fields.
    """

    fixed, rim = True, None

    def __init__(
        self,
        geometry: DoublePassGeometry,
        plan: SamplingPlan,
        disc: Quadrature,
        focal_length: torch.Tensor,
        image_distance: torch.Tensor,
        path: ProbePath,
        paths: TruePaths | None = None,
        *,
        dtype: torch.dtype = torch.complex64,
    ) -> None:
        self.geometry, self.plan, self.path, self.paths, self.dtype = geometry, plan, path, paths, dtype
        device = path.device
        self.x, self.y, self.z = disc.x.to(device), disc.y.to(device), image_distance
        weights, square = disc.weights.to(device), disc.rho_squared().to(device)
        defocus = (1 / image_distance - 1 / focal_length) / 2 * square
        self.columns, self.rows = -self.x[None] / image_distance, -self.y[None] / image_distance
        # The way in includes all constants, so that the hot loop has only products and phases.
        strength = weights * (path.constant / image_distance**2)
        entering = defocus + geometry.curvature / 2 * square
        # Round light: a quarter of the disc stands for the whole, its rows and columns in the middle for half.
        right, down = slice(len(self.x) // 2, None), slice(len(self.y) // 2, None)
        share = _halved_middle(len(self.y))[:, None] * _halved_middle(len(self.x))
        quarter = strength[down, right] * share.to(device)
        columns, rows = self.columns[:, right], self.rows[:, down]
        self.entering = Entering(columns, rows, quarter[None], entering[None, down, right], (True, True))
        k = 2 * torch.pi / geometry.wavelength
        self.exit = (weights * phasor(k * defocus + path.chirp * square)).to(dtype)

    def meets(self, farthest: float) -> float:
        """Infinite: the samples hold all light that misses the pupil."""
        return torch.inf

    def returns(self, sines: torch.Tensor) -> torch.Tensor:
        """Whether anything returns from tilts [B, 2]: diffracted light from all."""
        return torch.ones(len(sines), dtype=torch.bool, device=sines.device)

    def foreshortens(self, sines: torch.Tensor) -> torch.Tensor:
        """Which tilts [B, 2] are drawn foreshortened."""
        return foreshortens(self, sines)

    def gazes(self, sines: torch.Tensor, own: bool, roll: torch.Tensor | None = None) -> _ThinGazes:
        """Itself under tilts [B, 2]; its pictures are turned after they are computed, so there is no `roll`."""
        assert roll is None, "Camera.render refuses it"
        return _ThinGazes(self, sines, own)


class _ThinGazes:
    """A thin lens under a batch of tilts. The lens is round, so a mirror's frame may follow the probe's picture."""

    def __init__(self, pupil: ThinPupil, sines: torch.Tensor, own: bool) -> None:
        self._pupil, self._sines, self._own = pupil, sines, own
        self._shortened = bool(pupil.foreshortens(sines).any())
        if self._shortened and not own:
            self.axes = foreshortening(sines)[0].mT
        else:
            self.axes = torch.eye(2, dtype=torch.float64, device=sines.device).expand(len(sines), 2, 2)
        self._slopes = tangents(sines)
        self.place = pupil.z * self._slopes
        self.turn = self._framed(self._slopes)
        self.middle = torch.zeros_like(self.turn)
        self.bend = (1 / pupil.z).reshape(1)

    def entering(self) -> Entering:
        """The light on its way in."""
        return self._pupil.entering

    def leaving(self) -> Leaving:
        """The pupil on the way out."""
        one = self._pupil
        wave = one.exit * torch.sqrt(cosines(self._sines))[:, None, None].to(one.dtype)
        if one.paths is not None:
            leg = Leg(self._framed(self._sines), self.turn, torch.zeros_like(self.turn), one.z.expand(len(self._sines)))
            wave = wave * one.paths(one.x, one.y, leg, one.z)[2].to(one.dtype)
        return Leaving(one.columns, one.rows, wave, one.x[None], one.y[None])

    def to_probe(
        self,
        field: torch.Tensor,
        x: torch.Tensor,
        y: torch.Tensor,
        centres: torch.Tensor | None,
        *,
        squared: bool = False,
    ) -> torch.Tensor:
        """Field on the probe's pixels [B, H, W], or its square; the columns x and rows y are the path's own."""
        path, sines = self._pupil.path, self._sines
        # A tilted pupil's light spreads over a foreshortened picture.
        field = field * torch.sqrt(cosines(sines))[:, None, None].to(field.dtype)
        if self._own and (self._shortened or path.aperture is not None):
            gathered = path.gather_unturned(field, sines, centres)
        else:
            half, triangle = slice(0, (y.shape[-1] + 1) // 2), None
            if self._shortened:
                triangle = foreshortening(sines)[1]
            upper, lower = field[:, half], field.flip(1)[:, half]
            gathered = path.gather([path.pairs(upper, lower, half, slice(None), centres, triangle)], triangle)
        return path.to_image(gathered, centres, squared=squared)

    def _framed(self, vectors: torch.Tensor) -> torch.Tensor:
        return (self.axes @ vectors[..., None])[..., 0]


def _halved_middle(count: int) -> torch.Tensor:
    """Weights of the samples from the middle of `count` on: 1, and one half for a sample in the middle."""
    weights = torch.ones(count - count // 2, dtype=torch.float64)
    if count % 2:
        weights[0] = 0.5
    return weights
