"""From frames to tracks with estimates: detect, follow, cut out, ask the models."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tapetum.data.crop import crop
from tapetum.errors import InputError
from tapetum.interrupts import interruptible
from tapetum.progress import Progress, quiet
from tapetum.record.frames import open_frames
from tapetum.record.reader import taken
from tapetum.record.source import Frame, Source
from tapetum.track.detect import detect
from tapetum.track.detections import Detections
from tapetum.track.rows import TrackedFrame, detection_records, moment_of, rows_of
from tapetum.track.tables import checked_suffix, detections_schema, table_writer, track_schema
from tapetum.track.tracker import Tracker

if TYPE_CHECKING:
    from tapetum.models.prediction import Prediction

__all__ = ["SIDE", "TrackSummary", "track", "track_to_file"]

SIDE = 400
"""Side of the square that the models are shown, in pixels (the paper's largest crop)."""

Frames: TypeAlias = str | os.PathLike[str] | Source | Iterable[Frame]


class Predictor(Protocol):
    """What tracking asks of a model: any fitted `tapetum.models.Estimator` has it."""

    @property
    def target_names(self) -> tuple[str, ...]: ...

    def predict(self, data: NDArray[Any], /, *, full_scale: float | None = None) -> Prediction: ...


Models: TypeAlias = Predictor | str | os.PathLike[str] | Sequence[Predictor | str | os.PathLike[str]] | None


@dataclass(frozen=True)
class TrackSummary:
    """What was written: numbers of frames, tracks, rows, rows in which the spot was seen, and frames that were lost."""

    frames: int
    tracks: int
    rows: int
    seen: int
    lost: int = 0


def _loaded(models: Models) -> list[Predictor]:
    if models is None:
        return []
    many = [models] if isinstance(models, (str, os.PathLike)) or not isinstance(models, Sequence) else list(models)
    estimators: list[Predictor] = []
    for one in many:
        if isinstance(one, (str, os.PathLike)):
            # PyTorch takes a second to import, and tracking alone does not need it.
            from tapetum.models import load_predictor

            estimators.append(load_predictor(Path(one)))
        else:
            estimators.append(one)
    names = [name for estimator in estimators for name in estimator.target_names]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"two models estimate {', '.join(twice)}", where="model", remedy="give one model a quantity")
    return estimators


def _frames(
    source: Frames, stream: str, stop: threading.Event, seconds: float | None = None
) -> tuple[Iterable[Frame], int | None, bool]:
    """Return the frames, their number where it is known, and whether they come at their own pace."""
    frames = open_frames(source, stream) if isinstance(source, (str, os.PathLike)) else source
    if isinstance(frames, Source):
        return taken(frames, stop, seconds), None if seconds is not None else frames.count, frames.live
    count = len(frames) if isinstance(frames, Sequence) else None
    return _until(stop, frames, seconds), count, False


def _estimates(
    frames: Sequence[tuple[Frame, Detections]], estimators: Sequence[Predictor], side: int
) -> list[list[dict[str, Any]]]:
    """Ask the models about every spot of several frames at once; [frames][spots]."""
    answers: list[list[dict[str, Any]]] = [[{} for _ in range(len(found))] for _, found in frames]
    if not estimators:
        return answers
    places = [(n, int(k)) for n, (_, found) in enumerate(frames) for k in np.flatnonzero(~found.ghost)]

    def depth(place: tuple[int, int]) -> tuple[str, float]:
        frame = frames[place[0]][0]
        return frame.image.dtype.str, float(frame.full_scale or np.iinfo(frame.image.dtype).max)

    # A folder may mix 8 and 16 bit; a batch may not.
    for (_, full_scale), group in groupby(sorted(places, key=depth), key=depth):
        alike = list(group)
        crops = np.stack(
            [
                crop(frames[n][0].image, (float(frames[n][1].peak_x[k]), float(frames[n][1].peak_y[k])), side)
                for n, k in alike
            ]
        )
        for estimator in estimators:
            columns = estimator.predict(crops, full_scale=full_scale).columns()
            for row, (n, k) in enumerate(alike):
                said = {name: _plain(values[row]) for name, values in columns.items()}
                answers[n][k] = _merged(answers[n][k], said, estimator.target_names)
    return answers


def _plain(value: Any) -> Any:
    return value if value is None or isinstance(value, (str, bool)) else float(value)


def _merged(before: dict[str, Any], said: dict[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Add what a model says of a spot to what others said: together they apply where each does."""
    reason = f"{', '.join(names)}: {said['reason']}" if said.get("reason") else ""
    applies = said.get("applies")
    if before:
        reason = "; ".join(one for one in (before["reason"], reason) if one)
        # False where one does not apply, else None where one does not know.
        applies = min(before["applies"], applies, key=lambda one: {False: 0, None: 1, True: 2}[one])
    return {**before, **said, "applies": applies, "reason": reason}


def track(
    source: Frames,
    *,
    model: Models = None,
    tracker: Tracker | None = None,
    detect_options: Mapping[str, Any] | None = None,
    stream: str = "probe",
    side: int = SIDE,
    batch: int = 16,
    progress: Progress = quiet,
) -> Iterator[TrackedFrame]:
    """Find the retro-reflections in frames, follow them, and let models say what each frame tells about the
    camera.

    Models are shown the square around the brightest point of each smoothed spot, as the paper cuts it. A
    model must have been trained on crops of this side, from a probe with the same pixels.

    Parameters
    ----------
    source
        A camera (`camera:0`), a folder of images, an image, a recording, a video, or frames.
    model
        A fitted estimator, the folder of a saved one, or several of them that estimate different quantities.
    tracker
        How to follow; with its usual options where not given. Its earlier tracks are kept.
    detect_options
        Options of `detect`, by name. `largest` is `side` where not given: wider spots are walls and lamps.
    stream
        Which stream of a recording.
    side
        Side of the crops in pixels.
    batch
        Frames that the models are asked about at once. 1 for the least delay; more are quicker in all.
    progress
        Shows how far the work is.

    Returns
    -------
    iterator of TrackedFrame
        One for each frame, in order, empty ones included.

    Raises
    ------
    InputError
        When the source or a model cannot be opened, two models estimate the same quantity, or an option is
        out of range. A damaged frame raises when its turn comes.

    Examples
    --------
    >>> image = np.zeros((48, 64), np.uint8)
    >>> image[20:25, 30:35] = 200
    >>> for tracked in track([Frame(0, 0.0, image), Frame(1, 0.1, image)]):
    ...     print(tracked.frame, [(row.track, round(row.x), round(row.y)) for row in tracked.rows])
    0 [(1, 32, 22)]
    1 [(1, 32, 22)]
    """
    if batch < 1 or side < 1:
        raise InputError(f"batch {batch} and side {side} must be at least 1", where="track")
    # What is wider than the crops no model could be shown whole.
    options = {"largest": float(side), **_detect_options(detect_options)}
    estimators = _loaded(model)
    frames, count, _ = _frames(source, stream, threading.Event())
    follower = Tracker() if tracker is None else tracker
    return _track(progress(frames, "tracking", total=count), estimators, follower, options, side, batch)


def _detect_options(options: Mapping[str, Any] | None) -> dict[str, Any]:
    given = dict(options or {})
    known = {"min_snr", "largest", "max_count", "ghosts", "ghost_ratio", "ghost_radius", "stray", "full_scale"}
    if unknown := sorted(set(given) - known):
        raise InputError(
            f"unknown option {', '.join(unknown)}",
            where="detect_options",
            remedy=f"use {', '.join(sorted(known))}",
        )
    return given


def _track(
    frames: Iterable[Frame],
    estimators: Sequence[Predictor],
    tracker: Tracker,
    options: dict[str, Any],
    side: int,
    batch: int,
) -> Iterator[TrackedFrame]:
    waiting: list[tuple[Frame, Detections]] = []

    def finished() -> Iterator[TrackedFrame]:
        for (frame, found), answers in zip(waiting, _estimates(waiting, estimators, side), strict=True):
            moment = moment_of(frame)
            rows = rows_of(tracker, found, answers, frame.index, frame.time, frame.name, moment)
            yield TrackedFrame(frame.index, frame.time, frame.name, rows, found, tuple(answers), moment)
        waiting.clear()

    # Without models there is nothing to wait for.
    size = batch if estimators else 1
    try:
        for frame in frames:
            waiting.append((frame, detect(frame.image, **{"full_scale": frame.full_scale, **options})))
            if len(waiting) >= size:
                yield from finished()
    except (Exception, KeyboardInterrupt):
        # What was found before the frame that failed comes first.
        yield from finished()
        raise
    yield from finished()


def _until(stop: threading.Event, frames: Iterable[Frame], seconds: float | None) -> Iterator[Frame]:
    for frame in frames:
        if stop.is_set() or (seconds is not None and frame.time >= seconds):
            return
        yield frame


def track_to_file(
    source: Frames,
    out: str | os.PathLike[str],
    *,
    model: Models = None,
    detections: str | os.PathLike[str] | None = None,
    tracker: Tracker | None = None,
    detect_options: Mapping[str, Any] | None = None,
    stream: str = "probe",
    side: int = SIDE,
    batch: int = 16,
    seconds: float | None = None,
    progress: Progress = quiet,
) -> TrackSummary:
    """Track, and write the table of tracks as it grows.

    Parameters
    ----------
    source, model, tracker, detect_options, stream, side, batch, progress
        As for `track`.
    out
        The table of tracks: .parquet, .csv or .jsonl. A file of this name is replaced once all went well. After Ctrl-C
        or a frame that cannot be read the rows so far stay beside it, as `NAME.unfinished` with the same suffix. Ctrl-C
        is how a camera's table ends: it is then whole.
    detections
        Where to keep what was detected, ghosts marked and included, with the models' estimates: `retrack`
        makes tracks of it without the video. A frame in which nothing was found has one row without a spot.
    seconds
        Length, from the first frame on; all of it where left out.

    Returns
    -------
    TrackSummary

    Raises
    ------
    InputError
        As `track`; also when a file cannot be written. Notes on it say what is kept.
    KeyboardInterrupt
        After Ctrl-C on what is stored, once the frame under way is done; with the same notes.
    """
    checked_suffix(out)
    estimators = _loaded(model)
    names = [name for estimator in estimators for name in estimator.target_names]
    options = dict(detect_options or {})
    if detections is not None:
        checked_suffix(detections)
        options["ghosts"] = "mark"
    stop = threading.Event()
    given, count, live = _frames(source, stream, stop, seconds)
    tracked = track(
        progress(given, "tracking", total=count),
        model=estimators,
        tracker=tracker,
        detect_options=options,
        stream=stream,
        side=side,
        batch=batch,
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
                for record in detection_records(one):
                    kept.write(record)
        if stop.is_set() and not live:
            raise KeyboardInterrupt
    return TrackSummary(frames, len(numbers), rows, seen, lost)
