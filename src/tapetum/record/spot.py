"""The laser in the target's image, and the gaze labels that follow: the probe's place in the target's field."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pyarrow as pa

from tapetum.errors import InputError
from tapetum.progress import Progress, quiet
from tapetum.record.blobs import Candidates, find_candidates
from tapetum.record.clocks import Joined, join
from tapetum.record.recording import Recording
from tapetum.record.smoother import FEWEST, Samples, Smoothed, smooth

__all__ = ["LabelSummary", "NoLaserError", "Spot", "find_spot", "label_recording"]

GOOD = 0.5  # least quality of a spot that counts as the laser
NEIGHBOURS = 4  # frames before and after that a spot must agree with
BRIDGE = 3  # most frames to the good spots on both sides that confirm a doubtful one
CONFIRMED = 4.0  # increase of the log-odds of a confirmed spot
WIDEST = 0.005  # of the field: a label with a larger deviation is refused
PLACE = 1.6  # px, deviation of a spot's place times its snr: twice that of a Gaussian in white noise (measured)
STEADY = (
    1.0  # px, deviation times the median snr that the scene about the spot, which moves with it, adds to all labels
)
FLOOR = 0.02  # px, least deviation of a spot's place
FEW = 0.02  # fraction of frames with a spot below which there is no laser in the video


class NoLaserError(InputError):
    """Almost no frame of the target shows a laser."""


@dataclass(frozen=True)
class Spot:
    """The most likely laser spot of an image.

    Attributes
    ----------
    x, y
        Centre in pixels; (0, 0) is the centre of the top left pixel.
    quality
        Probability that it is the laser and not a part of the scene. Below 0.5, treat the laser as absent.
    peak, snr
        Height over the background in digital numbers (extrapolated where saturated), and its ratio to the fit's RMS
        residual.
    sigma
        Standard deviation of the Gaussian in pixels.
    """

    x: float
    y: float
    quality: float
    peak: float
    snr: float
    sigma: float


def find_spot(image: np.ndarray, background: np.ndarray | None = None, *, full_scale: float | None = None) -> Spot:
    """Find the probe's laser in a target's image.

    Parameters
    ----------
    image, background
        [H, W], of any real type, and optionally the same scene without the laser, which is subtracted.
    full_scale
        Digital number of saturation; by default the type's largest, for floats the image's largest.

    Returns
    -------
    Spot
        The most likely spot, whose `quality` says whether it is the laser. An image without any blob gives quality 0 at
        its centre. A spot fainter than the scene's own contrast has a low quality.

    Raises
    ------
    InputError
        When the image is not [H, W], smaller than 13 x 13, or holds NaN; when the background is of another size.
    """
    found = find_candidates(image, background, full_scale=full_scale)
    if not len(found):
        return Spot((image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2, 0.0, 0.0, 0.0, 0.0)
    return Spot(**{field.name: float(getattr(found, field.name)[0]) for field in fields(Spot)})


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


def strays(times: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return which places ([K, 2] px, at times [K]) are off a path by 20 px and by five times their neighbours'
    scatter.

    The path is a robust straight line through the neighbours (Theil and Sen).
    """
    out = np.zeros(len(times), bool)
    for i in range(len(times)):
        near = np.r_[max(0, i - NEIGHBOURS) : i, i + 1 : min(len(times), i + 1 + NEIGHBOURS)]
        if len(near) < 4:
            continue
        when, where = times[near] - times[i], places[near]
        first, second = np.triu_indices(len(near), 1)
        slope = np.median((where[second] - where[first]) / (when[second] - when[first])[:, None], axis=0)
        level = where - slope * when[:, None]
        middle = np.median(level, axis=0)
        scatter = np.median(np.hypot(*(level - middle).T))
        out[i] = np.hypot(*(places[i] - middle)) > max(20.0, 5 * scatter)
    return out


def follow(times: np.ndarray, found: list[Candidates]) -> tuple[np.ndarray, np.ndarray]:
    """Choose one candidate per frame at times [N] (s); return places [N, 2] in pixels (NaN without one) and qualities
    [N].

    A good spot off the path of its neighbours loses quality; a doubtful one where two good neighbours predict it gains
    some. Without such neighbours no quality rises.
    """
    place = np.array([(c.x[0], c.y[0]) if len(c) else (np.nan, np.nan) for c in found]).reshape(-1, 2)
    quality = np.array([c.quality[0] if len(c) else 0.0 for c in found])
    good = np.flatnonzero(quality >= GOOD)
    off = good[strays(times[good], place[good])]
    quality[off] = np.minimum(quality[off], GOOD / 2)
    good = np.setdiff1d(good, off)
    for i in np.flatnonzero(quality < GOOD):
        after = int(np.searchsorted(good, i))
        if not 0 < after < len(good) or not len(found[i]):
            continue
        left, right = good[after - 1], good[after]
        if i - left > BRIDGE or right - i > BRIDGE:
            continue
        part = (times[i] - times[left]) / (times[right] - times[left])
        expected = (1 - part) * place[left] + part * place[right]
        reach = 3 + 0.25 * float(np.hypot(*(place[right] - place[left])))
        near = np.hypot(found[i].x - expected[0], found[i].y - expected[1]) <= reach
        if near.any():
            best = int(np.flatnonzero(near)[np.argmax(found[i].odds[near])])
            place[i] = found[i].x[best], found[i].y[best]
            quality[i] = 1 / (1 + np.exp(-(found[i].odds[best] + CONFIRMED)))
    return place, quality


def _path(joined: Joined, places: np.ndarray, samples: Samples, times: np.ndarray, rate: float) -> Smoothed:
    """Return the path at times [T] (s) from places [M, 2] (NaN without a spot), of which the samples are the good ones:
    smoothed, or interpolated where that is surer."""
    plain, reach = joined.interpolate(places), joined.reach()
    # How far a spot lies from what its neighbours alone give: their gap is twice that of a label's.
    left_out = np.linalg.norm(_left_out(samples), axis=1) / np.sqrt(2)
    scatter = float(np.sqrt((left_out**2).mean())) if len(left_out) else np.inf
    straight = np.where(np.isfinite(plain[:, 0]), np.hypot(scatter, np.median(samples.deviations)), np.inf)
    path = smooth(samples, times, rate) if len(samples) > 1 else None
    if path is None:
        return Smoothed(plain, straight, reach, np.zeros(len(samples), bool))
    surer = path.deviations <= straight
    return Smoothed(
        np.where(surer[:, None], path.places, plain),
        np.where(surer, path.deviations, straight),
        np.where(surer[:, None], path.reach, reach),
        path.strays,
    )


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
    recording: Recording,
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
        A recording with both streams, and their names.
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
    joined = join(recording, probe, target, offset=offset)
    source = recording.source(target)
    found, exposures = [], []
    for frame in progress(source, "finding the laser", total=source.count):
        found.append(find_candidates(frame.image, full_scale=frame.full_scale))
        exposures.append(np.nan if frame.exposure is None else frame.exposure)
    place, quality = follow(source.times, found)
    good = quality >= GOOD
    if good.sum() < max(1, FEW * len(good)):
        raise NoLaserError(
            f"no laser spot found (in {good.sum()} of {len(good)} frames)",
            where=recording.video(target),
            remedy="aim the laser at the target's lens, or expose the target so that the spot stands out",
        )
    place[~good] = np.nan
    info = recording.stream(target)
    size = np.array([info.width, info.height], float)
    moments = (recording.utc_ns(probe) - recording.utc_ns(target)[0]) / 1e9 - offset + source.times[0]
    rolls = recording.readout(target) if readout is None else readout
    # In widths of the image along both axes, so that a spot's deviation is one number.
    flat = (place - (size - 1) / 2) / size[0]
    deviation = np.hypot(PLACE / np.maximum([c.snr[0] if len(c) else 1.0 for c in found], 1e-3), FLOOR) / size[0]
    rolled = np.where(good, source.times + rolls * np.nan_to_num(flat[:, 1]) * size[0] / size[1], source.times)
    exposed = np.array(exposures)
    samples = Samples(
        rolled[good],
        flat[good],
        deviation[good],
        float(np.median(exposed[np.isfinite(exposed)])) if np.isfinite(exposed).any() else 0.0,
    )
    path = _path(
        joined.at_rows(rolled - source.times[0], moments - source.times[0]),
        flat,
        samples,
        moments,
        info.rate or 1 / float(np.median(np.diff(source.times))),
    )
    there, near = joined.found, np.isfinite(path.places[:, 0])
    steady = (
        STEADY / max(float(np.median([c.snr[0] for c, one in zip(found, good, strict=True) if one])), 1e-3) / size[0]
    )
    gaze, wide = path.places * size[0] / size, np.hypot(path.deviations, steady)[:, None] * size[0] / size
    # Too few spots to fit a spectrum to: labels keep their wide deviations, or a short recording would have none.
    sure = near & ((wide.max(axis=1) <= widest) | ((len(samples) < FEWEST) & np.isfinite(path.deviations)))
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
