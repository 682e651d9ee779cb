"""Rows of tracks: what a frame says of each track, and tracks made again from detections that were kept."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

import pyarrow as pa

from tapetum.errors import InputError
from tapetum.record.source import Frame
from tapetum.track.detections import Detections
from tapetum.track.tables import MOMENT, detections_schema, estimate_columns, finite, read_table, track_schema
from tapetum.track.tracker import Tracker

__all__ = ["TrackRow", "TrackedFrame", "retrack"]

_BATCH = 2000


@dataclass(frozen=True)
class TrackRow:
    """One track in one frame: a row of the table of tracks.

    Parameters
    ----------
    frame, time, name
        The frame's number, its time in seconds and what it is called.
    track
        Number of the track.
    x, y
        Pixels: the spot's centroid; where the track is expected while it coasts.
    snr, peak_x, peak_y, diameter
        Of the spot (see `Detections`); None while the track coasts.
    seen
        Whether the spot was detected in this frame.
    moment
        What else is known of the frame: `utc_ns`, `exposure`, `lit` and `lost`, as of `Frame`.
    estimates
        What the models say: NAME, NAME_low and NAME_high for each quantity, `device` and `device_probability`; NaN or
        "none of these" where the model does not apply; `applies` (None where nobody knows) and `reason`. Empty while
        the track coasts.
    """

    frame: int
    time: float
    name: str
    track: int
    x: float
    y: float
    snr: float | None
    peak_x: float | None
    peak_y: float | None
    diameter: float | None
    seen: bool
    moment: Mapping[str, Any] = field(default_factory=dict)
    estimates: Mapping[str, Any] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """Return the row as the columns of the table.

        `active` is left out, which makes it empty: whether a camera is recording shows in how its return changes with
        time, which nothing looks at yet. So are `device` and `device_probability` where no model tells devices.
        """
        own = {name: getattr(self, name) for name in self.__dataclass_fields__ if name not in ("moment", "estimates")}
        return {**own, **self.moment, **self.estimates}


@dataclass(frozen=True)
class TrackedFrame:
    """What tracking makes of a frame.

    Parameters
    ----------
    frame, time, name
        The frame's number, its time in seconds and what it is called.
    rows
        The tracks that live in it, those that coast included.
    detections
        The spots found in it.
    estimates
        What the models say of each spot; nothing of ghosts.
    moment
        As of `TrackRow`.
    """

    frame: int
    time: float
    name: str
    rows: tuple[TrackRow, ...]
    detections: Detections
    estimates: tuple[Mapping[str, Any], ...]
    moment: Mapping[str, Any] = field(default_factory=dict)


def moment_of(frame: Frame) -> dict[str, Any]:
    """Return what tables keep of a frame beside its number, time and name."""
    return {name: getattr(frame, name) for name in MOMENT}


def rows_of(
    tracker: Tracker,
    found: Detections,
    answers: Sequence[Mapping[str, Any]],
    frame: int,
    time: float,
    name: str,
    moment: Mapping[str, Any],
) -> tuple[TrackRow, ...]:
    rows: list[TrackRow] = []
    for point in tracker.update(found, time):
        spot = None if point.detection is None else found[point.detection]
        rows.append(
            TrackRow(
                frame=frame,
                time=time,
                name=name,
                track=point.track,
                x=point.x,
                y=point.y,
                snr=None if spot is None else float(spot.snr[0]),
                peak_x=None if spot is None else float(spot.peak_x[0]),
                peak_y=None if spot is None else float(spot.peak_y[0]),
                diameter=None if spot is None else float(spot.diameter[0]),
                seen=spot is not None,
                moment=moment,
                estimates={} if point.detection is None else answers[point.detection],
            )
        )
    return tuple(rows)


def detection_records(one: TrackedFrame) -> Iterator[dict[str, Any]]:
    where = {"frame": one.frame, "time": one.time, "name": one.name, **one.moment}
    if not len(one.detections):
        yield where
    for n, answers in enumerate(one.estimates):
        yield {**where, **{name: getattr(one.detections, name)[n] for name in Detections.names()}, **answers}


def retrack(detections: pa.Table | str | os.PathLike[str], *, tracker: Tracker | None = None) -> pa.Table:
    """Make tracks again from what was detected before, without the video: to try other options of the tracker.

    Parameters
    ----------
    detections
        The table that `track_to_file` kept, or its path.
    tracker
        How to follow; with its usual options where not given. It forgets its earlier tracks.

    Returns
    -------
    pyarrow.Table
        A table of tracks, as `track_to_file` writes it, with the estimates that were kept.

    Raises
    ------
    InputError
        When the table cannot be read or is none of detections.
    """
    schema = detections_schema()
    if isinstance(detections, (str, os.PathLike)):
        table = read_table(detections, schema)
    else:
        table = detections
        if missing := [name for name in schema.names if name not in table.column_names and name not in MOMENT]:
            raise InputError(
                f"no column {', '.join(missing)}", where="detections", remedy="give a table of track_to_file"
            )
    extra = [name for name in table.column_names if name not in schema.names]
    names = [name for name in extra if {f"{name}_low", f"{name}_high"} <= set(extra)]
    names += ["device"] if {"device", "device_probability"} <= set(extra) else []
    follower = Tracker() if tracker is None else tracker
    follower.reset()
    whole = track_schema(names)
    kept: list[pa.RecordBatch] = []
    records: list[dict[str, Any]] = []
    # Rows as Python objects take a hundred times what they take in a table: only some thousands at a time.
    for _, group in groupby(_rows(table), key=lambda row: row["frame"]):
        rows = list(group)
        first = rows[0]
        spots = [row for row in rows if row["x"] is not None]
        found = Detections.of({name: [row[name] for row in spots] for name in Detections.names()})
        # Tables of older versions do not say whether the models apply.
        answers = [{c: _kept(row.get(c), kind) for c, kind in estimate_columns(names).items()} for row in spots]
        moment = {name: first.get(name) for name in MOMENT}
        new = rows_of(follower, found, answers, first["frame"], first["time"], first["name"] or "", moment)
        records += [row.record() for row in new]
        if len(records) >= _BATCH:
            kept.append(_batch(records, whole))
            records.clear()
    return pa.Table.from_batches([*kept, _batch(records, whole)], schema=whole)


def _rows(table: pa.Table) -> Iterator[dict[str, Any]]:
    for batch in table.to_batches(max_chunksize=_BATCH):
        yield from batch.to_pylist()


def _batch(records: Sequence[Mapping[str, Any]], schema: pa.Schema) -> pa.RecordBatch:
    clean = [{c: finite(row.get(c)) for c in schema.names} for row in records]
    return pa.RecordBatch.from_pylist(clean, schema=schema)


def _kept(value: Any, kind: pa.DataType) -> Any:
    return math.nan if value is None and pa.types.is_floating(kind) else value
