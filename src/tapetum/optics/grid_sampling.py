"""Choose the grids of a double pass with a sampled sensor plane, and state the expected error.

Three numbers decide the error (docs/conventions.md, "Sampling", shows how they were measured):

- how many Airy rings m of the spot the sensor's window holds: the window cuts off the waves that carry the sharp edge
of the returning pupil;
- the phase step of the field between two pupil samples, in radians: π is the Nyquist limit;
- how much wider than the returning and the accepting pupil together is the period λz/dv that the sensor's samples
impose on the returning field: light diffracted beyond it would be folded back in.

A sensor that is no mirror diffracts light itself, by λz over its finest detail: it takes several samples a detail. What
it turns from one edge of the pupil to the other has a period of one Airy ring, whatever its detail: the samples of a
mask must show that too, the more closely the finer its detail is, as the edges between its values hold it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from tapetum.errors import InputError
from tapetum.optics.sampling import HOLDS_RIM, RIM, DoublePassGeometry, Plan, step_for

__all__ = [
    "ACCURACIES",
    "REFERENCE",
    "Effort",
    "SamplingPlan",
    "plan_double_pass",
    "plan_finer",
    "plan_with",
]


@dataclass(frozen=True)
class Effort:
    """How finely an accuracy is sampled: its error in fractions of the peak, Airy rings in the window, radians a pupil
    step for the rays and for rays and diffracted tail together, the period over the two pupils' width, the sensor's
    samples a detail of its mask, and the slopes kept over the rays' own."""

    error: float
    rings: float
    ray_radians: float
    radians: float
    widths: float
    details: float
    spread: float


# Measured on random scenes against the same computation at the reference's effort: tests/optics/test_grid_sampling.py.
_LADDER = (
    Effort(1e-2, 60, 1.6, 2.5, 1.3, 4.0, 1.5),
    Effort(3e-3, 80, 1.3, 2.2, 1.3, 5.0, 1.5),
    Effort(1e-3, 110, 1.0, 2.0, 1.5, 6.0, 1.5),
    Effort(6e-4, 150, 0.9, 1.8, 1.6, 7.0, 1.5),
)
REFERENCE = Effort(0.0, 210, 0.7, 1.5, 2.0, 9.0, 5.0)
# References for faint pictures: the next finer effort, of these or one beyond them, at least the first of these.
_FINER = (*_LADDER[2:], Effort(4e-4, 210, 0.8, 1.6, 1.8, 8.0, 1.5))
_LEAST = Effort(1.0, 4, math.pi, math.pi, 1.0, 2.0, 0.0)
ACCURACIES = tuple(step.error for step in _LADDER)
# Rows at Gauss-Chebyshev nodes lie π/2 further apart in the middle than equally spaced ones. The phase changes fastest
# where they are dense, so fewer than π/2 times as many suffice (measured).
_ROWS_A_COLUMN = 1.45
# Error of a mask's samples, in fractions of the peak, that are so much of the Airy ring apart, where its detail is a
# ring wide; it rises by the samples' fourth power, and by the inverse square of the detail. Twice the largest of two
# masks of random phases, against plain sums. Below the last error of the ladder it is taken as that of the reference.
_OF_DETAIL, _APART, _LEAST_OF_DETAIL = 0.074, 0.42, 2e-4
# Share of the diffracted tail that the sensor's window passes whole, before it falls off smoothly.
_FLAT = 0.5
# Smallest distance of the window's end from that bound, as a fraction of it.
_NEAR_BOUND = 0.6
_MOST_BYTES = 4 << 30


@dataclass(frozen=True)
class SamplingPlan(Plan):
    """Grids of a double pass, and their expected error.

    Parameters
    ----------
    columns, rows
        Samples over the pupil's diameter.
    sensor_count
        Samples a side over the window on the target's sensor.
    sensor_half_width
        Half the window's side, in metres.
    sensor_flat
        Distance from the window's middle at which it begins to fall off, in metres.
    expected_error
        Largest error of the irradiance, in fractions of the image's peak; infinite where no claim is made: for grids
        forced coarser than planned, and past the cut-off, where no ray returns.
    missing
        The part of it due to the window's end, however fine the samples are.
    """

    columns: int
    rows: int
    sensor_count: int
    sensor_half_width: float
    sensor_flat: float
    expected_error: float
    missing: float = 0.0

    def bytes_needed(self, batch: int, pixels: int, complex_size: int = 8, *, masked: bool = False) -> int:
        # A mask is computed in double precision, of two factors.
        mask = 64 * batch * self.sensor_count**2 if masked else 0
        pupil, sensor = self.columns * self.rows, self.sensor_count**2
        kernels = (self.columns + self.rows) * (self.sensor_count + 2 * math.isqrt(pixels))
        return mask + complex_size * (kernels + 3 * pupil + 2 * sensor + batch * (2 * pupil + 2 * sensor + 2 * pixels))


def plan_double_pass(
    geometry: DoublePassGeometry,
    accuracy: float = 1e-3,
    *,
    pupil_samples: int | None = None,
    sensor_samples: int | None = None,
    pixels: int = 1,
    finest: float | None = None,
) -> SamplingPlan:
    """Choose the grids of a double pass.

    Parameters
    ----------
    geometry
        The scene's lengths.
    accuracy
        Wanted largest error of the irradiance, in fractions of the image's peak.
    pupil_samples, sensor_samples
        Force a grid; it is refused where it cannot hold the field.
    pixels
        Pixels of the wanted image, for the memory it takes.
    finest
        Finest detail of the sensor's mask, in metres: its sample spacing, or a quarter of the pitch of sharp-edged
        photosites. Default: a mirror.

    Raises
    ------
    InputError
        For an accuracy out of reach, a forced grid that would alias, or a scene too large for the memory allowed.
    """
    if finest is not None and not (math.isfinite(finest) and finest > 0):
        raise InputError(f"must be positive, is {finest} m", where="finest", remedy="give the mask's pitch in metres")
    plan = plan_with(geometry, step_for(_LADDER, accuracy), finest)
    plan = _forced(plan, geometry, pupil_samples, sensor_samples, finest)
    _check_memory(plan, pixels, finest)
    return plan


def plan_finer(geometry: DoublePassGeometry, accuracy: float, *, pixels: int = 1, finest: float) -> SamplingPlan:
    """Finer grids for a mask, as a reference for the error of `accuracy`; arguments as for `plan_double_pass`.

    Raises
    ------
    InputError
        For a scene too large for the memory allowed.
    """
    # Accuracies below the finest error use the finest sampling.
    used = step_for(_LADDER, max(accuracy, ACCURACIES[-1])).error
    plan = plan_with(geometry, next(step for step in _FINER if step.error < used), finest)
    _check_memory(plan, pixels, finest)
    return plan


def _check_memory(plan: SamplingPlan, pixels: int, finest: float | None) -> None:
    needed = plan.bytes_needed(1, pixels, 16, masked=finest is not None)
    if needed > _MOST_BYTES:
        raise InputError(
            f"the scene needs {plan.columns} x {plan.rows} pupil and {plan.sensor_count}² sensor samples, "
            f"{needed / 2**30:.1f} GiB an image, above the {_MOST_BYTES / 2**30:.0f} GiB allowed",
            where="sampling",
            remedy="focus nearer to the probe, stop the target's aperture down, or ask for less accuracy"
            if finest is None
            else f"give the mask a coarser pitch than {finest * 1e6:.3g} um, ask for less accuracy, "
            "or describe the sensor by an array, whose orders need no samples",
        )


def plan_with(geometry: DoublePassGeometry, effort: Effort, finest: float | None = None) -> SamplingPlan:
    """The grids of an effort for a scene and its mask's finest detail, unchecked."""
    g = geometry
    wavenumber = 2 * math.pi / g.wavelength
    # A large RR is faint in its middle, and waves from its edges count for more: they follow the rays' slopes.
    kept = max(effort.rings * g.airy_step, effort.spread * g.own_slope * g.image_distance)
    half, flat = g.spot_radius + kept, g.spot_radius + _FLAT * kept
    # Light that meets the sensor at v returns at 2v - x, so beyond the pupil's own radius none meets the pupil again. A
    # window that ends near that bound is extended beyond it and then cuts nothing off. A mask's detail turns the light
    # by `spread` at the lens.
    spread = 0.0 if finest is None else g.wavelength * g.image_distance / finest
    bound = 1.05 * (g.radius + g.spot_radius + g.image_distance * g.tangent) + 4 * g.airy_step + spread / 2
    # With a mask that costs too much, so it ends near the bound.
    if half > (_NEAR_BOUND if finest is None else 1.3) * bound:
        half, flat = 1.3 * bound, bound
    # Steepest slopes of the field against the pupil, of rays and of the diffracted tail, in and out.
    rays = g.ray_slope
    tail = (half - g.spot_radius) / g.image_distance
    turns = max(rays / effort.ray_radians, (rays + tail) / effort.radians)
    columns = max(math.ceil(2 * g.radius * wavenumber * turns), 32)
    # Light that entered at x and met the sensor at v returns at 2v - x: the period of the sensor's samples must not
    # fold the diffracted tail into the accepting pupil either.
    reach = 2 * (half + g.radius + g.image_distance * g.tangent) + spread
    step = g.wavelength * g.image_distance / max(effort.widths * _width_on_return(g), reach)
    if finest is not None:
        ring, allowed = g.airy_step, max(effort.error, _LEAST_OF_DETAIL)
        fine = _APART * (allowed / (_OF_DETAIL * min(1.0, ring / finest) ** 2)) ** 0.25
        step = min(step, finest / effort.details, fine * ring)
    missing = _lost_at_the_axis(g, half, flat)
    # None in focus, and past the cut-off at most the whole error: avoid 0 times infinity.
    if g.spot_radius > 0 and half < HOLDS_RIM * g.radius:
        missing += RIM * g.spot_radius / g.radius * g.fading
    return SamplingPlan(
        columns=columns,
        rows=math.ceil(columns * _ROWS_A_COLUMN),
        sensor_count=max(2 * math.ceil(half / step), 16),
        sensor_half_width=half,
        sensor_flat=flat,
        expected_error=effort.error * g.fading + missing,
        missing=missing,
    )


def _lost_at_the_axis(g: DoublePassGeometry, half: float, flat: float) -> float:
    """Share of the peak that a window loses of the light that meets the sensor on the lens's axis.

    Light diffracted there by all of the pupil's rim returns through the opposite rim in phase, whatever the tilt,
    because the phase by the field's square and the sensor's distance is stationary. n rings λz/2r from the spot the
    square of its field is 8/π(πn)³ of the peak's, over an area λz/2 against 4/π rings² of the spot's: an amplitude of
    2N/(πn)³ of the peak's, N rings being the pupil's radius, and π/2 times the spot's radius in rings as much where
    that dims the peak.
    """
    steepest, ring = g.image_distance * g.tangent, g.airy_step
    # Over all tilts up to the steepest: the loss grows as the spot nears the window's end.
    feet = [flat + share / 8 * (min(steepest, half) - flat) for share in range(1, 9)] if steepest > flat else []

    def missed(foot: float) -> float:
        lost = math.sin(math.pi / 2 * min(1.0, (foot - flat) / (half - flat))) ** 2
        dimmed = max(1.0, math.pi / 2 * g.spot_radius / ring)
        amplitude = 2 * g.radius / ring / (math.pi * foot / ring) ** 3 * dimmed
        returning = replace(g, sine=math.sin(math.atan(foot / g.image_distance))).returning
        return 2 * amplitude * lost / returning if returning else math.inf

    return max((missed(foot) for foot in [*feet, steepest] if foot > flat), default=0.0)


def _width_on_return(g: DoublePassGeometry) -> float:
    """Half-widths of the returning and of the accepting pupil and their offset, which one period must hold."""
    return g.return_radius + g.radius + 2 * g.image_distance * g.tangent


def _forced(
    plan: SamplingPlan,
    g: DoublePassGeometry,
    pupil_samples: int | None,
    sensor_samples: int | None,
    finest: float | None,
) -> SamplingPlan:
    wanted, least = plan, plan_with(g, _LEAST)
    if pupil_samples is not None:
        if pupil_samples < least.columns:
            raise InputError(
                f"{pupil_samples} samples over the pupil would alias",
                where="sampling.pupil",
                remedy=f"use at least {least.columns}, {plan.columns} for the accuracy asked for, or leave it out",
            )
        plan = replace(plan, columns=pupil_samples, rows=math.ceil(pupil_samples * _ROWS_A_COLUMN))
    if sensor_samples is not None:
        floor = math.ceil(2 * plan.sensor_half_width * _width_on_return(g) / (g.wavelength * g.image_distance))
        if sensor_samples < floor:
            raise InputError(
                f"{sensor_samples} samples over the target's sensor would fold the returning pupil onto itself",
                where="sampling.sensor",
                remedy=f"use at least {floor}, {plan.sensor_count} for the accuracy asked for, or leave it out",
            )
        least_of_mask = 0 if finest is None else math.ceil(2 * plan.sensor_half_width * _LEAST.details / finest)
        if sensor_samples < least_of_mask:
            raise InputError(
                f"{sensor_samples} samples over the target's sensor would miss details of {finest:.3g} m",
                where="sampling.sensor",
                remedy=f"use at least {least_of_mask}, {plan.sensor_count} for the accuracy asked for, leave it out, "
                "or describe the sensor by an array, whose orders need no samples",
            )
        plan = replace(plan, sensor_count=sensor_samples)
    if plan.columns < wanted.columns or plan.sensor_count < wanted.sensor_count:
        # It does not alias, but its error has not been measured.
        plan = replace(plan, expected_error=math.inf)
    return plan
