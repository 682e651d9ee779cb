"""Rays through a traced lens before a plane: how accurately the light's way back is known, and when it is refused.

The waves take the way out as the reverse of the way in. Real rays measure the error of that, and correct it where each
place of the pupil has one leaving ray (traced_return).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Required, TypedDict

import torch

from tapetum.errors import InputError
from tapetum.optics.focus import FocusedLens
from tapetum.optics.grid import Grid
from tapetum.simulate.order_paths import OrderPaths, order_paths
from tapetum.simulate.probe_path import ProbeAperture, ProbePath, missed_by_chirps
from tapetum.simulate.pupil_fits import PupilFits, fit_pupils, reach_of_rays
from tapetum.simulate.surfaces import Order, Surface
from tapetum.simulate.traced_return import check_return, corrected, rim_error, trace_return

__all__ = [
    "TracedLight",
    "TracedScene",
    "Way",
    "accuracy_above",
    "any_angle",
    "followed",
    "in_air",
    "is_blurred",
    "nearer_by",
    "return_angle",
    "traced_scene",
    "without_rim_light",
]

# Fresnel zones of the cone of light on the plane above which each place of the pupil has one leaving ray.
_GEOMETRIC = 2.5
# Share of the most light that a tilt must return for the claim to hold.
_FADING = 0.3
_LARGEST_MISFIT = 0.02
# Pixels a picture's finest detail on which samplings are compared, and least pitch over the probe's that they are for.
_COMPARED, _FEWER = 3.0, 1.3
# Share of the accuracy that the phase of the rays' paths, RMS, may take before rays correct them.
_CORRECTED_FROM = 0.2
# Angle beyond which no light is followed, over that which the probe's aperture accepts.
_FADED = 4.0
# Share of the accuracy that corrected paths may take before they are fitted at more tilts.
_OF_NODES = 0.3
# RMS of the paths of light that leaves by other places than a mirror's, over that of a mirror's: 0.7 to 1.7 times as
# much in the zoom at six focal lengths and focuses. Share of the accuracy that an array's orders may err by before they
# get paths of their own.
_OF_ASIDE, _OF_ORDERS = 2.0, 0.1
# How far aside of a mirror's light that of an order may land, over the spot's part whose light is accepted, where that
# part alone is followed.
_ASIDE = 0.25
# RMS of the rays' paths against the model's, in wavelengths, beyond which no accuracy is claimed.
_LARGEST_DEPARTURE = 0.05


class Way(TypedDict, total=False):
    """The light's way: `wavelength` and `probe_focal_length` in metres, which must be given; `curvature` of the light
    that enters, in 1/m; the probe's `aperture`, where the return overfills it; `rim_light` as a scene's sampling has
    it; `dtype` and `device` of the fields."""

    wavelength: Required[float]
    probe_focal_length: Required[float]
    curvature: float
    aperture: ProbeAperture | None
    rim_light: bool
    dtype: torch.dtype
    device: torch.device | str


def any_angle(fits: PupilFits) -> float:
    """Largest angle, in radians, of light that comes from anywhere in the spot's rays and leaves the pupil anywhere."""
    sine, reach = fits.aperture
    return 2 * fits.spread * sine / reach


def return_angle(focused: FocusedLens, fits: PupilFits, depths: Sequence[float], curvature: float) -> float:
    """Largest angle of a ray that returns from the sensor, or from a mirror at one of the depths, reduced to air."""
    sines = torch.linspace(0, fits.nodes.steepest, 3, dtype=torch.float64)
    found = [trace_return(nearer_by(focused, depth), sines, curvature=curvature).angle for depth in depths]
    return max(float(one.max()) for one in found)


def nearer_by(focused: FocusedLens, depth: float) -> FocusedLens:
    """The lens with its sensor moved to a mirror before it."""
    return replace(focused, image=focused.image - depth)


@dataclass(frozen=True)
class TracedScene:
    """The lens, and its light's way to the pixels of `output`. Lengths in metres, `curvature` in 1/m.

    `path` leads to these pixels, `trial` to the fewer ones on which samplings are compared. Light under angles above
    `accepted` misses the probe's aperture, and may be left out but for what the rim sends, where `rim_light` is not
    kept. `seen` is the largest angle from the picture's middle to its corner, or to the aperture's edge.
    """

    focused: FocusedLens
    fits: PupilFits
    path: ProbePath
    trial: ProbePath
    output: Grid
    wavelength: float
    curvature: float
    accepted: float | None
    seen: float
    rim_light: bool


@dataclass(frozen=True)
class TracedLight:
    """Light that is followed off one plane.

    `fits` are its pupils, `by_rays` whether rays correct them, for light up to the angle `accepted`; `orders` the paths
    of the plane's orders, where they have their own; `departure` the RMS of the rays' paths against the model's in
    metres; `unsure` the error of what is left of it, of which `rims` is the `rim_error`; `angle` the largest at which
    light leaves, and `bright` and `steepest` the sines of the steepest tilts for which the claim is made, and that is
    asked for.
    """

    fits: PupilFits
    by_rays: bool
    accepted: float | None
    orders: OrderPaths | None
    departure: float
    unsure: float
    rims: float
    angle: float
    bright: float
    steepest: float


def is_blurred(fits: PupilFits, wavelength: float) -> bool:
    """Whether a plane is so far out of focus that each place of the pupil has one leaving ray."""
    return abs(fits.defocus) * fits.aperture[0] ** 2 / wavelength > _GEOMETRIC


def traced_scene(
    focused: FocusedLens,
    fits: PupilFits,
    output: Grid,
    *,
    wavelength: float,
    probe_focal_length: float,
    curvature: float = 0.0,
    aperture: ProbeAperture | None = None,
    rim_light: bool = True,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str = "cpu",
) -> TracedScene:
    """The scene of a lens, its pupils and its light's way, see `Way`.

    Raises InputError for a lens that its polynomials do not fit.
    """
    if fits.misfit > _LARGEST_MISFIT * wavelength:
        raise InputError(
            f"its wavefront departs from smooth functions by {fits.misfit / wavelength:.2g} waves",
            where="target.lens",
            remedy="stop it down with f_number, or stay nearer to the middle of its field",
        )
    # A few places of a pupil of this width determine its effect on the picture.
    ends = 1.3 * fits.aperture[1] * torch.tensor([-1.0, 1.0], dtype=torch.float64, device=device)

    def to(pixels: Grid) -> ProbePath:
        return ProbePath(
            pixels,
            ends,
            ends,
            wavelength=wavelength,
            probe_focal_length=probe_focal_length,
            aperture=aperture,
            dtype=dtype,
            device=device,
        )

    path, few = to(output), _compared(output, wavelength * probe_focal_length / (4 * fits.aperture[1]))
    seen = math.hypot(output.width, output.height) / 2 / probe_focal_length
    accepted = None
    if aperture is not None:
        # Light under larger angles misses the probe's aperture, at any place in the picture.
        accepted = seen = (aperture.radius + fits.aperture[1]) / float(aperture.distance)
    trial = path if few is output else to(few)
    return TracedScene(focused, fits, path, trial, output, wavelength, curvature, accepted, seen, rim_light)


def _compared(output: Grid, detail: float) -> Grid:
    """Pixels on which a picture without details finer than this (metres, by Nyquist) errs by as much as on `output`.

    The picture's middle is one of them.
    """
    pitch = detail / _COMPARED
    if pitch < _FEWER * output.pitch:
        return output
    rows, columns = (2 * math.floor(wide / 2 / pitch) + 1 for wide in (output.height, output.width))
    return Grid(rows, columns, pitch)


def in_air(scene: TracedScene, surface: Surface) -> tuple[TracedScene, Surface]:
    """A plane before the sensor as one in air: nearer by its reduced depth t/n, on a path that is shorter by n t."""
    if not surface.depth:
        return scene, surface
    nearer = surface.depth / surface.index
    focused, nodes = nearer_by(scene.focused, nearer), scene.fits.nodes
    fits = fit_pupils(focused, nodes.steepest, curvature=scene.curvature, nodes=nodes)
    longer = 4 * math.pi / scene.wavelength * (surface.index * surface.depth - nearer)
    surface = replace(surface, depth=0.0, index=1.0, phase=-longer)
    return replace(scene, focused=focused, fits=fits), surface


def accuracy_above(error: float) -> float:
    """An error to two digits that is no smaller: what may be asked for instead."""
    digit = 10 ** (math.floor(math.log10(error)) - 1)
    return math.ceil(error / digit) * digit


def _corrected(scene: TracedScene, accepted: float | None, wanted: float) -> PupilFits | None:
    """The scene's pupils with the paths of rays, fitted at more tilts where their phase errs by more than is wanted."""
    focused, fits, curvature = scene.focused, scene.fits, scene.curvature
    found = corrected(focused, fits, curvature=curvature, accepted=accepted)
    if found is None or 2 * math.pi * found.misfit / scene.wavelength <= wanted:
        return found
    # The paths of the tilts that return may change too fast for so few nodes. More of them cost less than the finer
    # sampling that the rest of the accuracy would ask for.
    nodes = found.nodes.denser()
    again = fit_pupils(focused, nodes.steepest, curvature=curvature, nodes=nodes)
    again = corrected(focused, again, curvature=curvature, accepted=accepted, nodes=nodes)
    return again if again is not None and again.misfit < found.misfit else found


def followed(scene: TracedScene, accuracy: float, orders: Sequence[Order] = (), *, correct: bool = True) -> TracedLight:
    """Follow rays off the sensor as off a mirror, and refuse light whose paths are not known well enough.

    Only what a plane returns by rays can be corrected by them: not what a mask scatters. `orders` are the plane's, a
    mirror's by default.
    """
    focused, fits, wavelength = scene.focused, scene.fits, scene.wavelength
    # The rim sends light straight on from wherever it lies, and head on as much as all rays do.
    accepted = None if scene.rim_light else scene.accepted
    blurred = is_blurred(fits, wavelength)
    sines = torch.linspace(0, 0.95 * fits.nodes.steepest, 6, dtype=torch.float64)
    told = check_return(focused, fits, sines, curvature=scene.curvature)
    departure = float(torch.nan_to_num(told.opd).max())
    angle = float(told.angle.max())
    # A phase error changes a picture by at most as much.
    unsure = 2 * math.pi * departure / wavelength
    if accepted is not None:
        # Even through a small aperture waves come from some Fresnel zones about the ray that returns straight. For a
        # return that spreads as if from L behind the pupil, L its radius over the angle, the first zone ends where rays
        # turn by √(λ/L): light fades out from twice that, the fourth zone, to four times, the sixteenth.
        accepted = max(accepted, math.sqrt(wavelength * angle / fits.aperture[1]))
        if angle <= 2 * accepted:
            # No ray leaves under an angle that is faded out: follow the whole pupil, and waves beyond its rays.
            accepted = None
    pupils, by_rays = fits, False
    others = _deflected(scene, orders) if correct else []
    # In the far field the picture's middle is what the rim diffracts along the axis, on the paths of the model, and the
    # rays' paths would spoil it.
    near = scene.path.aperture is not None
    far_out = near and blurred and (unsure > _CORRECTED_FROM * accuracy or (accepted and angle > _FADED * accepted))
    allowed = min(accuracy, 2 * math.pi * _LARGEST_DEPARTURE)
    if correct and far_out:
        # Where light is followed up to the angle of the last ray in any case, the whole pupil's paths are better known:
        # a part of it holds nothing of what its rim diffracts.
        limits = [None, accepted] if accepted and angle <= _FADED * accepted else [accepted]
        if accepted and _aside(scene, others) > _ASIDE * accepted * abs(focused.focal_length):
            # The light of an order that reaches the aperture comes from elsewhere in the spot than a mirror's.
            limits = [None]
        for limit in limits:
            found = _corrected(scene, limit, _OF_NODES * allowed)
            # Crossing rays have several paths at a place, which the fit misses.
            if found is not None and (left := 2 * math.pi * found.misfit / wavelength) < unsure:
                pupils, by_rays, unsure, accepted = found, True, left, limit
                if unsure <= allowed:
                    break
    if not by_rays:
        accepted = None
    aside = 2 * math.pi * _OF_ASIDE * departure / wavelength
    if not correct:
        # A mask sends light to all of the pupil.
        unsure = aside
    weight, paths = _weight(others, fits.aperture[0]), None
    if near and blurred and aside * weight > _OF_ORDERS * accuracy:
        paths = order_paths(focused, pupils, curvature=scene.curvature)
        aside = 2 * math.pi * (paths.misfit + paths.between) / wavelength
    unsure += aside * weight
    # Near the cut-off the peak fades with the returning light, the error with the entering light: the claim is for
    # tilts that return enough.
    lit = float(sines[told.overlap >= _FADING * told.overlap.max()].max())
    rims = _of_rims(scene, pupils, sines[sines <= lit], accepted) if by_rays else 0.0
    unsure += rims
    coarser = (
        f"ask for an accuracy of {accuracy_above(unsure):g}, " if unsure <= 2 * math.pi * _LARGEST_DEPARTURE else ""
    )
    if unsure > allowed:
        what = f"light does not come back the way it went, by {unsure / 2 / math.pi:.2g} waves"
        if rims > unsure / 2:
            what = f"the rims that cut its light lie at different depths, which may change the peak by {rims:.2g}"
        raise InputError(
            what,
            where="target",
            remedy=f"{coarser}focus nearer to the probe, or stop the lens down with f_number"
            + without_rim_light(scene, angle),
        )
    steepest = fits.nodes.steepest
    if scene.path.aperture is not None:
        aperture, reach = scene.path.aperture, reach_of_rays(fits)
        missed = missed_by_chirps(
            float(aperture.distance), aperture.radius, reach=reach, angle=angle, sine=steepest, wavelength=wavelength
        )
        if missed > accuracy:
            raise InputError(
                f"the probe is so near that the way to its aperture is known to {missed:.2g} of the peak only",
                where="distance",
                remedy=f"ask for an accuracy of {accuracy_above(missed):g}, move the probe away, or narrow its "
                "aperture",
            )
        unsure += missed
    bright = min(lit, pupils.nodes.steepest)
    return TracedLight(pupils, by_rays, accepted, paths, departure, unsure, rims, angle, bright, steepest)


def without_rim_light(scene: TracedScene, angle: float) -> str:
    """A remedy for light that leaves under angles up to this: to leave the rim's light out, where that is possible."""
    if not scene.rim_light or scene.accepted is None or angle <= _FADED * scene.accepted:
        return ""
    return ", or leave out what the rim sends with sampling.rim_light=false"


def _of_rims(scene: TracedScene, pupils: PupilFits, sines: torch.Tensor, accepted: float | None) -> float:
    """The `rim_error` of light up to the angle `accepted`."""
    aperture = scene.path.aperture
    assert aperture is not None
    return rim_error(
        scene.focused,
        scene.fits,
        pupils,
        sines,
        wavelength=scene.wavelength,
        distance=float(aperture.distance),
        probe_radius=aperture.radius,
        curvature=scene.curvature,
        accepted=accepted,
    )


def _deflected(scene: TracedScene, orders: Sequence[Order]) -> list[tuple[float, float]]:
    """Sines of the orders that a mirror does not have and that return, and the changes of the peak for a phase of 1."""
    fits = scene.fits
    within = fits.meets(abs(fits.defocus) * fits.aperture[0] + fits.aberration)
    most = max((abs(order.amplitude) for order in orders), default=0.0)
    return [
        (size, 1.0 if abs(order.amplitude) == most else 2 * abs(order.amplitude) / most)
        for order in orders
        if 0 < (size := math.hypot(*order.direction)) < within
    ]


def _aside(scene: TracedScene, others: Sequence[tuple[float, float]]) -> float:
    """How far aside of a mirror's light that of an order lands, in metres, where both go straight back to the probe."""
    return max((abs(scene.fits.defocus) * size / 2 for size, _ in others), default=0.0)


def _weight(others: Sequence[tuple[float, float]], sine: float) -> float:
    """Change of the peak for phases of 1 rad RMS of orders deflected by `sine`, in proportion for smaller ones.

    Orders take different paths, whose errors add as squares.
    """
    return math.hypot(*(share * min(1.0, size / sine) for size, share in others))
