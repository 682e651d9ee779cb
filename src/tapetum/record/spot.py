"""The laser in the target's picture, and the labels it gives: where the probe is in the target's field."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pyarrow as pa

from tapetum.errors import InputError
from tapetum.progress import Progress, quiet
from tapetum.record.blobs import Candidates, find_candidates
from tapetum.record.clocks import join
from tapetum.record.recording import Recording

__all__ = ["LabelSummary", "NoLaserError", "Spot", "find_spot", "label_recording"]

GOOD = 0.5  # quality from which a spot is taken for the laser
NEIGHBOURS = 4  # frames before and after that a spot must agree with
BRIDGE = 3  # frames at most to the good spots on both sides that vouch for a doubtful one
VOUCHED = 4.0  # what their word adds to its log-odds
FEW = 0.02  # fraction of frames with a spot below which there is no laser in the video


class NoLaserError(InputError):
    """Hardly a frame of the target shows a laser."""


@dataclass(frozen=True)
class Spot:
    """The most likely laser spot of a picture.

    Attributes
    ----------
    x, y
        Place of its centre in pixels; (0, 0) is the centre of the top left pixel.
    quality
        How likely it is the laser and not a part of the scene, 0 to 1. Below 0.5: take the laser as absent.
    peak, snr
        Height over the background in digital numbers, by its flanks where it is saturated; and that over the rms of
        what the fit leaves.
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
    """Find the probe's laser in a target's picture.

    Parameters
    ----------
    image, background
        [H, W], of any real type, and the same scene without the laser, where there is one, which is subtracted.
    full_scale
        Digital number of saturation; by default the type's largest, for floats the picture's largest.

    Returns
    -------
    Spot
        The most likely spot; look at its `quality`. A picture without any blob gives quality 0 at its centre.
        A spot fainter than the scene's own contrast is called doubtful, however clean.

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
    """How labelling a recording went.

    Attributes
    ----------
    n, labelled
        Number of probe frames, and of those that got a gaze.
    no_spot, no_partner
        How many did not because a target frame beside them shows no laser, or none lies around them in time.
    target_frames, spots
        Number of target frames, and of those in which the laser was found.
    median_quality
        Of the labels.
    """

    n: int
    labelled: int
    no_spot: int
    no_partner: int
    target_frames: int
    spots: int
    median_quality: float


def strays(times: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return which places ([K, 2] px, at times [K]) are 20 px, and five times as far as their neighbours, off a path.

    The path is a straight line through those neighbours by medians, which one stray does not bend (Theil and Sen).
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
    """Choose one candidate a frame at times [N] (s): places [N, 2] in pixels, NaN where there is none; qualities [N].

    A good spot that jumps off the path of its neighbours loses its quality; a doubtful one between two good ones, and
    where these say it should be, gains some. Frames around never raise a spot that none of them vouches for.
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
            quality[i] = 1 / (1 + np.exp(-(found[i].odds[best] + VOUCHED)))
    return place, quality


def label_recording(
    recording: Recording,
    progress: Progress = quiet,
    *,
    probe: str = "probe",
    target: str = "target",
    offset: float = 0.0,
) -> LabelSummary:
    """Label every probe frame with the gaze, from the laser in the target's own video, and keep the labels.

    The field of view is the whole target picture: gaze_x = (x - (W - 1) / 2) / W, and so for y with H. Between target
    frames the spot's place is interpolated by `Joined.interpolate`. `labels.parquet` gets a row a probe frame: `frame`,
    `gaze_x`, `gaze_y` (fractions of the field), `spot_x`, `spot_y` (target px), `how` ("laser-spot"), `quality` (the
    lesser of both target frames'), `reach_back` and `reach_ahead` (seconds to the farthest target frames that the label
    rests on); gaze, spot and reach are null where there is no good spot or no target frame near.

    Parameters
    ----------
    recording, probe, target
        A recording with both streams, and their names.
    progress
        Shows how far the target's frames are done.
    offset
        Seconds to add to the target's UTC, where its clock is known to be wrong.

    Raises
    ------
    InputError
        When a stream is missing or damaged, or the clocks do not overlap.
    NoLaserError
        When hardly a target frame shows a laser.
    """
    joined = join(recording, probe, target, offset=offset)
    source = recording.source(target)
    found = [
        find_candidates(frame.image, full_scale=frame.full_scale)
        for frame in progress(source, "finding the laser", total=source.count)
    ]
    place, quality = follow(source.times, found)
    good = quality >= GOOD
    if good.sum() < max(1, FEW * len(good)):
        raise NoLaserError(
            f"no laser spot found (in {good.sum()} of {len(good)} frames)",
            where=recording.video(target),
            remedy="aim the laser at the target's lens, or expose the target so that the spot stands out",
        )
    place[~good] = np.nan
    spot = joined.interpolate(place)
    info = recording.stream(target)
    size = np.array([info.width, info.height], float)
    gaze = (spot - (size - 1) / 2) / size
    there, labelled = joined.found, np.isfinite(gaze[:, 0])
    both = np.zeros(len(joined))
    # At a target frame's own time `after` may be worse, and has no share.
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
        **columns("reach_back reach_ahead", joined.reach()),
    }
    recording.write_labels(pa.table(table))
    return LabelSummary(
        n=len(joined),
        labelled=int(labelled.sum()),
        no_spot=int((there & ~labelled).sum()),
        no_partner=int((~there).sum()),
        target_frames=len(good),
        spots=int(good.sum()),
        median_quality=float(np.median(both[labelled])) if labelled.any() else 0.0,
    )
