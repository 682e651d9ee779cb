"""Rows of tracks: the tracks of each frame, and tracks recomputed from stored detections."""

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
from tapetum.track.activity import Activity
from tapetum.track.detections import Detections
from tapetum.track.motion import motion_columns, motion_of
from tapetum.track.tables import (
    MOMENT,
    SIZE,
    check_columns,
    detections_schema,
    estimate_columns,
    estimated,
    plain,
    read_table,
    rows_of_table,
    track_schema,
)
from tapetum.track.tracker import Tracker

__all__ = ["TrackRow", "TrackedFrame", "retrack"]

_BATCH = 2000
# Fields of a row that are no columns of a table, or columns of another name.
_NOT_COLUMNS = ("moment", "estimates", "certain", "opened", "since", "lately")


@dataclass(frozen=True)
class TrackRow:
    """One track in one frame: a row of the table of tracks.

    Parameters
    ----------
    frame, time, name
        The frame's number, its time in seconds and its name.
    track
        Number of the track.
    x, y
        Pixels: the spot's centroid; the predicted place while the track coasts.
    snr, peak_x, peak_y, diameter
        Of the spot (see `Detections`); None while the track coasts.
    seen
        Whether the spot was detected in this frame.
    event
        What happened to the track in this frame (see `TrackPoint`).
    active
        Whether the camera images now (see `tapetum.track.activity`); None where it is unknown or was not asked for.
    certain
        Whether `active` is beyond doubt (see `Activity.certain`). Not in tables.
    opened
        In the frame in which it was noticed that a shutter opened on the camera's sensor: when that was, seconds. In
        tables it is part of `event`.
    since
        When the first detection of the track was made, seconds; None where it is unknown. Not in tables.
    lately
        Whether each of the latest frames shows it (see `TrackPoint`); empty where it is unknown. Not in tables.
    moment
        Further data of the frame: `utc_ns`, `exposure`, `lit` and `lost`, as of `Frame`.
    estimates
        Of the models: NAME, NAME_low and NAME_high for each quantity, `device` and `device_probability`; NaN or "none
        of these" where the model does not apply; `applies` (None where unknown) and `reason`. Empty while the track
        coasts.
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
    event: str = ""
    active: bool | None = None
    certain: bool = False
    opened: float | None = None
    since: float | None = None
    lately: tuple[bool, ...] = ()
    moment: Mapping[str, Any] = field(default_factory=dict)
    estimates: Mapping[str, Any] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """The row as the columns of the table.

        `device` and `device_probability` are absent where no model recognises devices.
        """
        own = {name: value for name, value in vars(self).items() if name not in _NOT_COLUMNS}
        shutter = "" if self.opened is None else f"shutter opened at {self.opened:.3f} s"
        event = "; ".join(one for one in (self.event, shutter) if one)
        return {**own, "event": event or None, **self.moment, **self.estimates}


@dataclass(frozen=True)
class TrackedFrame:
    """The result of tracking one frame.

    Parameters
    ----------
    frame, time, name
        The frame's number, its time in seconds and its name.
    rows
        Its live tracks, those that coast included.
    detections
        The spots found in it.
    estimates
        Of the models for each spot; empty for ghosts.
    moment
        As of `TrackRow`.
    size
        (width, height) of the frame in pixels; None where it is unknown.
    """

    frame: int
    time: float
    name: str
    rows: tuple[TrackRow, ...]
    detections: Detections
    estimates: tuple[Mapping[str, Any], ...]
    moment: Mapping[str, Any] = field(default_factory=dict)
    size: tuple[int, int] | None = None

    @classmethod
    def of(
        cls,
        about: Mapping[str, Any],
        found: Detections,
        answers: Sequence[Mapping[str, Any]],
        tracker: Tracker,
        activities: dict[int, Activity] | None = None,
        size: tuple[int, int] | None = None,
    ) -> TrackedFrame:
        """Follow the spots of a frame; `about` holds its frame, time, name and moment, `activities` those by track."""
        rows: list[TrackRow] = []
        dark = about["moment"].get("lit") is False and not len(found)
        for point in tracker.update(found, about["time"], dark=dark, devices=_devices(answers), size=size):
            n = point.detection
            spot: dict[str, Any] = {
                name: None if n is None else float(getattr(found, name)[n])
                for name in ("snr", "peak_x", "peak_y", "diameter")
            }
            place: dict[str, Any] = {"track": point.track, "x": point.x, "y": point.y, "seen": point.seen}
            place |= {"event": point.event, "since": point.since, "lately": point.lately}
            if activities is not None:
                known = activities.setdefault(point.track, Activity())
                before = known.opened
                place["active"] = known.update(None if n is None else answers[n].get("asymmetry"), about["time"])
                place["certain"] = place["active"] is not None and known.certain
                place["opened"] = None if known.opened == before else known.opened
            rows.append(TrackRow(**about, **place, **spot, estimates={} if n is None else answers[n]))
        return cls(**about, rows=tuple(rows), detections=found, estimates=tuple(answers), size=size)

    def detection_records(self) -> Iterator[dict[str, Any]]:
        """Yield the rows of a table of detections; one without a spot where nothing was found."""
        where = {"frame": self.frame, "time": self.time, "name": self.name, **self.moment}
        if self.size is not None:
            where |= dict(zip(SIZE, self.size, strict=True)) | motion_columns(self.detections.motion, self.size)
        if not len(self.detections):
            yield where
        for n, answers in enumerate(self.estimates):
            yield {**where, **{name: getattr(self.detections, name)[n] for name in Detections.names()}, **answers}


def _devices(answers: Sequence[Mapping[str, Any]]) -> list[str | None] | None:
    """What models take each spot for; None for those that resemble no known device, and where no model says."""
    if not any(one.get("device") for one in answers):
        return None
    # PyTorch takes a second to import, and tracking alone does not need it.
    from tapetum.models import NONE_OF_THESE

    return [None if one.get("device") == NONE_OF_THESE else one.get("device") for one in answers]


def about(frame: Frame) -> dict[str, Any]:
    """The frame's data that tables keep."""
    moment = {name: getattr(frame, name) for name in MOMENT}
    return {"frame": frame.index, "time": frame.time, "name": frame.name, "moment": moment}


def retrack(detections: pa.Table | str | os.PathLike[str], *, tracker: Tracker | None = None) -> pa.Table:
    """Recompute tracks from stored detections, without the video, to try other options of the tracker.

    Parameters
    ----------
    detections
        The table that `track_to_file` kept, or its path.
    tracker
        Default: one with its usual options. Its earlier tracks are dropped.

    Returns
    -------
    pyarrow.Table
        A table of tracks, as `track_to_file` writes it, with the estimates that were kept.

    Raises
    ------
    InputError
        When the table cannot be read or does not hold detections.
    """
    schema = detections_schema()
    table = read_table(detections, schema) if isinstance(detections, (str, os.PathLike)) else detections
    check_columns(table, schema.names, "detections", "give a table of track_to_file")
    extra = [name for name in table.column_names if name not in schema.names]
    names = estimated(extra) + (["device"] if {"device", "device_probability"} <= set(extra) else [])
    columns, whole = {**estimate_columns(names), "asymmetry": pa.float64()}, track_schema(names)
    asked = "asymmetry" in table.column_names and table["asymmetry"].null_count < table.num_rows
    activities: dict[int, Activity] | None = {} if asked else None
    follower = Tracker() if tracker is None else tracker
    follower.reset()
    kept: list[pa.RecordBatch] = []
    records: list[dict[str, Any]] = []

    def keep() -> None:
        kept.append(pa.RecordBatch.from_pylist(records, schema=whole))
        records.clear()

    for number, group in groupby(rows_of_table(table), key=lambda row: row["frame"]):
        rows = list(group)
        if not isinstance(rows[0]["time"], float) or not math.isfinite(rows[0]["time"]):
            what = f"frame {number} has none, it holds {rows[0]['time']}"
            raise InputError(what, where="time", remedy="give each frame its seconds, or leave its rows out")
        spots = [row for row in rows if row["x"] is not None]
        # Tables of older versions say which spots are weak, or lack that too, and whether the models apply.
        spots = [{**row, "evidence": _counted(row)} for row in spots]
        answers = [{name: _given(row.get(name), kind) for name, kind in columns.items()} for row in spots]
        moment = {name: rows[0].get(name) for name in MOMENT}
        frame = {"frame": rows[0]["frame"], "time": rows[0]["time"], "name": rows[0]["name"] or "", "moment": moment}
        width, height = (rows[0].get(name) for name in SIZE)
        size = None if width is None or height is None else (width, height)
        columns_of = {name: [row[name] for row in spots] for name in Detections.names()}
        found = Detections.of(columns_of, motion_of(rows[0], size))
        followed = TrackedFrame.of(frame, found, answers, follower, activities, size)
        records += [plain(row.record(), whole.names) for row in followed.rows]
        if len(records) >= _BATCH:
            keep()
    keep()
    return pa.Table.from_batches(kept, schema=whole)


def _counted(row: Mapping[str, Any]) -> float:
    counts = row.get("evidence")
    return float(not row.get("weak")) if counts is None else counts


def _given(value: Any, kind: pa.DataType) -> Any:
    return math.nan if value is None and pa.types.is_floating(kind) else value
