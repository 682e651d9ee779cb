"""Passes of a traced lens on the samples that were planned for another one, which differs by little from it.

So errors of sampling nearly cancel in the difference of the two pictures, and planning is saved.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

import torch

from tapetum.errors import InputError
from tapetum.optics.focus import FocusedLens
from tapetum.optics.grid import Grid
from tapetum.simulate.order_paths import OrderPaths, order_paths
from tapetum.simulate.probe_path import ProbePath
from tapetum.simulate.pupil_fits import PupilFits, fit_pupils
from tapetum.simulate.surfaces import Surface
from tapetum.simulate.traced_light import TracedScene, Way, in_air, traced_scene
from tapetum.simulate.traced_pass import TracedPass
from tapetum.simulate.traced_plan import TracedGroup
from tapetum.simulate.traced_return import corrected

__all__ = ["group_again", "pass_again", "tilts_like"]

# Newton's steps, and the step of their slopes in sines.
_STEPS, _SMALL = 5, 1e-6


def group_again(
    group: TracedGroup,
    focused: FocusedLens,
    fits: PupilFits,
    surfaces: Sequence[Surface] | None,
    output: Grid,
    *,
    same_lens: bool,
    **way: Unpack[Way],
) -> TracedGroup:
    """The passes of another lens, or of as many other planes, on the samples of `group`.

    Arguments are those of `traced_group`; `fits` have the tilts of those that `group` was planned with. `same_lens`
    says that lens, focus and wavelength are those of `group`. Without `surfaces` lens and planes are its own, and only
    the pixels are others. Raises as `traced_scene`, and an InputError where too
    little light comes back.
    """
    scene = traced_scene(focused, fits, output, **way)
    if surfaces is None:
        again = [pass_again(one, (one.fits, one.orders), one.surface, scene.path) for one in group.passes]
        return TracedGroup(again, group.plan)
    made: list[TracedPass] = []
    for one, surface in zip(group.passes, surfaces, strict=True):
        if same_lens and not surface.depth:
            made.append(pass_again(one, (one.fits, one.orders), surface, scene.path))
            continue
        at, plane = in_air(scene, surface)
        made.append(pass_again(one, _fits(at, one), plane, scene.path))
    return TracedGroup(made, group.plan)


def pass_again(
    one: TracedPass, lens: tuple[PupilFits, OrderPaths | None], surface: Surface, path: ProbePath
) -> TracedPass:
    """The samples of a pass with another lens, plane or way to the probe."""
    fits, orders = lens
    return TracedPass(
        fits,
        one.grids,
        surface,
        path,
        wavelength=one.wavelength,
        accepted=one.accepted,
        orders=orders,
        dtype=one.dtype,
        device=one.device,
    )


def _fits(scene: TracedScene, one: TracedPass) -> tuple[PupilFits, OrderPaths | None]:
    """The pupils of another lens, and the paths of its orders, as `followed` found those of a pass."""
    fits, before = scene.fits, one.fits.corrected_from
    if before is not None:
        if before != fits.nodes:
            fits = fit_pupils(scene.focused, before.steepest, curvature=scene.curvature, nodes=before)
        nodes = one.fits.nodes
        fits = corrected(scene.focused, fits, curvature=scene.curvature, accepted=one.accepted, nodes=nodes)
        if fits is None:
            what = "too little light comes back to compute how it changes with the focus"
            raise InputError(what, where="target", remedy="focus nearer to the probe, or stop down with f_number")
    return fits, one.orders and order_paths(scene.focused, fits, curvature=scene.curvature)


def tilts_like(own: PupilFits, wanted: PupilFits, sines: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    """Tilts [B, 2] whose spots lie where `wanted` has those of the tilts `sines` [B, 2], moved by `shift` [2] metres.

    The map from gazes to tilts does not serve here: it is fitted anew for every lens, and what its fits differ by is
    much for photosites, of which a hundredth is seen.
    """
    size = torch.sqrt((sines**2).sum(-1, keepdim=True))
    place = sines / size.clamp_min(1e-300) * _middle(wanted, size) + shift
    to = torch.sqrt((place**2).sum(-1, keepdim=True))
    found = size
    for _ in range(_STEPS):
        slope = (_middle(own, found + _SMALL) - _middle(own, found - _SMALL)) / (2 * _SMALL)
        found = found + (to - _middle(own, found)) / slope
    return place / to.clamp_min(1e-300) * found


def _middle(fits: PupilFits, size: torch.Tensor) -> torch.Tensor:
    """Distance [B, 1] of the spots of tilts with these sines [B, 1] from the axis."""
    return (fits.nodes.terms(size[:, 0]) * fits.middle.to(size.device)).sum(-1, keepdim=True)
