"""From frames to tracks with estimates: detect, follow, crop, apply the models.

A little over 400 lines: tracking in memory and into files are one way, and have the same options.
"""

from __future__ import annotations

import copy
import math
import os
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tapetum.blas import one_blas_thread
from tapetum.data.crop import crop, crops_of
from tapetum.errors import InputError, of_type, one_of, whole
from tapetum.interrupts import interruptible
from tapetum.progress import Progress, quiet
from tapetum.record.frames import open_frames
from tapetum.record.reader import taken
from tapetum.record.source import Frame, Source
from tapetum.track.activity import Activity, asymmetry
from tapetum.track.ahead import found_ahead, found_next
from tapetum.track.detections import Detections
from tapetum.track.detector import DETECTORS, Detector
from tapetum.track.rows import TrackedFrame, about
from tapetum.track.tables import checked_suffix, detections_schema, table_writer, track_schema
from tapetum.track.tracker import Tracker
from tapetum.track.turns import Turns

if TYPE_CHECKING:
    from tapetum.models import Predictor

__all__ = ["SIDE", "TrackSummary", "make_detector", "seeing", "track", "track_to_file", "unsure_of", "usual_tracker"]

SIDE = 400
"""Side of the square that the models are shown, in pixels (the paper's largest crop)."""

# Sides of the squares in which the symmetry of a spot is measured, in pixels.
_ASYMMETRY_SIDES = (64, 600)

Frames: TypeAlias = str | os.PathLike[str] | Source | Iterable[Frame]


Models: TypeAlias = "Predictor | str | os.PathLike[str] | Sequence[Predictor | str | os.PathLike[str]] | None"


@dataclass(frozen=True)
class TrackSummary:
    """Counts of a written table: frames, tracks, rows, rows in which the spot was seen, and lost frames.

    `unsure` has for each model why its intervals may be too narrow (`Predictor.unsure`), empty where they are not.
    """

    frames: int
    tracks: int
    rows: int
    seen: int
    lost: int = 0
    unsure: tuple[str, ...] = ()


def unsure_of(estimators: Sequence[Predictor], source: object) -> tuple[str, ...]:
    """Return for each model why its intervals may be too narrow for a source, empty where they are not."""
    marks = [frozenset(getattr(source, "marks", ()))]
    return tuple(one.unsure(marks) if hasattr(one, "unsure") else "" for one in estimators)


def _loaded(models: Models) -> list[Predictor]:
    if models is None:
        return []
    many = [models] if isinstance(models, (str, os.PathLike)) or not isinstance(models, Sequence) else models
    estimators: list[Predictor] = []
    for one in many:
        if isinstance(one, (str, os.PathLike)):
            # PyTorch takes a second to import, and tracking alone does not need it.
            from tapetum.models import load_predictor

            one = load_predictor(Path(one))
        if not callable(getattr(one, "predict", None)):
            raise InputError(f"is no model: {one!r:.40}", where="model", remedy="give a fitted model or its folder")
        estimators.append(one)
    names = [name for estimator in estimators for name in estimator.target_names]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"two models estimate {', '.join(twice)}", where="model", remedy="give one model a quantity")
    return estimators


def seeing(estimators: Sequence[Predictor], source: object) -> list[Predictor]:
    """Return the models with the intervals that suit a source, unless a person chose them.

    A source that knows what it shows (`tapetum.record.marks`) may show what a model was trained on.
    """
    marks = getattr(source, "marks", frozenset())
    seeing = []
    for one in estimators:
        if getattr(one, "others_", None) is not None and one.whose is None and one.knows(marks):
            one = copy.copy(one)
            one.whose = "own"
        seeing.append(one)
    return seeing


def _estimates(
    frames: Sequence[tuple[Frame, Detections]], estimators: Sequence[Predictor], side: int, turns: Turns | None = None
) -> list[list[dict[str, Any]]]:
    """Ask the models about every spot of several frames at once, or those whose turn it is; [frames][spots]."""
    answers: list[list[dict[str, Any]]] = [[{} for _ in range(len(found))] for _, found in frames]
    begun, asked = time.perf_counter(), 0
    if not estimators:
        return answers
    # A folder may mix 8 and 16 bit; a batch may not.
    alike: dict[tuple[str, float], list[tuple[int, int]]] = {}
    for n, (frame, found) in enumerate(frames):
        depth = (frame.image.dtype.str, float(frame.full_scale or np.iinfo(frame.image.dtype).max))
        chosen = np.flatnonzero(~found.ghost) if turns is None else turns.choose(found)
        asked += len(chosen)
        alike.setdefault(depth, []).extend((n, int(k)) for k in chosen)
    for (_, full_scale), places in sorted(alike.items()):
        if not places:
            continue
        crops = _crops(frames, places, side)
        for estimator in estimators:
            columns = estimator.predict(crops, full_scale=full_scale).columns()
            for row, (n, k) in enumerate(places):
                told = {name: _plain(values[row]) for name, values in columns.items()}
                answers[n][k] = _merged(answers[n][k], told, estimator.target_names)
    if turns is not None:
        turns.spent(asked, time.perf_counter() - begun)
    return answers


def _crops(
    frames: Sequence[tuple[Frame, Detections]], places: Sequence[tuple[int, int]], side: int
) -> NDArray[np.generic]:
    """Cut out the spots (frame, spot), which come frame by frame."""
    cut = []
    for n, group in groupby(places, key=lambda place: place[0]):
        (frame, found), spots = frames[n], [k for _, k in group]
        cut.append(crops_of(frame.image, np.stack([found.peak_x[spots], found.peak_y[spots]], axis=1), side))
    return cut[0] if len(cut) == 1 else np.concatenate(cut)


def _add_asymmetries(frame: Frame, found: Detections, answers: Sequence[dict[str, Any]]) -> None:
    """Add the asymmetry of every spot that is no ghost to its answers."""
    for k in np.flatnonzero(~found.ghost):
        side = int(np.clip(4 * found.diameter[k], *_ASYMMETRY_SIDES))
        seen = asymmetry(
            crop(frame.image, (float(found.x[k]), float(found.y[k])), side), float(frame.full_scale or math.inf)
        )
        answers[int(k)]["asymmetry"] = math.nan if seen is None else seen.value


def _plain(value: Any) -> Any:
    return value if value is None or isinstance(value, (str, bool)) else float(value)


def _merged(before: dict[str, Any], said: dict[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Combine the estimates of several models for a spot: they apply together where each does."""
    reason = f"{', '.join(names)}: {said['reason']}" if said.get("reason") else ""
    applies = said.get("applies")
    if before:
        reason = "; ".join(one for one in (before["reason"], reason) if one)
        # False where one does not apply, else None where one is unknown.
        applies = min(before["applies"], applies, key=lambda one: {False: 0, None: 1, True: 2}[one])
    return {**before, **said, "applies": applies, "reason": reason}


def track(
    source: Frames,
    *,
    model: Models = None,
    tracker: Tracker | None = None,
    detector: str | Detector = "spots",
    detect_options: Mapping[str, Any] | None = None,
    stream: str = "probe",
    side: int = SIDE,
    batch: int = 16,
    activity: bool = False,
    turns: Turns | None = None,
    ahead: bool = False,
    progress: Progress = quiet,
) -> Iterator[TrackedFrame]:
    """Find the retro-reflections in frames, follow them, and estimate the camera's state by models.

    Models see the square around the brightest point of each smoothed spot, as the paper crops it. They must be trained
    on crops of this side, from a probe with the same pixels.

    Parameters
    ----------
    source
        A camera (`camera:0`), a folder of images, an image, a recording, a video, or frames.
    model
        A fitted estimator, the folder of a saved one, or several of them that estimate different quantities.
    tracker
        Default: one that suits the detector (see `usual_tracker`). Its earlier tracks are kept.
    detector
        What finds the spots of a frame: a name of `tapetum.track.detector.DETECTORS`, or a `Detector`.
    detect_options
        Options of a detector by its name, of "spots" those of `detect`, of "cameras" those of
        `tapetum.track.cameras.CameraDetector`. `largest` is `side` by default, 60 for "cameras": wider spots are walls
        and lamps.
    stream
        Which stream of a recording.
    side
        Side of the crops in pixels.
    batch
        Frames per call of the models. 1 gives the least delay; more are faster in all.
    activity
        Whether to say of each track if its camera images (`TrackRow.active`), for cameras whose filter's return
        overfills the probe's aperture, as phones' do.
    turns
        Has the models asked about some of a frame's spots only, by turns; rows of the others have no estimates.
    ahead
        Of frames that are made on demand: whether a thread of its own asks for the next one and searches it while
        models are asked about the one before (see `tapetum.track.ahead.found_next`). Stored ones and cameras always
        are read and searched ahead.
    progress
        Shows how far the work is.

    Returns
    -------
    iterator of TrackedFrame
        One for each frame, in order, empty ones included.

    Raises
    ------
    InputError
        When the source or a model cannot be opened, two models estimate the same quantity, or an option is out of
        range. A damaged frame raises when its turn comes.

    Examples
    --------
    >>> image = np.zeros((48, 64), np.uint8)
    >>> image[20:25, 30:35] = 200
    >>> for tracked in track([Frame(0, 0.0, image), Frame(1, 0.1, image)]):
    ...     print(tracked.frame, [(row.track, round(row.x), round(row.y)) for row in tracked.rows])
    0 [(1, 32, 22)]
    1 [(1, 32, 22)]
    """
    _check_sizes(batch, side)
    find = _detector(detector, detect_options, side)
    estimators = _loaded(model)
    follower = usual_tracker(find) if tracker is None else tracker
    frames = _opened(source, stream)
    pairs = _found(frames, taken(frames, threading.Event()), find, ahead)
    tracked = _track(pairs, seeing(estimators, frames), follower, side, batch, activity, turns)
    return progress(tracked, "tracking", total=_count(frames))


def _check_sizes(batch: int, side: int) -> None:
    whole(batch, "batch", "give a number of frames", least=1, most=10**6)
    whole(side, "side", "give a number of pixels", least=1, most=10**6)


def make_detector(name: str, options: Mapping[str, Any] | None = None, side: int = SIDE) -> Detector:
    """Make a detector of `DETECTORS`; InputError for an unknown name or option.

    Models cannot see spots wider than their crops of this `side` as a whole: these are left out by default.
    """
    kind = DETECTORS[one_of(name, tuple(DETECTORS), "detector")]
    usual = {"largest": min(float(side), getattr(kind, "usual_largest", math.inf))}
    return kind(**{**usual, **(options or {})})


def _detector(detector: str | Detector, options: Mapping[str, Any] | None, side: int) -> Detector:
    """Return a detector by its name and options, or the one that was given."""
    if isinstance(detector, str):
        return make_detector(detector, options, side)
    if options:
        what = "belong to a detector by its name"
        raise InputError(what, where="detect_options", remedy="give the detector its options where it is made")
    return detector


def usual_tracker(detector: Detector) -> Tracker:
    """Return the tracker that suits a detector: its own `tracker()`, or one with the usual options."""
    own = getattr(detector, "tracker", None)
    return Tracker() if own is None else own()


def _opened(source: Frames, stream: str) -> Source | Iterable[Frame]:
    remedy = "give a path, a camera, or Frames: Frame(n, time, image) for an image of an array"
    of_type(source, (str, os.PathLike, Iterable, Source), "source", remedy)
    if isinstance(source, np.ndarray):
        raise InputError("is an array", where="source", remedy=remedy)
    # A truncated video gives its readable frames first: their rows are kept, and the error says so.
    return open_frames(source, stream, late=True) if isinstance(source, (str, os.PathLike)) else source


def _count(frames: Source | Iterable[Frame]) -> int | None:
    if isinstance(frames, Source):
        return frames.count
    return len(frames) if isinstance(frames, Sequence) else None


def _found(
    source: Source | Iterable[Frame], frames: Iterator[Frame], find: Detector, ahead: bool = False
) -> Iterator[tuple[Frame, Detections]]:
    """Yield the frames taken from a source with their spots, which are sought ahead where the source allows it."""
    # Models, which follow in the other thread, need the cores that BLAS would occupy.
    with one_blas_thread():
        # Frames that somebody makes on demand are asked for when their turn comes, in the thread that asks.
        if isinstance(source, (Source, Sequence)):
            yield from found_ahead(frames, find)
        elif ahead:
            yield from found_next(frames, find)
        else:
            for frame in frames:
                yield frame, find(frame)


def _track(
    pairs: Iterator[tuple[Frame, Detections]],
    estimators: Sequence[Predictor],
    tracker: Tracker,
    side: int,
    batch: int,
    activity: bool,
    turns: Turns | None = None,
) -> Iterator[TrackedFrame]:
    activities: dict[int, Activity] | None = {} if activity else None
    waiting: list[tuple[Frame, Detections]] = []

    def finished() -> Iterator[TrackedFrame]:
        for (frame, found), answers in zip(waiting, _estimates(waiting, estimators, side, turns), strict=True):
            if activity:
                _add_asymmetries(frame, found, answers)
            height, width = frame.image.shape
            tracked = TrackedFrame.of(about(frame), found, answers, tracker, activities, (width, height))
            if turns is not None:
                turns.followed(tracked.rows, frame.time)
            yield tracked
        waiting.clear()

    # Without models there is nothing to wait for.
    size = batch if estimators else 1
    try:
        for pair in pairs:
            waiting.append(pair)
            if len(waiting) >= size:
                yield from finished()
    except (Exception, KeyboardInterrupt):
        # Yield the results before the failed frame first.
        yield from finished()
        raise
    yield from finished()


def track_to_file(
    source: Frames,
    out: str | os.PathLike[str],
    *,
    model: Models = None,
    detections: str | os.PathLike[str] | None = None,
    tracker: Tracker | None = None,
    detector: str | Detector = "spots",
    detect_options: Mapping[str, Any] | None = None,
    stream: str = "probe",
    side: int = SIDE,
    batch: int = 16,
    activity: bool = False,
    seconds: float | None = None,
    progress: Progress = quiet,
) -> TrackSummary:
    """Track, and write the table of tracks as it grows.

    Parameters
    ----------
    source, model, tracker, detector, detect_options, stream, side, batch, activity, progress
        As for `track`.
    out
        The table of tracks: .parquet, .csv or .jsonl. An existing file is replaced only on success. After Ctrl-C or a
        frame that cannot be read the rows so far stay beside it, as `NAME.unfinished` with the same suffix. Ctrl-C is
        the normal end of a camera's table, which is then complete.
    detections
        Where to keep all detections, ghosts marked and included, with the models' estimates: `retrack` makes tracks of
        it without the video. A frame in which nothing was found has one row without a spot.
    seconds
        Length, from the first frame on; default: all.

    Raises
    ------
    InputError
        As `track`; also when a file cannot be written. Notes on it say what is kept.
    KeyboardInterrupt
        After Ctrl-C on what is stored, once the frame under way is done; with the same notes.
    """
    checked_suffix(out)
    _check_sizes(batch, side)
    if seconds is not None and not 0 < seconds < math.inf:
        raise InputError(f"must be positive, is {seconds}", where="seconds", remedy="leave it out for all frames")
    if detections is not None and Path(detections).resolve() == Path(out).resolve():
        raise InputError("is the table of tracks too", where=detections, remedy="name another file")
    estimators = _loaded(model)
    names = [name for estimator in estimators for name in estimator.target_names]
    options = dict(detect_options or {})
    if detections is not None:
        checked_suffix(detections)
        if isinstance(detector, str):
            options["ghosts"] = "mark"
    stop = threading.Event()
    opened = _opened(source, stream)
    find = _detector(detector, options, side)
    pairs = _found(opened, taken(opened, stop, seconds), find)
    follower = usual_tracker(find) if tracker is None else tracker
    tracked = progress(
        _track(pairs, seeing(estimators, opened), follower, side, batch, activity),
        "tracking",
        total=None if seconds is not None else _count(opened),
    )
    frames = rows = seen = lost = 0
    numbers: set[int] = set()
    with ExitStack() as stack:
        kept = None if detections is None else stack.enter_context(table_writer(detections, detections_schema(names)))
        table = stack.enter_context(table_writer(out, track_schema(names)))
        stack.enter_context(interruptible(stop))
        for one in tracked:
            frames, lost = frames + 1, lost + one.moment["lost"]
            for row in one.rows:
                table.write(row.record())
                rows, seen = rows + 1, seen + row.seen
                numbers.add(row.track)
            if kept is not None:
                for record in one.detection_records():
                    kept.write(record)
        if stop.is_set() and not getattr(opened, "live", False):
            raise KeyboardInterrupt
    return TrackSummary(frames, len(numbers), rows, seen, lost, unsure_of(estimators, opened))
