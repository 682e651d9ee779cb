"""Choose the samples of a traced lens's passes, measure their error, and refuse what they cannot represent.

Unlike a thin lens, a real one has no closed form to plan by. Efforts are tried from coarse to fine: each computes the
image at some tilts and is compared with the next two. Rays give the error that remains (traced_light).

More than 400 lines, as the steps, their thinning and the error that is stated share the pictures that were tried.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Unpack

import torch

from tapetum.errors import InputError
from tapetum.optics.focus import FocusedLens
from tapetum.optics.grid import Grid
from tapetum.optics.sampling import Plan
from tapetum.simulate.faint import FAINT
from tapetum.simulate.pupil_fits import PupilFits, chebyshev
from tapetum.simulate.surfaces import Mask, Surface
from tapetum.simulate.traced_light import (
    TracedLight,
    TracedScene,
    Way,
    accuracy_above,
    any_angle,
    followed,
    in_air,
    traced_scene,
    without_rim_light,
)
from tapetum.simulate.traced_pass import AT_ONCE_BYTES, TracedGrids, TracedPass

__all__ = ["TracedGroup", "TracedMask", "TracedPlan", "traced_group", "traced_mask"]


@dataclass(frozen=True)
class _Effort:
    """Airy rings of the spot kept, fewest samples over the pupil, and samples over the spot's need."""

    rings: float
    pupil: int
    finer: float


_LADDER = (
    _Effort(10, 72, 1.2),
    _Effort(14, 90, 1.3),
    _Effort(20, 112, 1.4),
    _Effort(28, 140, 1.5),
    _Effort(40, 176, 1.6),
    _Effort(57, 219, 1.7),
    _Effort(80, 272, 1.8),
    _Effort(113, 338, 1.9),
    _Effort(160, 420, 2.0),
    _Effort(226, 520, 2.1),
    _Effort(320, 640, 2.2),
)
# Claimed error over the largest difference between an effort and the next two, of which the second keeps twice as many
# rings. As the rims of the entering and the leaving pupil part, errors rise and fall within a twentieth of the steepest
# tilt: the worst one's error is 1.3 times the largest difference at six tilts in the median of 232 random lenses, and
# 2.6 times or less in 97 %.
_SAFETY = 3.0
# Tilts tried, in fractions of the steepest: up to the first end of every effort, up to the next of those that they
# allow. Head on, where a mirror's return is most sensitive, most are refused.
_TRIED = ((0.0, 0.0), (0.1, 0.125), (0.65, 0.65), (-0.06, -0.08), (-0.24, 0.18), (0.3, -0.4))
_ENDS = (1, 3, 6)
# Share of the accuracy asked for that sampling may take, however much of it the paths' error takes.
_OF_SAMPLING = 0.25
# Error over the accuracy asked for above which planes that cancel each other are not planned again.
_HOPELESS = 5.0
# No more light can return than entered: an excess is aliasing.
_MOST_POWER = 1.03
# Samples of the sensor for each detail of a mask, over the square of an effort's samples over the spot's need:
# their error falls by the fourth power, and has to halve from an effort to the second next.
_DETAILS = 2.5
# Samples of the returning field for each turn of light from the window's edge, over an effort's.
_BETWEEN = 1.5
# Rings of the spot that reach a mask beside it, at least: as many as count where a sensor ends.
_RINGS_BESIDE = 30
# Limits of time and memory.
_MOST_PUPIL, _MOST_SENSOR = 3328, 4096
# Widest fade at the window's edge, in Fresnel zones √(λf): near the axis the phase of the light that the rims diffract
# is stationary, and half of a wide fade over it turns that light's phase more than leaving it out does.
_FADE = 0.7
# Where fewer samples are tried than a step of the ladder has, in fractions of the steepest tilt; the last picture is
# moved by this fraction of its width and height. Shares of a step's samples that are tried, the fewest first.
_ALSO_TRIED = ((0.01, 0.02), (-0.2, 0.1), (0.98, 0.0), (0.3, -0.4))
_MOVED, _SHARES = (0.3, -0.2), (0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
# Angles of light that rays correct, on the way out, for which the rim's light has its samples: at twice the angle the
# coarser efforts were off by 0.010 of the peak.
_TURNED_BY_RAYS = 2.1
# Pictures from which on the search for fewer samples pays: what it takes is saved by one to two hundred of them.
_PAYS_FROM = 300
# Share of the accuracy by which fewer samples may change a picture: tilts that are not tried may change by more.
_CHANGED = 0.15
# Claimed error over the largest difference at these tilts to the finer pass of a step that is accurate enough, and what
# that pass itself is given, over the differences that the step was judged by. Coarser steps that are tried then.
_NEAR, _OWN, _COARSER = 1.25, 1.5, 2
# Share of a step's samples of the sensor that still holds all light, and samples on the way out over those at which
# copies of the picture touch it.
_OF_SENSOR, _ASIDE = 0.85, 1.2


# What samplings are compared by, of a pass at tilts [B, 2] and centres [B, 2]: [B, H, W].
_Seen = Callable[..., torch.Tensor]


@dataclass(frozen=True)
class TracedPlan(Plan):
    """Samples of a traced pass, and their expected error.

    Parameters
    ----------
    columns, rows
        Samples over the pupil.
    sensor
        Samples a side about the spot.
    departure
        RMS of the rays' paths against the model's, in metres, before they correct it.
    by_rays
        Whether they do.
    rim_light
        Whether the picture has what the pupil's rim sends of light far out of focus, see `bench.Sampling`.
    expected_error
        Largest error of the irradiance, in fractions of the image's own peak: that of sampling, 3 times what changes
        over the next two finer samplings, and that of the paths' error as a phase. Infinite where the steepest
        tilt returns nothing. Where it returns less than 0.3 of the most light, its error is stated and may exceed the
        accuracy asked for, which is that of brighter tilts.
    """

    method: ClassVar[str] = "traced lens"
    columns: int
    rows: int
    sensor: int
    departure: float
    by_rays: bool
    rim_light: bool
    expected_error: float

    def bytes_needed(self, batch: int, pixels: int, complex_size: int = 8) -> int:
        samples = 3 * self.columns * self.rows + self.sensor**2
        together = min(48 * batch * samples, max(2 * AT_ONCE_BYTES, 48 * samples))
        return complex_size // 8 * (together + 24 * batch * pixels)


class TracedGroup:
    """Planes of one traced lens whose returns interfere."""

    def __init__(self, passes: Sequence[TracedPass], plan: TracedPlan) -> None:
        self.passes, self.plan = tuple(passes), plan

    def __call__(
        self, sines: torch.Tensor, centres: torch.Tensor | None = None, roll: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Irradiance [B, H, W] in W/m² for 1 W/m² at the target; arguments as for `TracedPass.field`."""
        # Beyond a filter's cut-off a sensor's light is left alone.
        lit = [one for one in self.passes if bool(one.pupil.returns(sines).any())] or self.passes[:1]
        if len(lit) == 1:
            return lit[0](sines, centres, roll)
        u = self.field(sines, centres, roll)
        return u.real**2 + u.imag**2

    def field(
        self, sines: torch.Tensor, centres: torch.Tensor | None = None, roll: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Complex amplitude [B, H, W] on the probe's pixels."""
        total = self.passes[0].field(sines, centres, roll)
        for one in self.passes[1:]:
            total = total + one.field(sines, centres, roll)
        return total


@dataclass(frozen=True)
class TracedMask:
    """A mask's pass as planned, the finer one that its error was measured by, and a mirror's in its place."""

    usual: TracedGroup
    finer: TracedGroup
    mirror: TracedGroup


def traced_group(
    focused: FocusedLens,
    fits: PupilFits,
    surfaces: Sequence[Surface],
    output: Grid,
    *,
    accuracy: float,
    pictures: int,
    **way: Unpack[Way],
) -> TracedGroup:
    """Plan the passes of planes that interfere.

    Parameters
    ----------
    focused, fits
        The lens, and its pupils.
    surfaces
        The planes.
    output
        Pixels of the probe's sensor.
    accuracy
        Wanted largest error of the irradiance, in fractions of the peak.
    pictures
        How many will be asked for, about: where they are many, planning seeks as few samples as will do.
    **way
        The light's, see `Way`.

    Raises
    ------
    InputError
        For a lens that its polynomials do not fit, light too far out of focus to be followed, and scenes too large.
    """
    scene = traced_scene(focused, fits, output, **way)
    # What one plane hardly shows, faint light far from its spot, shows where another plane's light interferes with it.
    seen = _irradiance if len(surfaces) == 1 else _amplitude

    def made(share: float) -> TracedGroup:
        found = [_planned(scene, surface, accuracy, seen, pictures, share) for surface in surfaces]
        passes, plans = [one for one, _ in found], [plan for _, plan in found]
        worst = max(plans, key=lambda plan: plan.expected_error)
        if len(passes) > 1:
            whole = all(plan.rim_light for plan in plans)
            worst = replace(worst, rim_light=whole, expected_error=_together(passes, plans))
        return TracedGroup(passes, worst)

    group = made(1.0)
    if accuracy < (error := group.plan.expected_error) < _HOPELESS * accuracy and len(surfaces) > 1:
        # Each plane's share of the accuracy; steps of the ladder are coarse. Where planes cancel each other it may be
        # out of reach: then the error is stated as it is.
        with contextlib.suppress(InputError):
            group = made(0.7 * accuracy / error)
    return group


def traced_mask(
    focused: FocusedLens,
    fits: PupilFits,
    surface: Surface,
    mask: Mask,
    output: Grid,
    *,
    accuracy: float,
    **way: Unpack[Way],
) -> TracedMask:
    """Plan the passes of a mask on a `surface` without a tilt; other arguments and errors as for `traced_group`.

    The error is in fractions of the picture's peak, or of a thousandth of a mirror's where that is more: `FaintPass`
    computes such faint pictures by the finer pass.
    """
    scene = traced_scene(focused, fits, output, **way)
    light = followed(scene, accuracy, correct=False)
    asked, accuracy = accuracy, _for_samples(light, accuracy)
    tried = light.bright * torch.tensor(_TRIED, dtype=torch.float64)
    # At least as finely as a mirror: the mask may be dark where it is tried.
    mirror = _climbed(lambda effort: _made(scene, light, surface, effort), tried, accuracy, allowed=asked)
    least = FAINT * float((mirror.usual.field(tried[:1]).abs() ** 2).max())
    first = max(mirror.step, next(i for i, effort in enumerate(_LADDER) if effort.rings >= _RINGS_BESIDE))
    found = _climbed(
        lambda effort: _made(scene, light, surface, effort, mask),
        tried,
        accuracy,
        allowed=asked,
        least=least,
        first=first,
    )
    _check_power(found.usual, tried, 1.0)
    plan = _stated(light, replace(found, error=max(found.error, mirror.error)), least)
    wanted = ((found.usual, mask), (found.finer, mask), (mirror.usual, None))
    usual, finer, bare = (
        TracedGroup([_on_grids(scene, light, surface, one.grids, held, trial=False)], plan) for one, held in wanted
    )
    return TracedMask(usual, finer, bare)


class _Attempt:
    """A pass and its pictures [B, H, W], or fields, at the tilts tried: at most of them once the first are near."""

    def __init__(self, one: TracedPass, seen: _Seen, tried: torch.Tensor) -> None:
        self.one, self._seen, self._tried = one, seen, tried
        self._pictures: list[torch.Tensor] = []

    def up_to(self, stage: int) -> torch.Tensor:
        """At the tilts up to that end of `_ENDS`."""
        for end in _ENDS[len(self._pictures) : stage + 1]:
            start = sum(map(len, self._pictures))
            self._pictures.append(self._seen(self.one, self._tried[start:end]))
        return torch.cat(self._pictures[: stage + 1])

    @property
    def all(self) -> torch.Tensor:
        return self.up_to(len(_ENDS) - 1)


@dataclass(frozen=True)
class _Step:
    """A step of the ladder, its pass and the finer one that it was measured against, and its error.

    `seen` are the pictures [B, H, W] of both at the tilts tried, or their fields.
    """

    step: int
    usual: TracedPass
    finer: TracedPass
    error: float
    seen: tuple[torch.Tensor, torch.Tensor]


def _together(passes: Sequence[TracedPass], plans: Sequence[TracedPlan]) -> float:
    """Error of planes that interfere, over the peak of their sum: each amplitude errs by half of what is stated."""
    head_on = torch.zeros(1, 2, dtype=torch.float64)
    fields = [one.field(head_on) for one in passes]
    peak = float((sum(fields[1:], fields[0]).abs() ** 2).max())
    shares = [math.sqrt(float((field.abs() ** 2).max()) / peak) for field in fields]
    return sum(share * plan.expected_error for share, plan in zip(shares, plans, strict=True))


def _irradiance(one: TracedPass, tilts: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
    return one.field(tilts, centres).abs() ** 2


def _amplitude(one: TracedPass, tilts: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
    return one.field(tilts, centres)


def _planned(
    scene: TracedScene, surface: Surface, accuracy: float, seen: _Seen, pictures: int, share: float
) -> tuple[TracedPass, TracedPlan]:
    """A plane's pass, whose sampling may err by a `share` of what its paths' error leaves of the accuracy."""
    scene, surface = in_air(scene, surface)
    light = followed(scene, share * accuracy, surface.orders)
    wanted = share * _for_samples(light, accuracy)
    tried = light.bright * torch.tensor(_TRIED, dtype=torch.float64)
    found = _climbed(
        lambda effort: _made(scene, light, surface, effort),
        tried,
        wanted,
        allowed=accuracy,
        seen=seen,
        remedy=without_rim_light(scene, light.angle),
    )
    if pictures >= _PAYS_FROM:
        found = _thinned(scene, light, surface, found, tried, max(wanted, found.error), seen)
    _check_power(found.usual, tried, sum(order.largest for order in surface.orders) ** 2)
    return _on_grids(scene, light, surface, found.usual.grids, trial=False), _stated(light, found, seen=seen)


def _made(
    scene: TracedScene, light: TracedLight, surface: Surface, effort: _Effort, mask: Mask | None = None
) -> TracedPass:
    """The pass of an effort, to the pixels on which samplings are compared."""
    angle = _angle(light)
    if mask is not None:
        angle = max(angle, any_angle(light.fits))
    focal_length = abs(scene.focused.focal_length)
    sent = angle + scene.seen
    if light.accepted is None:
        # Rays at the rim that miss the probe's aperture turn the rim's light from sample to sample: by no more than
        # the weights of the pupil's edge hold for (`edge_weights`).
        sent = max(sent, (_TURNED_BY_RAYS if light.by_rays else 2) * angle)
    grids = _grids(light.fits, surface, effort, scene.wavelength, sent, scene.seen, focal_length, mask)
    return _on_grids(scene, light, surface, grids, mask)


def _on_grids(
    scene: TracedScene,
    light: TracedLight,
    surface: Surface,
    grids: TracedGrids,
    mask: Mask | None = None,
    *,
    trial: bool = True,
) -> TracedPass:
    """A pass to the pixels on which samplings are compared, or to all."""
    path = scene.trial if trial else scene.path
    return TracedPass(
        light.fits,
        grids,
        surface,
        path,
        wavelength=scene.wavelength,
        accepted=light.accepted,
        orders=None if mask is not None else light.orders,
        mask=mask,
        dtype=path.dtype,
        device=path.device,
    )


def _angle(light: TracedLight) -> float:
    """Largest angle of light that leaves and is kept."""
    return min(light.angle, math.inf if light.accepted is None else 4 * light.accepted)


def _for_samples(light: TracedLight, accuracy: float) -> float:
    """What the paths' error leaves of an accuracy."""
    return max(accuracy - light.unsure, _OF_SAMPLING * accuracy)


def _climbed(
    made: Callable[[_Effort], TracedPass],
    tried: torch.Tensor,
    accuracy: float,
    *,
    allowed: float,
    seen: _Seen = _irradiance,
    least: float = 0.0,
    first: int = 0,
    remedy: str = "",
) -> _Step:
    """The first step of the ladder, from `first` on, whose error at the tilts tried is within the accuracy.

    Errors are over each picture's peak, or over `least` where that is more. Where no step gets there, or one would take
    too many samples, the best one whose error is within what is `allowed`. Where there is none, `remedy` is one more
    that the error names.
    """
    steps: list[_Attempt] = []
    best: _Step | None = None
    for number, effort in enumerate(_LADDER[first:], first):
        try:
            one = made(effort)
        except InputError:
            if best is None:
                raise
            return best
        # Three passes at a time: each holds its grids and kernels.
        steps = [*steps[-2:], _Attempt(one, seen, tried)]
        if len(steps) < 3:
            continue
        limit, error = allowed if best is None else min(allowed, best.error), math.inf
        for stage in range(len(_ENDS)):
            error = _changed([attempt.up_to(stage) for attempt in steps], least)
            if not error <= limit:
                break
        else:
            best = _Step(number - 2, steps[0].one, one, error, (steps[0].all, steps[-1].all))
            if error <= accuracy:
                return best
    if best is not None:
        return best
    error = _changed([attempt.all for attempt in steps], least)
    coarser = f"ask for {accuracy_above(error):g} or more, or " if math.isfinite(error) else ""
    raise InputError(
        f"{accuracy:.2g} of the peak is not reached with {steps[0].one.grids.pupil} samples over the pupil",
        where="sampling.accuracy",
        remedy=f"{coarser}stop the lens down with f_number{remedy}",
    )


def _thinned(
    scene: TracedScene,
    light: TracedLight,
    surface: Surface,
    found: _Step,
    tried: torch.Tensor,
    accuracy: float,
    seen: _Seen,
) -> _Step:
    """A step with as few samples as change no picture beyond the accuracy.

    A step sets all its samples by one effort, most by far for the rings kept: which of them a lens needs is measured
    against the finer pass that the step was measured by, at more tilts, and in a picture that is moved. A coarser step
    may do, too: that pass shows its error better than the coarser ones did by which it was refused.
    """
    tilts = torch.cat([tried, light.bright * torch.tensor(_ALSO_TRIED, dtype=torch.float64)])
    centres = torch.zeros(len(tilts), 2, dtype=torch.float64)
    centres[-1] = torch.tensor(_MOVED, dtype=torch.float64) * torch.tensor([scene.output.width, scene.output.height])

    def at(one: TracedPass, some: Sequence[int] | slice) -> torch.Tensor:
        return seen(one, tilts[some], centres[some])

    also = slice(len(tried), None)
    usual, best = (
        torch.cat([image, at(one, also)]) for image, one in zip(found.seen, (found.usual, found.finer), strict=True)
    )
    own = _OWN / _SAFETY * found.error

    def claim(images: torch.Tensor, finer: torch.Tensor) -> torch.Tensor:
        return _NEAR * _each_apart(images, finer) + own

    for number in range(max(found.step - _COARSER, 0), found.step):
        one = _made(scene, light, surface, _LADDER[number])
        images = at(one, slice(None))
        if (error := float(claim(images, best).max())) <= accuracy:
            found, usual = replace(found, step=number, usual=one, error=error), images
            break
    else:
        found = replace(found, error=max(found.error, float(claim(usual, best).max())))
    grids = found.usual.grids
    # Copies of the picture must stay beside it.
    reach = 2 * light.fits.aperture[1] * (_angle(light) + scene.seen) / scene.wavelength
    apart = min(grids.leaving, math.ceil(_ASIDE * reach))
    # The tilts, those first whose pictures changed too much when tried last: most shares are refused by these alone.
    order = list(range(len(tilts)))

    def error_of(one: TracedPass) -> float:
        """Largest error; infinite once a picture changes too much."""
        error = 0.0
        for some in (order[:1], order[1:3], order[3:]):
            image = at(one, some)
            changed = _each_apart(image, usual[some])
            worst = int(changed.argmax())
            if not float(changed[worst]) <= _CHANGED * accuracy:
                order.insert(0, order.pop(order.index(some[worst])))
                return math.inf
            error = max(error, float(claim(image, best[some]).max()))
        return error

    def fewest(at_share: Callable[[float], TracedGrids], step: _Step) -> _Step:
        for share in _SHARES:
            one = _on_grids(scene, light, surface, at_share(share))
            if (error := error_of(one)) <= accuracy:
                return replace(step, usual=one, error=max(step.error, error))
        return step

    def out(share: float) -> TracedGrids:
        return replace(grids, leaving=max(apart, math.ceil(share * grids.leaving)))

    found = fewest(out, found)
    grids = found.usual.grids
    sensor = math.ceil(_OF_SENSOR * grids.sensor)

    def others(share: float) -> TracedGrids:
        pupil, returning = (math.ceil(share * samples) for samples in (grids.pupil, grids.returning))
        return replace(grids, pupil=pupil, sensor=sensor, returning=returning)

    return fewest(others, found)


def _stated(light: TracedLight, found: _Step, least: float = 0.0, seen: _Seen = _irradiance) -> TracedPlan:
    """The plan of a step, with the error that steep tilts leave and, on top of it, that of the paths."""
    claimed = found.error
    if light.bright < 0.95 * light.steepest:
        faint = light.steepest * torch.tensor([[0.0, 1.0], [0.7, 0.7], [1.0, 0.0]], dtype=torch.float64)
        image, better = (seen(one, faint) for one in (found.usual, found.finer))
        claimed = max(claimed, _SAFETY * _apart(image, better, least))
    grids = found.usual.grids
    return TracedPlan(
        grids.pupil,
        grids.pupil,
        grids.sensor,
        light.departure,
        light.by_rays,
        light.accepted is None,
        claimed + light.unsure,
    )


def _changed(images: Sequence[torch.Tensor], least: float) -> float:
    """The error of the first of three samplings, ever finer, by how much their images [B, H, W] differ."""
    return _SAFETY * max(_apart(*pair, least) for pair in itertools.combinations(images, 2))


def _apart(image: torch.Tensor, better: torch.Tensor, least: float = 0.0) -> float:
    """Largest difference of images [B, H, W] over each one's own peak, or `least`; infinite where one is dark.

    Of fields twice that, as much as it changes their irradiance.
    """
    return float(_each_apart(image, better, least).max())


def _each_apart(image: torch.Tensor, better: torch.Tensor, least: float = 0.0) -> torch.Tensor:
    """As `_apart`, for each image."""
    peak = better.abs().amax((1, 2)).clamp_min(least)
    apart = (2 if better.is_complex() else 1) * (image - better).abs().amax((1, 2))
    return torch.where(peak > 0, apart / peak.clamp_min(1e-30), math.inf)


def _grids(
    fits: PupilFits,
    surface: Surface,
    effort: _Effort,
    wavelength: float,
    angle: float,
    seen: float,
    focal_length: float,
    mask: Mask | None,
) -> TracedGrids:
    """The samples of an effort for a lens and a plane; light leaves at angles up to `angle`, the picture has `seen`."""
    nodes = fits.nodes
    sine, reach = fits.aperture
    at = chebyshev(nodes.places, nodes.count)
    radius = float((at @ fits.radius).min())
    chief = float(((at @ fits.middle) / (at @ fits.radius)).abs().max())
    ring = wavelength / (2 * sine)
    blur = abs(fits.defocus) * sine + fits.aberration
    whole = half = blur + effort.rings * ring
    read, least = sine, effort.pupil
    if fits.part is not None:
        # A place of the spot sends light to a place of the pupil under one angle: what reaches the picture comes from
        # where its own rays meet the plane, and as much beside them as the angles seen make.
        half = min(half, fits.part.landing + seen * focal_length + effort.rings * ring)
        read = min(sine, fits.part.sine)
        chief = min(2 * chief, fits.part.apart) / 2
        least = math.ceil(least * read / sine)
    fade = min(effort.rings * ring / 2, _FADE * math.sqrt(wavelength * focal_length))
    # The return lies about -s, or -s - τ, and is evaluated about s.
    apart = fits.meets(half - fade)
    if len(surface.orders) == 1:
        apart = min(apart, 2 * chief + 2 * math.hypot(*surface.tilt))
    if mask is not None:
        # Its details turn light too, at any tilt.
        apart = 2 * float(((at @ fits.middle) / (at @ fits.radius)).abs().max()) + wavelength / mask.finest
    step = 0.8 * wavelength / (sine + read + 2 * half / radius + apart)
    if mask is not None:
        step = min(step, mask.finest / (_DETAILS * effort.finer**2))
    sensor = math.ceil(2 * half / step)
    turns = 2 * sine * (whole + half) / wavelength
    # Faint light far from the spot comes from the pupil's edges: they need more samples than the rays.
    pupil = max(effort.pupil, math.ceil(effort.finer * (turns + 2 * effort.rings)))
    # Copies of the picture must lie beside it: the sum of the angles seen and sent. The rim's light takes more, and
    # efforts must differ in it for their comparison to see what it errs by.
    leaving = max(effort.pupil, math.ceil(1.05 * effort.finer**1.5 * 2 * reach * angle / wavelength))
    if pupil > _MOST_PUPIL or sensor > _MOST_SENSOR or leaving > _MOST_PUPIL:
        of_mask = "" if mask is None else f"give the mask a coarser pitch than {mask.finest * 1e6:.3g} um, "
        raise InputError(
            f"light spread over {2 * blur * 1e3:.3g} mm of the sensor needs {pupil} samples over the pupil, {sensor} "
            f"over the spot and {leaving} on the way out; allowed are {_MOST_PUPIL}, {_MOST_SENSOR} and {_MOST_PUPIL}",
            where="target",
            remedy=f"{of_mask}focus nearer to the probe, stop the lens down with f_number, or ask for less accuracy",
        )
    # What comes from the window's edge turns fastest: splines that read between samples leave copies of 2 % of it.
    returning = max(least, math.ceil(_BETWEEN * effort.finer * 2 * read * 2 * half / wavelength))
    return TracedGrids(pupil, sensor, half, half - fade, returning, leaving)


def _check_power(one: TracedPass, sines: torch.Tensor, limit: float) -> None:
    pupil, x, y = one.exit_pupil(sines)
    area = (x[:, 1] - x[:, 0]) * (y[:, 1] - y[:, 0])
    gained = (pupil.abs() ** 2).sum((1, 2)) * area / one.entering_power(sines)
    if float(gained.max()) > _MOST_POWER * limit:
        what = f"{float(gained.max()):.3g} times the light that went in would return"
        raise InputError(what, where="sampling", remedy="ask for more accuracy")
