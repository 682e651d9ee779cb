"""Gaze labels of a recording: the probe's place in the target's field, from the laser in the target's images.

A label's standard deviation is that of the spot's smoothed path (`smoother`), with what draws the places of a recording
to one side in common: what stands under the spot and is not known (`surroundings`).
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from scipy.ndimage import median_filter

from tapetum.errors import InputError
from tapetum.progress import Progress, quiet
from tapetum.record.blobs import Candidates, find_candidates, saturation
from tapetum.record.clocks import Joined, join
from tapetum.record.recording import Recording, as_recording
from tapetum.record.smoother import FEWEST, Samples, Smoothed, smooth
from tapetum.record.source import Frame
from tapetum.record.spot import GOOD, follow
from tapetum.record.streak import patch_of, sharpened, unsaturated
from tapetum.record.surroundings import GROUP, surroundings

__all__ = ["LabelSummary", "NoLaserError", "label_recording"]

Array = npt.NDArray[np.float64]
WIDEST = 0.005  # of the field: a label with a larger deviation is refused
PLACE = 1.0  # px, deviation of a spot's place over the fit's residual in heights of the spot (measured)
FLOOR = 0.005  # px, least deviation of a spot's place
# Deviation that places have in common, chosen on simulated films and real photographs: in what is unknown of what
# surrounds the spot; in what neighbouring pixels leave alike of the spot alone, beyond white noise; and, where nothing
# else is known, in all that they leave alike. The latter two are in heights of the spot (px).
UNKNOWN, LEFT, ALONE = 1.6, 8.0, 6.3
ABOUT, FEWEST_ABOUT = 0.1, 5  # s before and after a label, and frames at least, over which a median of these is taken
ROUNDS = 2  # of what stands under the spots, which takes their places, and of their places, which take that
REACH = 2 * GROUP * ROUNDS
"""Frames on either side that what stands under a spot takes part of."""
BATCH = 512  # spots that are sharpened at once
FEW = 0.02  # fraction of frames with a spot below which there is no laser in the video


class NoLaserError(InputError):
    """Almost no frame of the target shows a laser."""


@dataclass(frozen=True)
class LabelSummary:
    """Result of labelling a recording.

    Attributes
    ----------
    n, labelled
        Numbers of probe frames, and of those with a gaze.
    no_spot, no_partner, wide
        Numbers without one because a neighbouring target frame shows no laser, because none is close in time, or
        because its deviation would be too large.
    target_frames, spots
        Numbers of target frames, and of those with a laser.
    median_quality, median_deviation
        Of the labels; the deviation along x in fractions of the field.
    """

    n: int
    labelled: int
    no_spot: int
    no_partner: int
    target_frames: int
    spots: int
    median_quality: float
    wide: int = 0
    median_deviation: float = 0.0


@dataclass(frozen=True)
class _Sight:
    """Of one frame of the target: its number, possible lasers, the patch about the likeliest with the digital number
    that is saturated, and the exposure (s), NaN where it is unknown."""

    number: int
    found: Candidates
    patch: np.ndarray
    saturated: float
    exposure: float


def _look(frame: Frame) -> _Sight:
    found = find_candidates(frame.image, full_scale=frame.full_scale)
    x, y = (float(one[0]) if len(found) else 0.0 for one in (found.x, found.y))
    exposure = np.nan if frame.exposure is None else frame.exposure
    patch = patch_of(frame.image, x, y)
    return _Sight(frame.index, found, patch, saturation(frame.image, frame.full_scale), exposure)


def _sharp(sights: list[_Sight], chosen: npt.NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Return places [N, 2] (px) and residuals [N] in heights of the spot, of the likeliest spots, and the deviations
    [N, 2] (px) that places along x and y have in common; `chosen` [N] are those that are the laser."""
    parts = []
    for first in range(0, len(sights), BATCH):
        low, last = max(0, first - REACH), first + BATCH
        near = slice(low, last + REACH)
        fitted = _fitted(sights[near], chosen[near])
        parts.append([one[first - low : last - low] for one in fitted])
    places, noise, common = (np.concatenate(one) for one in zip(*parts, strict=True))
    return places, noise, common


def _fitted(sights: list[_Sight], chosen: npt.NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Return what `_sharp` does, of successive frames that are fitted together."""
    batch = [one.found if len(one.found) else None for one in sights]
    at = np.array([(c.x[0], c.y[0]) if c else (0.0, 0.0) for c in batch])
    sigma, snr = (np.array([getattr(c, name)[0] if c else 1.0 for c in batch]) for name in ("sigma", "snr"))
    patches, saturated = np.stack([one.patch for one in sights]), np.array([one.saturated for one in sights])
    patches = unsaturated(patches, saturated)
    found, unknown = sharpened(patches, at, sigma, saturated), np.full((len(sights), 2), np.nan)
    numbers = np.array([one.number for one in sights])
    alike = np.sqrt(np.maximum(_among(found.excess, chosen & found.holds, numbers), 0))
    for _ in range(ROUNDS):
        under, unknown = surroundings(patches, found, chosen, numbers)
        found = sharpened(patches - under, at, sigma, saturated, found)
    round_one = 1 / np.maximum(snr, 1e-3)
    noise = np.where(found.holds, found.noise, round_one)
    # Means of nine pixels have a third of their noise, where saturation leaves no nine side by side.
    shared = np.where(found.holds & np.isfinite(found.shared), found.shared, noise / 3)
    # Without surroundings nothing is known of what the spot hides.
    known = np.hypot(UNKNOWN * unknown, LEFT * alike[:, None])
    common = np.where(np.isfinite(unknown), known, ALONE * shared[:, None])
    return found.places, noise, common


def _among(values: Array, usable: npt.NDArray[np.bool_], numbers: npt.NDArray[np.int64]) -> Array:
    """Return the median [N] of values [N] over the usable frames that are at most `GROUP` before or after each usable
    one, by their numbers; 0 for the others."""
    found, of = np.zeros(len(values)), numbers[usable]
    near = np.abs(of[:, None] - of) <= GROUP
    # A laser that blinks is dark in most frames, which must not count.
    if len(of):
        found[usable] = np.nanmedian(np.where(near, values[usable], np.nan), axis=1)
    return found


def _path(joined: Joined, places: np.ndarray, samples: Samples, times: np.ndarray, rate: float) -> Smoothed:
    """Return the path at times [T] (s) from places [M, 2] (NaN without a spot), of which the samples are the good ones:
    smoothed, or interpolated where that is surer."""
    plain, reach = joined.interpolate(places), joined.reach()
    # How far a spot lies from what its neighbours alone give: their gap is twice that of a label's.
    left_out = _left_out(samples)
    scatter = np.sqrt((left_out**2).mean(axis=0)) if len(left_out) else np.full(2, np.inf)
    straight = np.where(np.isfinite(plain), np.hypot(scatter, np.median(samples.deviations)), np.inf)
    path = smooth(samples, times, rate) if len(samples) > 1 else None
    if path is None:
        return Smoothed(plain, straight, reach, np.zeros(len(samples), bool))
    surer = (path.deviations**2).sum(axis=1, keepdims=True) <= (straight**2).sum(axis=1, keepdims=True)
    return Smoothed(
        np.where(surer, path.places, plain),
        np.where(surer, path.deviations, straight),
        np.where(surer, path.reach, reach),
        path.strays,
    )


def _about(times: Array, values: Array, at: Array, rate: float) -> Array:
    """Return the median [T] of values [K] at times [K] (s), at a nominal rate in Hz, about each time of `at` [T]."""
    middle = median_filter(values, min(max(2 * round(ABOUT * rate) + 1, FEWEST_ABOUT), len(values)), mode="nearest")
    return middle[np.clip(np.searchsorted(times, at), 0, len(times) - 1)]


def _left_out(samples: Samples) -> np.ndarray:
    """Return how far each sample lies from the cubic (a straight line, of three or four samples) through the two on
    either side, [K, 2]."""
    side = 2 if len(samples) > 4 else 1
    middle = np.arange(side, len(samples) - side)
    others = middle[:, None] + np.r_[-side:0, 1 : side + 1]
    times, moment = samples.times[others], samples.times[middle]
    share = np.ones(others.shape)
    for k in range(2 * side):
        rest = np.delete(times, k, axis=1)
        share[:, k] = ((moment[:, None] - rest) / (times[:, k : k + 1] - rest)).prod(axis=1)
    regular = np.ptp(times, axis=1) < 3 * side * np.median(np.diff(samples.times))
    return (samples.places[middle] - (share[..., None] * samples.places[others]).sum(axis=1))[regular]


def label_recording(
    recording: Recording | str | os.PathLike[str],
    progress: Progress = quiet,
    *,
    probe: str = "probe",
    target: str = "target",
    offset: float = 0.0,
    readout: float | None = None,
    widest: float = WIDEST,
) -> LabelSummary:
    """Label every probe frame with the gaze, from the laser in the target's video, and store the labels.

    The field of view is the whole target image: gaze_x = (x - (W - 1) / 2) / W, and so for y with H. Between target
    frames the spot follows a path whose spectrum is fitted to them (`tapetum.record.smoother`); in recordings of fewer
    than 64 spots, and where it is the surer, `Joined.interpolate`. `labels.parquet` has one row per probe frame:
    `frame`, `gaze_x`, `gaze_y` (fractions of the field), `spot_x`, `spot_y` (target px), `how` ("laser-spot"),
    `quality` (the lower of both target frames'), `reach_back` and `reach_ahead` (seconds to the farthest target frames
    used), `gaze_x_std` and `gaze_y_std` (standard deviations of the gaze); gaze, spot, reach and deviations are null
    without a good spot or a target frame near, or where the deviation is too large.

    Parameters
    ----------
    recording, probe, target
        A recording with both streams, or its folder, and their names.
    progress
        Shown over the target's frames.
    offset
        Seconds to add to the target's UTC, where its clock is known to be wrong.
    readout
        Seconds from the exposure of the target's first row to that of its last; by default what the recording says, or
        0. A frame's UTC is that of its middle row.
    widest
        Largest standard deviation of a label along either axis, in fractions of the field; recordings of fewer than 64
        spots keep wider ones.

    Raises
    ------
    InputError
        When a stream is missing or damaged, the clocks do not overlap, or an argument is out of range.
    NoLaserError
        When almost no target frame shows a laser.
    """
    if not widest > 0:
        raise InputError(f"must be positive, is {widest}", where="widest", remedy="give a part of the field")
    if readout is not None and not 0 <= readout < 1:
        raise InputError(f"must lie from 0 to 1 s, is {readout}", where="readout", remedy="0 for a global shutter")
    recording = as_recording(recording)
    joined = join(recording, probe, target, offset=offset)
    source = recording.source(target)
    sights = list(progress(source.looked(_look), "finding the laser", total=source.count))
    found, exposures = [one.found for one in sights], np.array([one.exposure for one in sights])
    place, quality = follow(source.times, found)
    good = quality >= GOOD
    if good.sum() < max(2, FEW * len(good)):
        raise NoLaserError(
            f"{'too few laser spots' if good.any() else 'no laser spot'} found (in {good.sum()} of {len(good)} frames)",
            where=recording.video(target),
            remedy="aim the laser at the target's lens, or expose the target so that the spot stands out",
        )
    # Where another candidate was chosen, it keeps its place.
    likeliest = np.array([(c.x[0], c.y[0]) if len(c) else (np.nan, np.nan) for c in found]).reshape(-1, 2)
    chosen = (place == likeliest).all(axis=1)
    sharp, noise, common = _sharp(sights, good & chosen)
    place = np.where(chosen[:, None], sharp, place)
    place[~good] = np.nan
    info = recording.stream(target)
    size = np.array([info.width, info.height], float)
    moments = (recording.utc_ns(probe) - recording.utc_ns(target)[0]) / 1e9 - offset + source.times[0]
    rolls = recording.readout(target) if readout is None else readout
    # In widths of the image along both axes, so that a spot's deviation is one number.
    flat = (place - (size - 1) / 2) / size[0]
    deviation = np.hypot(PLACE * noise, FLOOR) / size[0]
    rolled = np.where(good, source.times + rolls * np.nan_to_num(flat[:, 1]) * size[0] / size[1], source.times)
    samples = Samples(
        rolled[good],
        flat[good],
        deviation[good],
        float(np.median(exposures[np.isfinite(exposures)])) if np.isfinite(exposures).any() else 0.0,
    )
    # Nominal, so that any part of a recording is labelled alike.
    rate = info.rate or 1 / float(np.median(np.diff(source.times)))
    path = _path(
        joined.at_rows(rolled - source.times[0], moments - source.times[0]),
        flat,
        samples,
        moments,
        rate,
    )
    there, near = joined.found, np.isfinite(path.places[:, 0])
    steady = np.stack([_about(samples.times, one, moments, rate) for one in common[good].T], axis=1) / size[0]
    gaze, wide = path.places * size[0] / size, np.hypot(path.deviations, steady) * size[0] / size
    # Too few spots to fit a spectrum to: labels keep their wide deviations, or a short recording would have none.
    known = np.isfinite(path.deviations).all(axis=1)
    sure = near & ((wide.max(axis=1) <= widest) | ((len(samples) < FEWEST) & known))
    refused, labelled = there & near & ~sure, there & sure
    spot = gaze * size + (size - 1) / 2
    both = np.zeros(len(joined))
    # At a target frame's own time `after` has no weight, and its quality does not count.
    after = np.where(joined.weight > 0, joined.after, joined.before)
    both[there] = np.minimum(quality[joined.before[there]], quality[after[there]])

    def columns(names: str, values: np.ndarray) -> dict[str, pa.Array]:
        return {
            name: pa.array(column, pa.float64(), mask=~labelled)
            for name, column in zip(names.split(), values.T, strict=True)
        }

    table = {
        "frame": pa.array(np.arange(len(joined)), pa.int64()),
        **columns("gaze_x gaze_y spot_x spot_y", np.hstack([gaze, spot])),
        "how": pa.array(["laser-spot"] * len(joined), pa.string()),
        "quality": pa.array(both, pa.float64()),
        **columns("reach_back reach_ahead", path.reach),
        **columns("gaze_x_std gaze_y_std", wide),
    }
    recording.write_labels(pa.table(table))
    return LabelSummary(
        n=len(joined),
        labelled=int(labelled.sum()),
        no_spot=int((there & ~near).sum()),
        no_partner=int((~there).sum()),
        target_frames=len(good),
        spots=int(good.sum()),
        median_quality=float(np.median(both[labelled])) if labelled.any() else 0.0,
        wide=int(refused.sum()),
        median_deviation=float(np.median(wide[labelled, 0])) if labelled.any() else 0.0,
    )
