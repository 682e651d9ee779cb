"""Tables on disk by suffix: writing rows as they come, and reading. A new kind is a `Format` in `FORMATS`."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.json as pajson
import pyarrow.parquet as pq

from tapetum.files import atomic_file

__all__ = ["FORMATS", "Format", "Sink", "to_parquet"]

Types = Mapping[str, pa.DataType]
_ROWS = 2000


class Sink(Protocol):
    """Takes rows as they come."""

    def write_table(self, table: pa.Table) -> None: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class Format:
    """One kind of table.

    `sink` returns a writer of rows with a schema to an open file; `read` returns the table in a file, given the types
    of known columns (others are numbers). `grows_as` is the suffix of the file in which rows grow, where that is of
    another kind: Parquet can only be read when complete, so its rows grow in an Arrow stream.
    """

    sink: Callable[[BinaryIO, pa.Schema], Sink]
    read: Callable[[Path, Types], pa.Table]
    grows_as: str | None = None


class _Lines:
    """Writes a JSON object a row."""

    def __init__(self, file: BinaryIO, schema: pa.Schema) -> None:
        del schema
        self._file = file

    def write_table(self, table: pa.Table) -> None:
        self._file.write("".join(json.dumps(row, allow_nan=False) + "\n" for row in table.to_pylist()).encode())

    def close(self) -> None:
        pass


def _text(path: Path) -> bytes:
    """Text of a table, without a last line truncated by a kill."""
    text = path.read_bytes()
    return text[: text.rfind(b"\n") + 1] if ".unfinished" in path.name else text


def _schema(names: Any, known: Types) -> pa.Schema:
    return pa.schema({name: known.get(name, pa.float64()) for name in names})


def _read_csv(path: Path, known: Types) -> pa.Table:
    text = _text(path)
    header = [name.strip().strip('"') for name in text.split(b"\n", 1)[0].decode().split(",")]
    options = pacsv.ConvertOptions(column_types=_schema(header, known), strings_can_be_null=True)
    return pacsv.read_csv(io.BytesIO(text), convert_options=options)


def _read_lines(path: Path, known: Types) -> pa.Table:
    text = _text(path).strip()
    if not text:
        return _schema(known, known).empty_table()
    first = json.loads(text.split(b"\n", 1)[0])
    if not isinstance(first, dict):
        raise ValueError("a line is no JSON object")
    return pajson.read_json(io.BytesIO(text), parse_options=pajson.ParseOptions(explicit_schema=_schema(first, known)))


def _batches(stream: Path) -> Iterator[pa.RecordBatch]:
    """Yield the complete batches of an Arrow stream, an empty one first."""
    with stream.open("rb") as file, pa.ipc.open_stream(file) as reader:
        yield pa.RecordBatch.from_pylist([], schema=reader.schema)
        while True:
            try:
                batch = reader.read_next_batch()
            except (StopIteration, OSError, pa.ArrowException):
                return
            yield batch


def to_parquet(stream: Path, target: Path) -> None:
    """Write the rows of an Arrow stream as Parquet, some thousands at a time."""
    with atomic_file(target) as part:
        batches = _batches(stream)
        waiting = [next(batches)]
        schema = waiting[0].schema
        with pq.ParquetWriter(part, schema) as writer:
            for batch in batches:
                waiting.append(batch)
                if sum(one.num_rows for one in waiting) >= _ROWS:
                    writer.write_table(pa.Table.from_batches(waiting))
                    waiting.clear()
            writer.write_table(pa.Table.from_batches(waiting, schema))


FORMATS: dict[str, Format] = {
    ".parquet": Format(pa.ipc.new_stream, lambda path, known: pq.read_table(path), grows_as=".arrow"),
    ".csv": Format(pacsv.CSVWriter, _read_csv),
    ".jsonl": Format(_Lines, _read_lines),
    # A killed run leaves this of a table in Parquet.
    ".arrow": Format(pa.ipc.new_stream, lambda path, known: pa.Table.from_batches(list(_batches(path)))),
}
"""By suffix."""
