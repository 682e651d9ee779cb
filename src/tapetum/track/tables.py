"""Tables of tracks and detections: their columns, writing them row by row, and reading them."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tapetum.durable import sync
from tapetum.errors import InputError, of_type
from tapetum.files import free_name, reserved, told_when_full
from tapetum.track.detections import Detections
from tapetum.track.formats import FORMATS, to_parquet
from tapetum.track.motion import MOTION

__all__ = [
    "TableWriter",
    "detections_schema",
    "read_table",
    "read_tracks",
    "table_writer",
    "track_schema",
    "write_tracks",
]

ENDS = ("", "_low", "_high")
"""Of the columns of an estimated quantity: its value and the ends of its 90 % interval."""
_FLUSH = 2000
_SECONDS = 1.0

_FRAME = {"frame": pa.int64(), "time": pa.float64()}
_NAME = {"name": pa.string()}
# Further data of a frame. Tables of older versions lack them.
MOMENT = {"utc_ns": pa.int64(), "exposure": pa.float64(), "lit": pa.bool_(), "lost": pa.int64()}
# Of the frame in which a spot was found, pixels.
SIZE = {"width": pa.int64(), "height": pa.int64()}
_EVENT = {"event": pa.string()}
# Of a detection: see `tapetum.track.activity`.
_ASYMMETRY = {"asymmetry": pa.float64()}
# Of a detection: see `Detections`.
_EVIDENCE = {"evidence": pa.float64()}
_MOTION = dict.fromkeys(MOTION, pa.float64())
# Of tables of detections of older versions, in place of the evidence.
_FORMER = {"weak": pa.bool_()}
_LATER = {**MOMENT, **SIZE, **_EVENT, **_ASYMMETRY, **_EVIDENCE, **_MOTION}
_DEVICE = {"device": pa.string(), "device_probability": pa.float64()}
# Of a live watch's rows: the camera's stay, as its events name it.
_STAY = {"id": pa.string()}
_JUDGED = {"applies": pa.bool_(), "reason": pa.string()}
_SPOT = {name: pa.from_numpy_dtype(kind) for name, kind in Detections.types().items()}
_GAZE = {f"gaze_{axis}{end}": pa.float64() for axis in "xy" for end in ENDS}
_TRACK = {
    **_FRAME,
    "track": pa.int64(),
    **{name: _SPOT[name] for name in ("x", "y", "snr")},
    "active": pa.bool_(),
    **_GAZE,
    **_DEVICE,
    "seen": pa.bool_(),
    **{name: _SPOT[name] for name in ("peak_x", "peak_y", "diameter")},
    **_NAME,
    **MOMENT,
    **_EVENT,
}


def estimate_columns(names: Iterable[str]) -> dict[str, pa.DataType]:
    """The columns of the models' estimates.

    NAME, NAME_low and NAME_high for each quantity, two for the device, and, where there is any, whether the models
    apply and why not.
    """
    columns: dict[str, pa.DataType] = {}
    for name in names:
        columns |= _DEVICE if name == "device" else {name + end: pa.float64() for end in ENDS}
    return {**columns, **_JUDGED} if columns else columns


def estimated(columns: Iterable[str]) -> list[str]:
    """Return the quantities that have estimates with intervals among some columns."""
    there = list(columns)
    return [name for name in there if {name + end for end in ENDS} <= set(there)]


def track_schema(estimates: Sequence[str] = ()) -> pa.Schema:
    """Return the columns of a table of tracks, three more for each quantity beside the gaze."""
    return pa.schema({**_TRACK, **{c: kind for c, kind in estimate_columns(estimates).items() if c not in _TRACK}})


def detections_schema(estimates: Sequence[str] = ()) -> pa.Schema:
    """Return the columns of a table of detections, with three for each estimated quantity."""
    return pa.schema(
        {**_FRAME, **_NAME, **MOMENT, **SIZE, **_MOTION, **_SPOT, **_ASYMMETRY, **estimate_columns(estimates)}
    )


def checked_suffix(path: str | os.PathLike[str]) -> str:
    """The kind of table of a path, by its suffix, or an InputError."""
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"unknown kind of table {suffix!r}", where=path, remedy=f"use one of {', '.join(FORMATS)}")
    return suffix


def as_table(table: Any, where: str = "table") -> pa.Table:
    """Return a table of tracks or detections as Arrow's, also one of pandas, polars or whatever offers Arrow's columns.

    Known columns get their types again, which pandas changes where values are missing. InputError for anything else.
    """
    if isinstance(table, pa.Table):
        return table
    if not hasattr(table, "__arrow_c_stream__"):
        of_type(table, pa.Table, where, "give an Arrow table or a data frame of pandas")
    try:
        # pandas' index is no column of a table.
        taken = pa.table(table).replace_schema_metadata()
        taken = taken.select([name for name in taken.column_names if not name.startswith("__index_level_")])
        known = {**_JUDGED, **_STAY, **_FORMER, **_LATER, **_TRACK}
        return taken.cast(pa.schema([(one.name, known.get(one.name, one.type)) for one in taken.schema]))
    except (pa.ArrowException, ValueError, TypeError) as error:
        raise InputError(f"a column has the wrong type ({error})", where=where) from error


def check_columns(table: pa.Table, names: Iterable[str], where: object, remedy: str | None = None) -> None:
    """Raise an InputError where a table lacks columns, except those of `_LATER`, which older tables lack."""
    if missing := [name for name in names if name not in table.column_names and name not in _LATER]:
        raise InputError(f"no column {', '.join(missing)}", where=where, remedy=remedy)


def plain(values: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """A row as tables hold it: missing and infinite values are empty."""
    row: dict[str, Any] = {}
    for name in names:
        value = values.get(name)
        value = value.item() if isinstance(value, np.generic) else value
        row[name] = None if isinstance(value, float) and not math.isfinite(value) else value
    return row


class TableWriter:
    """Writes rows as they come, so memory does not grow with the length of a track. Made by `table_writer`.

    Rows grow in a separate file, `NAME.unfinished` with the table's suffix (`.arrow` for Parquet, which can only be
    read when complete). It is flushed every second, so a killed process loses no more than that.
    """

    def __init__(self, target: Path, schema: pa.Schema) -> None:
        self.schema, self._target = schema, target
        self._format = FORMATS[checked_suffix(target)]
        self._pending: list[dict[str, Any]] = []
        self._handed, self._whole, self._since = 0, 0, time.monotonic()
        growing = target.with_suffix(self._format.grows_as or target.suffix)
        while True:
            self.place = free_name(growing, "unfinished")
            with contextlib.suppress(FileExistsError):
                self._file = self.place.open("xb")
                break
        self._sink = self._format.sink(self._file, schema)

    def write(self, row: Mapping[str, Any]) -> None:
        """Add a row; columns that it lacks stay empty."""
        self._pending.append(plain(row, self.schema.names))
        if len(self._pending) >= _FLUSH or time.monotonic() - self._since > _SECONDS:
            self.flush()

    def flush(self) -> None:
        """Hand the rows written so far to the system."""
        self._since = time.monotonic()
        if not self._pending:
            return
        self._sink.write_table(pa.Table.from_pylist(self._pending, schema=self.schema))
        self._file.flush()
        self._whole, self._handed = self._file.tell(), self._handed + len(self._pending)
        self._pending.clear()

    def finish(self) -> None:
        """Write what is left; the table, on the disk and whole, takes its name."""
        self.flush()
        self._sink.close()
        self._file.close()
        if self._format.grows_as is not None:
            to_parquet(self.place, self._target)
            self.place.unlink()
            return
        sync(self.place)
        self.place.replace(self._target)
        sync(self._target.absolute().parent)

    def abandon(self) -> str:
        """Close the file after a failure; return what is kept, and where."""
        with contextlib.suppress(OSError, pa.ArrowException):
            self.flush()
        with contextlib.suppress(OSError, pa.ArrowException, ValueError):
            self._file.close()
        if not self._handed:
            self.place.unlink(missing_ok=True)
            return ""
        with contextlib.suppress(OSError):
            # On a full disk the last rows may be truncated.
            os.truncate(self.place, self._whole)
        if self._format.grows_as is not None:
            with contextlib.suppress(OSError, pa.ArrowException, InputError):
                whole = free_name(self._target, "unfinished")
                to_parquet(self.place, whole)
                self.place.unlink()
                self.place = whole
        return f"{self._handed} rows are kept in {self.place}"


@contextmanager
def table_writer(path: str | os.PathLike[str], schema: pa.Schema) -> Iterator[TableWriter]:
    """Open a table for writing; `path` is replaced only when all rows are written.

    After a failure or an interruption the rows so far are kept as `NAME.unfinished.SUFFIX` beside it, and a note on the
    error says so (`__notes__`). InputError when the suffix is none of `FORMATS`, the file cannot be written, or another
    command is writing it.
    """
    checked_suffix(path)
    writer = None
    try:
        with reserved(path), told_when_full(path):
            if Path(path).is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            writer = TableWriter(Path(path), schema)
            yield writer
            writer.finish()
    except BaseException as error:
        kept = "" if writer is None else writer.abandon()
        if kept:
            error.add_note(kept)
        raise


def read_table(path: str | os.PathLike[str], schema: pa.Schema) -> pa.Table:
    """Read a table that `table_writer` wrote, in one of `FORMATS`, or the `NAME.unfinished.SUFFIX` of a killed run.

    The columns of `schema` must be there, except those of `_LATER`, which are empty if absent. Others are kept, behind
    them. InputError when the file is missing or damaged, or lacks a column.
    """
    place = Path(path)
    suffix = checked_suffix(place)
    if not place.is_file():
        raise InputError("no such file", where=place, remedy="check the path")
    try:
        known = {**_DEVICE, **_JUDGED, **_STAY, **_FORMER, **{field.name: field.type for field in schema}}
        table = FORMATS[suffix].read(place, known)
    except (pa.ArrowException, OSError, ValueError) as error:
        remedy = "give a whole table, of tracks or of detections as it is asked for"
        raise InputError(f"cannot be read as {suffix[1:]} ({error})", where=place, remedy=remedy) from error
    check_columns(table, schema.names, place, "give a table that Tapetum wrote")
    for name in set(schema.names) - set(table.column_names):
        table = table.append_column(name, pa.nulls(len(table), _LATER[name]))
    extra = [name for name in table.column_names if name not in schema.names]
    try:
        whole = pa.schema([*schema, *(table.schema.field(name) for name in extra)])
        return table.select([*schema.names, *extra]).cast(whole)
    except (pa.ArrowException, ValueError) as error:
        raise InputError(f"a column has the wrong type ({error})", where=place) from error


def read_tracks(path: str | os.PathLike[str]) -> pa.Table:
    """Read a table of tracks (.parquet, .csv or .jsonl): see `track_schema` for its columns.

    Raises
    ------
    InputError
        When the file is missing or damaged, or is no table of tracks.
    """
    return read_table(path, track_schema())


def write_tracks(table: Any, path: str | os.PathLike[str]) -> None:
    """Write a table of tracks (.parquet, .csv or .jsonl), of Arrow or pandas.

    Raises
    ------
    InputError
        When the suffix is another one, or the table lacks a column of tracks.
    """
    table = as_table(table)
    check_columns(table, _TRACK, "tracks")
    with table_writer(path, table.schema) as writer:
        for row in rows_of_table(table):
            writer.write(row)


def rows_of_table(table: pa.Table) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table, some thousands at a time: as Python objects they take a hundred times the memory."""
    for batch in table.to_batches(max_chunksize=_FLUSH):
        yield from batch.to_pylist()
