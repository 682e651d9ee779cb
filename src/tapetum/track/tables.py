"""Tables on disk: tracks and detections, as Parquet, CSV or lines of JSON, row by row."""

from __future__ import annotations

import contextlib
import errno
import io
import itertools
import json
import math
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from tapetum.durable import sync
from tapetum.errors import InputError
from tapetum.files import atomic_file, free_name, told_when_full
from tapetum.track.detections import Detections

__all__ = [
    "TableWriter",
    "detections_schema",
    "read_table",
    "read_tracks",
    "table_writer",
    "track_schema",
    "write_tracks",
]

SUFFIXES = (".parquet", ".csv", ".jsonl")
_FLUSH = 2000
_SECONDS = 1.0

_DEVICE = {"device": pa.string(), "device_probability": pa.float64()}
_JUDGED = {"applies": pa.bool_(), "reason": pa.string()}
# What is known of a frame beside its time. Tables of older versions lack it.
MOMENT = {"utc_ns": pa.int64(), "exposure": pa.float64(), "lit": pa.bool_(), "lost": pa.int64()}
_TRACK = {
    "frame": pa.int64(),
    "time": pa.float64(),
    "track": pa.int64(),
    "x": pa.float64(),
    "y": pa.float64(),
    "snr": pa.float64(),
    "active": pa.bool_(),
    **{f"gaze_{axis}{end}": pa.float64() for axis in "xy" for end in ("", "_low", "_high")},
    **_DEVICE,
    "seen": pa.bool_(),
    "peak_x": pa.float64(),
    "peak_y": pa.float64(),
    "diameter": pa.float64(),
    "name": pa.string(),
    **MOMENT,
}
_DETECTION = {
    "frame": pa.int64(),
    "time": pa.float64(),
    "name": pa.string(),
    **MOMENT,
    **{
        name: {"area": pa.int64(), "saturated": pa.int64(), "edge": pa.bool_(), "ghost": pa.bool_()}.get(
            name, pa.float64()
        )
        for name in Detections.names()
    },
}


def estimate_columns(names: Iterable[str]) -> dict[str, pa.DataType]:
    """Return the columns of what models estimate.

    NAME, NAME_low, NAME_high for each quantity, two for the device, and, where there is any, whether the models apply
    and why not.
    """
    columns: dict[str, pa.DataType] = {}
    for name in names:
        own = _DEVICE if name == "device" else {name + end: pa.float64() for end in ("", "_low", "_high")}
        columns |= own
    return {**columns, **_JUDGED} if columns else columns


def track_schema(estimates: Sequence[str] = ()) -> pa.Schema:
    """Return the columns of a table of tracks, three more for each quantity beside the gaze."""
    return pa.schema({**_TRACK, **{c: kind for c, kind in estimate_columns(estimates).items() if c not in _TRACK}})


def detections_schema(estimates: Sequence[str] = ()) -> pa.Schema:
    """Return the columns of a table of detections, with three for each estimated quantity."""
    return pa.schema({**_DETECTION, **estimate_columns(estimates)})


def checked_suffix(path: str | os.PathLike[str]) -> str:
    """Return the kind of table that a path names by its suffix.

    Raises
    ------
    InputError
        When it names none.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"unknown kind of table {suffix!r}", where=path, remedy=f"use one of {', '.join(SUFFIXES)}")
    return suffix


def finite(value: Any) -> Any:
    """Return a value as tables hold it: what is not finite (an interval without an end) is left empty."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


class TableWriter:
    """Writes rows as they come, so that an hour of tracks needs no memory. Made by `table_writer`.

    Rows grow in a file of their own, `NAME.unfinished` with the table's suffix (`.arrow` for a table in Parquet, which
    can only be read when it is whole). Every second they are handed to the system: that much a kill may cost.
    """

    def __init__(self, target: Path, schema: pa.Schema) -> None:
        self.schema, self.rows, self._target = schema, 0, target
        self._suffix = checked_suffix(target)
        self._pending: list[dict[str, Any]] = []
        self._handed, self._whole, self._since = 0, 0, time.monotonic()
        growing = target.with_suffix(".arrow") if self._suffix == ".parquet" else target
        self.place, self._file = _opened(growing)
        self._arrow = None
        if self._suffix == ".parquet":
            self._arrow = pa.ipc.new_stream(self._file, schema)
        elif self._suffix == ".csv":
            self._arrow = pacsv.CSVWriter(self._file, schema)

    def write(self, row: Mapping[str, Any]) -> None:
        """Add a row; columns that it lacks stay empty."""
        self._pending.append({name: finite(row.get(name)) for name in self.schema.names})
        self.rows += 1
        if len(self._pending) >= _FLUSH or time.monotonic() - self._since > _SECONDS:
            self.flush()

    def flush(self) -> None:
        """Hand the rows written so far to the system."""
        self._since = time.monotonic()
        if not self._pending:
            return
        if self._arrow is None:
            lines = (json.dumps(row, allow_nan=False) + "\n" for row in self._pending)
            self._file.write("".join(lines).encode())
        else:
            self._arrow.write_table(pa.Table.from_pylist(self._pending, schema=self.schema))
        self._file.flush()
        self._whole, self._handed = self._file.tell(), self._handed + len(self._pending)
        self._pending.clear()

    def finish(self) -> None:
        """Write what is left; the table, on the disk and whole, takes its name."""
        self.flush()
        if self._arrow is not None:
            self._arrow.close()
        self._file.close()
        if self._suffix == ".parquet":
            _to_parquet(self.place, self._target)
            self.place.unlink()
            return
        sync(self.place)
        self.place.replace(self._target)
        sync(self._target.absolute().parent)

    def abandon(self) -> str:
        """Close the file after work that failed; return what of it is kept, and where."""
        with contextlib.suppress(OSError, pa.ArrowException):
            self.flush()
        with contextlib.suppress(OSError, pa.ArrowException, ValueError):
            self._file.close()
        if not self._handed:
            self.place.unlink(missing_ok=True)
            return ""
        with contextlib.suppress(OSError):
            # A full disk may have taken a part of the last rows.
            os.truncate(self.place, self._whole)
        if self._suffix == ".parquet":
            with contextlib.suppress(OSError, pa.ArrowException, InputError):
                whole = free_name(self._target, "unfinished")
                _to_parquet(self.place, whole)
                self.place.unlink()
                self.place = whole
        return f"{self._handed} rows are kept in {self.place}"


def _opened(target: Path) -> tuple[Path, Any]:
    """Open a file `NAME.unfinished.SUFFIX` that was not there before."""
    while True:
        place = free_name(target, "unfinished")
        with contextlib.suppress(FileExistsError):
            return place, place.open("xb")


def _to_parquet(stream: Path, target: Path) -> None:
    """Write the rows of an Arrow stream as Parquet, some thousands at a time."""
    with atomic_file(target) as part:
        batches = _batches(stream)
        first = next(batches)
        with pq.ParquetWriter(part, first.schema) as writer:
            waiting: list[pa.RecordBatch] = []
            for batch in itertools.chain([first], batches):
                waiting.append(batch)
                if sum(one.num_rows for one in waiting) >= _FLUSH:
                    writer.write_table(pa.Table.from_batches(waiting))
                    waiting.clear()
            if waiting:
                writer.write_table(pa.Table.from_batches(waiting))


def _batches(stream: Path) -> Iterator[pa.RecordBatch]:
    """Yield the batches of an Arrow stream, an empty one first, as far as it is whole."""
    with stream.open("rb") as file, pa.ipc.open_stream(file) as reader:
        yield pa.RecordBatch.from_pylist([], schema=reader.schema)
        while True:
            try:
                batch = reader.read_next_batch()
            except (StopIteration, OSError, pa.ArrowException):
                return
            yield batch


@contextmanager
def table_writer(path: str | os.PathLike[str], schema: pa.Schema) -> Iterator[TableWriter]:
    """Open a table for writing; it takes its name only when all went well.

    Where the work fails or is interrupted, its rows so far are kept as `NAME.unfinished.SUFFIX` beside it, and a note
    on the error says so (`__notes__`). A file that stood at `path` then still stands.

    Raises
    ------
    InputError
        When the suffix is none of .parquet, .csv, .jsonl, or the file cannot be written.
    """
    checked_suffix(path)
    writer = None
    try:
        with told_when_full(path):
            Path(path).absolute().parent.mkdir(parents=True, exist_ok=True)
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


def _read(path: Path, suffix: str, known: Mapping[str, pa.DataType]) -> pa.Table:
    if suffix == ".parquet":
        return pq.read_table(path)
    if suffix == ".arrow":
        return pa.Table.from_batches(list(_batches(path)))
    # A kill may tear the last line of what was being written.
    text = path.read_bytes()
    torn = ".unfinished" in path.name and not text.endswith(b"\n")
    text = text[: text.rfind(b"\n") + 1] if torn else text
    if suffix == ".csv":
        header = [name.strip().strip('"') for name in text.split(b"\n", 1)[0].decode().split(",")]
        types = {name: known.get(name, pa.float64()) for name in header}
        options = pacsv.ConvertOptions(column_types=types, strings_can_be_null=True)
        return pacsv.read_csv(io.BytesIO(text), convert_options=options)
    rows = [json.loads(line) for line in text.decode().splitlines() if line.strip()]
    if not all(isinstance(row, dict) for row in rows):
        raise ValueError("a line is no JSON object")
    names = list(rows[0]) if rows else list(known)
    return pa.Table.from_pylist(rows, schema=pa.schema({name: known.get(name, pa.float64()) for name in names}))


def read_table(path: str | os.PathLike[str], schema: pa.Schema) -> pa.Table:
    """Read a table that `table_writer` wrote.

    Parameters
    ----------
    path
        .parquet, .csv or .jsonl; or what a killed run left, `NAME.unfinished.arrow` among them.
    schema
        Columns that must be there, but for those of `MOMENT`, which are empty then. Others are kept, behind them.

    Raises
    ------
    InputError
        When the file is missing or damaged, or lacks a column.
    """
    place = Path(path)
    suffix = ".arrow" if place.suffix == ".arrow" else checked_suffix(place)
    if not place.is_file():
        raise InputError("no such file", where=place, remedy="check the path")
    try:
        table = _read(place, suffix, {**_DEVICE, **_JUDGED, **{field.name: field.type for field in schema}})
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"cannot be read as {suffix[1:]} ({error})", where=place, remedy="write it again") from error
    missing = [name for name in schema.names if name not in table.column_names and name not in MOMENT]
    if missing:
        raise InputError(f"no column {', '.join(missing)}", where=place, remedy="give a table that Tapetum wrote")
    for name in set(MOMENT) & set(schema.names) - set(table.column_names):
        table = table.append_column(name, pa.nulls(len(table), MOMENT[name]))
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


def write_tracks(table: pa.Table, path: str | os.PathLike[str]) -> None:
    """Write a table of tracks (.parquet, .csv or .jsonl).

    Raises
    ------
    InputError
        When the suffix is another one, or the table lacks a column of tracks.
    """
    missing = [name for name in _TRACK if name not in table.column_names and name not in MOMENT]
    if missing:
        raise InputError(f"no column {', '.join(missing)}", where="tracks")
    with table_writer(path, table.schema) as writer:
        for batch in table.to_batches(max_chunksize=_FLUSH):
            for row in batch.to_pylist():
                writer.write(row)
