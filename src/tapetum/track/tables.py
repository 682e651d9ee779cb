"""Tables on disk: tracks and detections, as Parquet, CSV or lines of JSON, row by row."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from tapetum.errors import InputError
from tapetum.files import atomic_file, told_when_full
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

_DEVICE = {"device": pa.string(), "device_probability": pa.float64()}
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
}
_DETECTION = {
    "frame": pa.int64(),
    "time": pa.float64(),
    "name": pa.string(),
    **{
        name: {"area": pa.int64(), "saturated": pa.int64(), "edge": pa.bool_(), "ghost": pa.bool_()}.get(
            name, pa.float64()
        )
        for name in Detections.names()
    },
}


def estimate_columns(names: Iterable[str]) -> dict[str, pa.DataType]:
    """Return the columns of what models estimate: NAME, NAME_low, NAME_high for each quantity, two for the device."""
    columns: dict[str, pa.DataType] = {}
    for name in names:
        own = _DEVICE if name == "device" else {name + end: pa.float64() for end in ("", "_low", "_high")}
        columns |= own
    return columns


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
    """Writes rows as they come, so that an hour of tracks needs no memory. Made by `table_writer`."""

    def __init__(self, part: Path, suffix: str, schema: pa.Schema) -> None:
        self.schema, self.rows = schema, 0
        self._pending: list[dict[str, Any]] = []
        self._text = part.open("w", encoding="utf-8") if suffix == ".jsonl" else None
        self._arrow = None
        if suffix == ".parquet":
            self._arrow = pq.ParquetWriter(part, schema)
        elif suffix == ".csv":
            self._arrow = pacsv.CSVWriter(part, schema)

    def write(self, row: Mapping[str, Any]) -> None:
        """Add a row; columns that it lacks stay empty."""
        self._pending.append({name: finite(row.get(name)) for name in self.schema.names})
        self.rows += 1
        if len(self._pending) >= _FLUSH:
            self.flush()

    def flush(self) -> None:
        """Hand the rows written so far to the system."""
        if self._pending and self._text is not None:
            self._text.writelines(json.dumps(row, allow_nan=False) + "\n" for row in self._pending)
        elif self._pending and self._arrow is not None:
            self._arrow.write_table(pa.Table.from_pylist(self._pending, schema=self.schema))
        self._pending.clear()

    def close(self) -> None:
        """Write what is left and close the file."""
        try:
            self.flush()
        finally:
            for stream in (self._text, self._arrow):
                if stream is not None:
                    stream.close()


@contextmanager
def table_writer(path: str | os.PathLike[str], schema: pa.Schema) -> Iterator[TableWriter]:
    """Open a table for writing; it takes its name only when all went well.

    Raises
    ------
    InputError
        When the suffix is none of .parquet, .csv, .jsonl, or the file cannot be written.
    """
    suffix = checked_suffix(path)
    with told_when_full(path), atomic_file(path) as part:
        writer = TableWriter(part, suffix, schema)
        try:
            yield writer
        finally:
            writer.close()


def _read(path: Path, suffix: str, known: Mapping[str, pa.DataType]) -> pa.Table:
    if suffix == ".parquet":
        return pq.read_table(path)
    if suffix == ".csv":
        with path.open(encoding="utf-8") as stream:
            header = [name.strip().strip('"') for name in stream.readline().split(",")]
        types = {name: known.get(name, pa.float64()) for name in header}
        options = pacsv.ConvertOptions(column_types=types, strings_can_be_null=True)
        return pacsv.read_csv(path, convert_options=options)
    with path.open(encoding="utf-8") as stream:
        rows = [json.loads(line) for line in stream if line.strip()]
    if not all(isinstance(row, dict) for row in rows):
        raise ValueError("a line is no JSON object")
    names = list(rows[0]) if rows else list(known)
    return pa.Table.from_pylist(rows, schema=pa.schema({name: known.get(name, pa.float64()) for name in names}))


def read_table(path: str | os.PathLike[str], schema: pa.Schema) -> pa.Table:
    """Read a table that `table_writer` wrote.

    Parameters
    ----------
    path
        .parquet, .csv or .jsonl.
    schema
        Columns that must be there. Others are kept, behind them.

    Raises
    ------
    InputError
        When the file is missing or damaged, or lacks a column.
    """
    place = Path(path)
    suffix = checked_suffix(place)
    if not place.is_file():
        raise InputError("no such file", where=place, remedy="check the path")
    try:
        table = _read(place, suffix, {**_DEVICE, **{field.name: field.type for field in schema}})
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"cannot be read as {suffix[1:]} ({error})", where=place, remedy="write it anew") from error
    missing = [name for name in schema.names if name not in table.column_names]
    if missing:
        raise InputError(f"no column {', '.join(missing)}", where=place, remedy="give a table that Tapetum wrote")
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
    missing = [name for name in _TRACK if name not in table.column_names]
    if missing:
        raise InputError(f"no column {', '.join(missing)}", where="tracks")
    with table_writer(path, table.schema) as writer:
        for batch in table.to_batches(max_chunksize=_FLUSH):
            for row in batch.to_pylist():
                writer.write(row)
