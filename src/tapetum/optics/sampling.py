"""Choose the samples of a round pass from the scene and a wanted accuracy, and state the expected error.

Three numbers decide the error (docs/conventions.md, "Sampling", shows how they were measured):

- the phase step of the light between two samples of the pupil, along its rays, in radians: π is the Nyquist limit;
- how many Airy rings of the spot on the sensor are kept whole: light farther out, diffracted steeply by the pupil's
edge, is faded out;
- the phase step of that diffracted light. It is faint, so a little of it may fold.

One file of more than 400 lines: the ladder, what it states and what it refuses were calibrated together.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Protocol, TypeVar, cast

from tapetum.errors import InputError

__all__ = [
    "ACCURACIES",
    "HOLDS_RIM",
    "REFERENCE",
    "RIM",
    "DoublePassGeometry",
    "Fade",
    "Plan",
    "RoundEffort",
    "RoundPlan",
    "aperture_samples",
    "check_aperture",
    "check_table",
    "disc_overlap",
    "plan_aside",
    "plan_round",
    "plan_round_with",
    "step_for",
    "through_aperture",
]


@dataclass(frozen=True)
class DoublePassGeometry:
    """The lengths that decide the sampling of a retro-reflection. All in metres except `sine`.

    Parameters
    ----------
    wavelength, radius, focal_length, image_distance
        Of the light, and of the target's lens: aperture radius, f, and z = f + x_i.
    probe_focal_length
        f_p.
    window
        Half-diagonal of the wanted image on the probe's sensor, from the middle of the RR.
    sine
        Largest sine of the tilt.
    curvature
        1/R of the illuminating wave at the target, in 1/m: 0 for collimated light, 1/distance from a point.
    lit_radius
        Of a beam narrower than the lens.
    """

    wavelength: float
    radius: float
    focal_length: float
    image_distance: float
    probe_focal_length: float
    window: float
    sine: float = 0.0
    curvature: float = 0.0
    lit_radius: float = math.inf

    @property
    def tangent(self) -> float:
        """Tangent of the largest tilt, which sets the slopes behind the lens."""
        return self.sine / math.sqrt(1 - self.sine**2)

    @property
    def spot_radius(self) -> float:
        """Geometric radius of the light on the target's sensor."""
        return self.radius * abs(1 - self.image_distance * (1 / self.focal_length - self.curvature))

    @property
    def airy_step(self) -> float:
        """Ring spacing λz/2r of the Airy pattern on the target's sensor."""
        return self.wavelength * self.image_distance / (2 * self.radius)

    @property
    def return_radius(self) -> float:
        """Geometric radius of the returning light at the lens, before the aperture clips it."""
        z, f = self.image_distance, self.focal_length
        return self.radius * abs(1 - 2 * z * (1 / f - self.curvature))

    @property
    def picture_angle(self) -> float:
        """Geometric half-angle that holds the rays of the returning beam at any tilt, in radians.

        Light that meets the sensor r|1/R - 1/f + 1/z| z off its spot's centre may leave the lens anywhere.
        """
        out = abs(1 / self.image_distance - 1 / self.focal_length)
        return self.radius * (out + abs(self.curvature - 1 / self.focal_length + 1 / self.image_distance))

    @property
    def returning(self) -> float:
        """Share of the returning light that leaves the aperture again, by rays: 1 at zero tilt, 0 past the cut-off."""
        lit = min(1.0, self.lit_radius / self.radius) * self.return_radius
        return disc_overlap(lit, self.radius, 2 * self.image_distance * self.tangent)

    @property
    def exit_angle(self) -> float:
        """Half-angle of the rays of the returning beam, geometric, in radians."""
        z, f = self.image_distance, self.focal_length
        slope_in = 1 / f - self.curvature
        gain = 1 - 2 * z * slope_in
        # A ray that entered at x returns at gain·x with slope -slope_in·x, and the lens bends it once more. Where all
        # rays return through the lens's middle, gain = 0, they keep that slope.
        return self.radius * abs(slope_in + gain / f) / max(1.0, abs(gain))

    @property
    def own_slope(self) -> float:
        """The steepest slope of a ray against the pupil, before or after it."""
        bend = 1 / self.image_distance - 1 / self.focal_length + self.curvature
        return max(self.radius * abs(bend), self.exit_angle)

    @property
    def ray_slope(self) -> float:
        """The steepest slope of a ray against the pupil, before or after it, from the picture's edge."""
        bend = 1 / self.image_distance - 1 / self.focal_length + self.curvature
        return max(self.radius * abs(bend), self.exit_angle + self.window / self.probe_focal_length)

    @property
    def fading(self) -> float:
        """Growth of errors near the cut-off, 1 or more; infinite past it.

        The peak fades with the returning light, the error with the entering light.
        """
        returning = self.returning
        return max(1.0, _FADING / returning if returning else math.inf)


class Plan(ABC):
    """Samples of a pass: a dataclass whose numbers are an image's metadata."""

    method: ClassVar[str] = ""
    columns: int
    rows: int
    expected_error: float

    @abstractmethod
    def bytes_needed(self, batch: int, pixels: int, complex_size: int = 8) -> int:
        """Memory that a batch of gazes takes, in bytes, for an image of `pixels` pixels."""

    def as_dict(self) -> dict[str, float | int | str]:
        """The plan's numbers by name, for metadata."""
        numbers = asdict(cast(Any, self))
        return {"method": self.method, **numbers} if self.method else numbers


class _Erring(Protocol):
    @property
    def error(self) -> float: ...


Step = TypeVar("Step", bound=_Erring)


def step_for(ladder: Sequence[Step], accuracy: float) -> Step:
    """The first step of a ladder, from coarse to fine, whose error is within the accuracy.

    Raises InputError for an accuracy finer than the last step's.
    """
    finest = ladder[-1].error
    if not accuracy >= finest:
        raise InputError(
            f"{accuracy:g} of the peak is finer than the engine's {finest:g}",
            where="accuracy",
            remedy=f"ask for {finest:g} or more",
        )
    return next(step for step in ladder if step.error <= accuracy)


@dataclass(frozen=True)
class RoundEffort:
    """How finely an accuracy is sampled: its error in fractions of the peak, Airy rings kept, radians between two
    samples along the rays and along the faintest light kept, and the slopes kept over the rays' own, before
    what the picture's width adds."""

    error: float
    rings: float
    ray_radians: float
    tail_radians: float
    spread: float = 0.0


# Measured on random scenes against the same computation at the reference's effort: tests/optics/test_sampling.py.
_LADDER = (
    RoundEffort(1e-2, 60, 1.5, 4.5, 3.0),
    RoundEffort(3e-3, 120, 1.3, 4.0, 3.5),
    RoundEffort(1e-3, 240, 1.05, 4.0, 4.5),
    RoundEffort(3e-4, 480, 0.9, 3.2, 5.5),
    RoundEffort(1e-4, 800, 0.8, 3.0, 7.0),
)
REFERENCE = RoundEffort(0.0, 800, 0.65, 2.5, 10.0)
# Light that the rim diffracts straight on meets the sensor at r/z from the axis and returns to the rim; at zero tilt
# all of it meets in the middle of the picture. Its share of the peak is about this times the spot's radius over the
# lens's (measured). A fade that ends at this many times r/z holds it.
RIM, HOLDS_RIM = 0.02, 1.4
# Most rings kept for it, over the effort's own; where they do not suffice, the loss is stated.
_MOST_FOR_RIM = 3
# Share of the error that the rim's light may take where it is not sampled, under a tilt.
_SHARE_OF_RIM = 0.1
# Efforts of the light in the probe's aperture, where it propagates that far.
_AT_APERTURE = RoundEffort(0.0, 0.0, 1.2, 4.0)
ACCURACIES = tuple(step.error for step in _LADDER)
# Rows at Gauss-Chebyshev nodes lie π/2 further apart in the middle than equally spaced ones. There the phase changes
# least, so about as many rows as columns suffice (measured).
_ROWS_A_COLUMN = 1.05
# Share of the rings that passes whole, before the light is faded out.
_FLAT = 0.5
_LEAST_COLUMNS = 48
# Slopes of diffraction by a small aperture that its table holds, in λ/r.
_DIFFRACTED = 10.0
# Fewer samples than these cannot hold the end corrections of both sides.
_FEWEST_FORCED = 12
# Share of returning light below which the error grows against the fading peak.
_FADING = 0.3
_MOST_BYTES = 3 << 29
# Bytes of a pupil sample: its weight, as long as weights are kept, and its distance, place and field while in use;
# pupils of more samples than these are computed in bands of rows.
_BYTES_KEPT, _SAMPLES_KEPT = 8, 1 << 24
_BYTES_AT_WORK, _SAMPLES_AT_WORK = 64, 1 << 20
# More than this takes many seconds an image.
_MOST_SAMPLES = 3 << 27
# Bytes of a sample of the probe's aperture: weight, phase, and the field before and after.
_BYTES_AT_APERTURE = 64
# Bytes of a table entry of returning light and of a sample of its transform, spectra included.
_BYTES_AN_ENTRY = 48


@dataclass(frozen=True)
class RoundPlan(Plan):
    """Samples of a round pass, and their expected error.

    Parameters
    ----------
    columns, rows
        Samples over the pupil's diameter.
    flat_slope, end_slope
        Of the light that returns to the lens, against its own curvature, in radians: light beyond the first fades out,
        and ends at the second.
    expected_error
        Largest error of the irradiance, in fractions of the image's peak; infinite where no claim is made: for grids
        forced coarser than planned, and past the cut-off, where no ray returns.
    """

    method: ClassVar[str] = "round pass"
    columns: int
    rows: int
    flat_slope: float
    end_slope: float
    expected_error: float

    @property
    def missing(self) -> float:
        """The part of the error that no sampling removes; it is not known separately."""
        return 0.0

    def bytes_needed(self, batch: int, pixels: int, complex_size: int = 8) -> int:
        pupil, side = self.columns * self.rows, 2 * math.isqrt(pixels)
        kept = _BYTES_KEPT * pupil if pupil <= _SAMPLES_KEPT else 0
        at_work = _BYTES_AT_WORK * min(batch * pupil, _SAMPLES_AT_WORK)
        kernels = 16 * (self.columns + self.rows) * side
        return complex_size // 8 * (kept + at_work + kernels + 24 * batch * pixels)

    def too_large(self, pixels: int) -> bool:
        """Whether an image of `pixels` pixels exceeds the memory or time allowed."""
        return self.bytes_needed(1, pixels) > _MOST_BYTES or self.columns * self.rows > _MOST_SAMPLES


def plan_round(
    geometry: DoublePassGeometry,
    accuracy: float = 1e-3,
    *,
    pupil_samples: int | None = None,
    pixels: int = 1,
    orders: float = 0.0,
) -> RoundPlan:
    """Choose the samples of a round pass.

    Parameters
    ----------
    geometry
        The scene's lengths.
    accuracy
        Wanted largest error of the irradiance, in fractions of the image's peak.
    pupil_samples
        Force the columns; they are refused where they cannot hold the light's rays.
    pixels
        Pixels of the wanted image, for the memory it takes.
    orders
        Half the largest slope of the diffraction orders: they return light past the mirror's cut-off.

    Raises
    ------
    InputError
        For an accuracy out of reach, a forced grid that would alias, or a scene too large for the memory allowed; with
        the nearest scene that is not.
    """
    effort = step_for(_LADDER, accuracy)
    plan = plan_round_with(geometry, effort)
    if orders and math.isinf(plan.expected_error) and geometry.sine:
        # Some order returns nearly as at zero tilt: claim the mirror's error there.
        nearest = replace(geometry, sine=math.sin(math.atan(max(geometry.tangent - orders, 0.0))))
        plan = replace(plan, expected_error=plan_round_with(nearest, effort).expected_error)
    if pupil_samples is not None:
        plan = _forced(plan, geometry, pupil_samples)
    if plan.too_large(pixels):
        needed = plan.bytes_needed(1, pixels) / 2**30
        raise InputError(
            f"the scene needs {plan.columns} x {plan.rows} samples over the pupil, {needed:.2g} GiB an image; allowed "
            f"are {_MOST_SAMPLES / 1e6:.0f} million and {_MOST_BYTES / 2**30:.1f} GiB",
            where="sampling",
            remedy=_nearest_that_fits(geometry, effort, pixels),
        )
    return plan


def plan_aside(geometry: DoublePassGeometry, accuracy: float, plan: RoundPlan) -> tuple[RoundPlan, float] | None:
    """A coarser plan for tilts so steep that the rim's own light misses the picture, and their least squared sine.

    Under a tilt of tangent t the light that the rim sends straight on and back arrives from its places with phases that
    differ by up to k r (2t - w), w the picture's half angle; what is left of its sum falls like the root of that
    phase's inverse. None where the plan keeps no samples for that light, or the steepest tilt is not steep enough.
    """
    g = geometry
    effort = step_for(_LADDER, accuracy)
    found = plan_round_with(g, effort, rim=False)
    lit = min(g.radius, g.lit_radius)
    phase = 2 / math.pi * (RIM * g.spot_radius / g.radius / (_SHARE_OF_RIM * effort.error)) ** 2
    tangent = (phase * g.wavelength / (2 * math.pi * lit) + g.window / g.probe_focal_length) / 2
    if found.columns >= plan.columns or tangent >= g.tangent:
        return None
    return replace(found, expected_error=plan.expected_error), tangent**2 / (1 + tangent**2)


def plan_round_with(geometry: DoublePassGeometry, effort: RoundEffort, *, rim: bool = True) -> RoundPlan:
    """The samples of an effort for a scene, unchecked; with `rim` those for the rim's own light where it counts."""
    g = geometry
    spot = g.spot_radius / g.image_distance
    rays = g.ray_slope
    kept = effort.rings * g.wavelength / (2 * g.radius)
    # A large RR is faint in its middle, and waves from its edges count for more: they follow the rays' slopes.
    tail = max(kept, effort.spread * g.own_slope + g.window / g.probe_focal_length)
    error, missing = effort.error, RIM * g.spot_radius / g.radius
    if rim and missing > error and spot + tail < (end := HOLDS_RIM * g.radius / g.image_distance):
        if end - spot <= _MOST_FOR_RIM * kept:
            tail = end - spot
        else:
            error = missing
    turns = max(rays / effort.ray_radians, (rays + tail) / effort.tail_radians)
    columns = max(math.ceil(4 * math.pi * g.radius / g.wavelength * turns), _LEAST_COLUMNS)
    return RoundPlan(
        columns=columns,
        rows=math.ceil(columns * _ROWS_A_COLUMN),
        flat_slope=spot + _FLAT * tail,
        end_slope=spot + tail,
        expected_error=error * g.fading,
    )


def _forced(plan: RoundPlan, g: DoublePassGeometry, columns: int) -> RoundPlan:
    least = max(math.ceil(4 * g.radius / g.wavelength * g.ray_slope), _FEWEST_FORCED)
    if columns < least:
        raise InputError(
            f"{columns} samples over the pupil would alias",
            where="sampling.pupil",
            remedy=f"use at least {least}, {plan.columns} for the accuracy asked for, or leave it out",
        )
    # Sampling without aliasing may still be coarser than any that was measured.
    error = plan.expected_error if columns >= plan.columns else math.inf
    return replace(plan, columns=columns, rows=math.ceil(columns * _ROWS_A_COLUMN), expected_error=error)


def _nearest_that_fits(g: DoublePassGeometry, effort: RoundEffort, pixels: int) -> str:
    """Changes that make the memory suffice: the nearest aperture, focus and accuracy that fit."""

    def fits(one: DoublePassGeometry) -> bool:
        return not plan_round_with(one, effort).too_large(pixels)

    ways: list[str] = []
    if radius := _largest(lambda share: fits(replace(g, radius=g.radius * share))):
        ways.append(f"stop the target's aperture down to a radius of {g.radius * radius * 1e3:.3g} mm")
    if g.image_distance > g.focal_length:
        excess = g.image_distance - g.focal_length
        nearer = _largest(lambda share: fits(replace(g, image_distance=g.focal_length + excess * share)))
        if nearer:
            distance = g.focal_length + g.focal_length**2 / (excess * nearer)
            ways.append(f"focus it at {distance:.3g} m or farther")
    for step in _LADDER:
        if step.error > effort.error and not plan_round_with(g, step).too_large(pixels):
            ways.append(f"ask for an accuracy of {step.error:g}")
            break
    return ", or ".join(ways) or "take fewer pixels of the probe"


def _largest(fits: Callable[[float], bool]) -> float:
    """The largest share, to 3 digits on the safe side, for which the scene fits; 0 if none does."""
    low, high = 0.0, 1.0
    for _ in range(14):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low * 0.995


def through_aperture(geometry: DoublePassGeometry, distance: float, probe_radius: float) -> DoublePassGeometry:
    """The lengths by which to plan a pass whose light travels `distance` to a probe's aperture, all in metres.

    From the lens the aperture takes the place of the picture, and the distance adds to the wave's curvature.
    """
    return replace(geometry, window=geometry.probe_focal_length * (probe_radius + geometry.radius) / distance)


def aperture_samples(geometry: DoublePassGeometry, distance: float, probe_radius: float) -> tuple[int, int]:
    """Columns and rows over the probe's aperture: it sees the whole lens, and rays under their own angles."""
    g = geometry
    widest = (probe_radius + g.radius) / distance
    seen = g.window / g.probe_focal_length
    rays = min(g.exit_angle, widest) + seen
    turns = max(rays / _AT_APERTURE.ray_radians, (widest + seen) / _AT_APERTURE.tail_radians)
    columns = max(math.ceil(4 * math.pi * probe_radius / g.wavelength * turns), _LEAST_COLUMNS)
    return columns, math.ceil(columns * _ROWS_A_COLUMN)


def check_aperture(
    samples: Callable[[float], tuple[int, int]],
    distance: float,
    probe_radius: float,
    *,
    most: int = _MOST_BYTES,
    also: str = "",
) -> None:
    """Refuse a probe's aperture that needs more than `most` bytes: columns and rows by `samples` of its radius.

    The InputError names the largest aperture that fits, and what `also` helps.
    """

    def needed(radius: float) -> int:
        columns, rows = samples(radius)
        return _BYTES_AT_APERTURE * columns * rows

    if needed(probe_radius) <= most:
        return
    columns, rows = samples(probe_radius)
    fitting = _largest(lambda share: needed(probe_radius * share) <= most)
    raise InputError(
        f"light that goes {distance:.3g} m to an aperture of {probe_radius:.3g} m needs {columns} x {rows} samples "
        f"there, {needed(probe_radius) / 2**30:.1f} GiB, above the {most / 2**30:.1f} GiB allowed",
        where="probe.lens.aperture_radius",
        remedy=(f"stop it down to {probe_radius * fitting * 1e3:.3g} mm, " if fitting else "")
        + (f"{also}, " if also else "")
        + "or set sampling.propagation to 'far field', which has no aperture",
    )


@dataclass(frozen=True)
class Fade:
    """How a table of returning light is faded: from and up to which slopes against the light's own curvature, in
    radians; how far it goes on beyond its reach, and its samples' largest distance before it is faded, in metres."""

    flat: float
    end: float
    margin: float
    spacing: float

    @staticmethod
    def of(slopes: tuple[float, float], wavelength: float, radius: float, image_distance: float, reach: float) -> Fade:
        """Of the slopes that were planned, for a table out to `reach`; all lengths in metres.

        By rays the light has no slope above (reach + r)/2z, and diffraction adds some λ/r. A small aperture's plan
        keeps rings to many times that, where there is nothing to fade, only samples to take.
        """
        steepest = (reach + radius) / (2 * image_distance) + _DIFFRACTED * wavelength / radius
        flat, end = min(slopes[0], 1.5 * steepest), min(slopes[1], 3 * steepest)
        # The fade's own response must decay before the table's end.
        margin = 30 * wavelength / (end - flat)
        # Far out the removed curvature's phase changes faster than the field's own. Samples too far apart for the fade
        # to take anything away would ring where the table's two halves meet.
        spacing = min(0.6 * wavelength * image_distance / (reach + margin + radius), wavelength / (2 * end))
        return Fade(flat, end, margin, spacing)


def check_table(geometry: DoublePassGeometry, plan: RoundPlan, steepest: float) -> None:
    """Refuse a scene whose table of returning light (optics/radial.py) exceeds the memory allowed.

    `steepest` is the tangent of the steepest tilt plus half the steepest order's direction. Raises InputError where the
    light returns far beside the lens, over a very long image distance.
    """
    g = geometry
    k, z = 2 * math.pi / g.wavelength, g.image_distance
    reach = 1.05 * g.radius + 2 * z * steepest
    fade = Fade.of((plan.flat_slope, plan.end_slope), g.wavelength, g.radius, z, reach)
    reach += fade.margin
    beta = abs(g.curvature - 1 / g.focal_length + 1 / (2 * z))
    # Samples of the disc's projection and of its transform, as `disc_transform` computes them.
    count = max(1024.0, 32 / math.pi * k / (2 * z) * g.radius * max(reach, 2 * z * beta * g.radius))
    length = max(4 * count, g.wavelength * z / (g.radius * fade.spacing) * count)
    step = g.wavelength * z / length * count / g.radius
    entries = 2 * reach / step * max(1.0, 82 * k * fade.end * step)
    needed = _BYTES_AN_ENTRY * (length + entries)
    if needed > _MOST_BYTES:
        raise InputError(
            f"light comes back {2 * z * steepest:.3g} m beside a lens whose sensor lies {z:.3g} m behind it: a table "
            f"of {needed / 2**30:.3g} GiB, above the {_MOST_BYTES / 2**30:.1f} GiB allowed",
            where="target.object_distance",
            remedy="focus it farther away, turn it less, or stop its aperture down",
        )


def disc_overlap(first: float, second: float, offset: float) -> float:
    """Area shared by two discs of these radii and distance of centres, in fractions of the first's."""
    if offset >= first + second:
        return 0.0
    small, large = sorted((first, second))
    if offset <= large - small:
        return min(1.0, second / first) ** 2 if first > 0 else 1.0

    def segment(radius: float, other: float) -> float:
        cosine = (offset**2 + radius**2 - other**2) / (2 * offset * radius)
        angle = math.acos(max(-1.0, min(1.0, cosine)))
        return radius**2 * (angle - math.sin(2 * angle) / 2)

    return (segment(first, second) + segment(second, first)) / (math.pi * first**2)
