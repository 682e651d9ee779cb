"""The layout of a recording's folder: names, columns, and how each file of it is read and written."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field

from tapetum.checked import Checked, check, read_json
from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.record.source import Source

__all__ = [
    "FORMAT",
    "FRAMES",
    "JOURNAL",
    "LABELS",
    "META",
    "SCHEMA",
    "TRUTH",
    "VERSION",
    "StreamInfo",
    "clocks",
    "is_recording",
    "journal_line",
    "read_journal",
    "read_meta",
    "read_table",
    "write_json",
    "write_table",
]

# Version 2 added exposure and laser of each frame.
FORMAT, VERSION = "tapetum-recording", 2
META, JOURNAL = "recording.json", "frames.journal"
FRAMES, LABELS, TRUTH = "frames.parquet", "labels.parquet", "truth.parquet"
SCHEMA = pa.schema(
    [
        ("stream", pa.string()),
        ("index", pa.int64()),
        ("monotonic_ns", pa.int64()),
        ("utc", pa.timestamp("ns", "UTC")),
        ("dropped_before", pa.int64()),
        ("exposure", pa.float64()),
        ("lit", pa.bool_()),
    ]
)
# Columns that version 1 had.
_FIRST = 5


@dataclass(frozen=True)
class StreamInfo:
    """Format of one stream: frame size in pixels, bit depth 1 to 16 (uint8 up to 8, else uint16), and rate in frames/s.

    `full_scale` is the digital number of saturation, by default 2^bits - 1; `rate` defaults to the recording's.
    """

    height: int
    width: int
    bits: int = 8
    full_scale: int | None = None
    rate: float | None = None

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1:
            raise InputError(f"size must be positive, is {self.height} x {self.width}", where="stream")
        if not 1 <= self.bits <= 16:
            raise InputError(f"must be 1 to 16, is {self.bits}", where="stream bits")
        if self.full_scale is None:
            object.__setattr__(self, "full_scale", 2**self.bits - 1)

    @classmethod
    def of(cls, source: Source) -> StreamInfo:
        """Return the format of a recording of a source's frames."""
        first = source.first()
        height, width = first.image.shape
        scale = int(first.full_scale or 0)
        return cls(height, width, scale.bit_length(), scale, source.rate)

    @property
    def dtype(self) -> np.dtype:
        """Type of the stream's images."""
        return np.dtype(np.uint8 if self.bits <= 8 else np.uint16)


# Generous limits of sensor size and frame rate.
_Pixels = Annotated[int, Field(ge=1, le=2**20)]
_Rate = Annotated[float, Field(gt=0, le=1e6)]
_Count = Annotated[int, Field(ge=0, lt=2**63)]


class _StreamMeta(Checked):
    file: str
    codec: Literal["ffv1"]
    height: _Pixels
    width: _Pixels
    bits: Annotated[int, Field(ge=1, le=16)]
    full_scale: Annotated[int, Field(ge=1, le=2**16 - 1)]
    rate: _Rate | None
    frames: _Count | None = None


class _Meta(Checked):
    """Required content of recording.json; further keys (scene, origin of labels, ...) are kept."""

    uuid: Annotated[str, Field(min_length=1)]
    start_utc: str
    start_utc_ns: Annotated[int, Field(ge=-(2**63), lt=2**63)]
    rate: _Rate
    finished: bool
    hardware: dict[str, Any]
    streams: Annotated[dict[str, _StreamMeta], Field(min_length=1)]
    clock: dict[str, Any]
    software: dict[str, Any]
    seed: _Count | None = None
    scene: dict[str, Any] | None = None


def iso(utc_ns: int, digits: str = "microseconds") -> str:
    """Return nanoseconds since 1970 as ISO 8601."""
    seconds, rest = divmod(utc_ns, 10**9)
    moment = datetime.fromtimestamp(seconds, UTC).replace(microsecond=rest // 1000)
    return moment.isoformat(timespec=digits).replace("+00:00", "Z")


def is_recording(path: str | os.PathLike[str]) -> bool:
    """Return whether `path` is a folder that holds a recording, or is named like one."""
    place = Path(path)
    return place.is_dir() and ((place / META).exists() or place.suffix == ".rec")


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write a JSON file completely or not at all."""
    with atomic_file(path) as part:
        part.write_text(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def write_table(path: Path, table: pa.Table) -> None:
    """Write a Parquet file completely or not at all."""
    with atomic_file(path) as part:
        pq.write_table(table, part, compression="zstd")


def read_table(path: Path) -> pa.Table:
    """Read a Parquet file; raise an InputError when it is damaged."""
    try:
        return pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise InputError("is damaged or not a Parquet file", where=path, remedy="make it again") from error


_UNKNOWN = "-"
_LIT = {"0": False, "1": True, _UNKNOWN: None}


def journal_line(
    stream: str, index: int, monotonic_ns: int, utc_ns: int, lost: int, exposure: float | None, lit: bool | None
) -> bytes:
    """Return a journal line with a frame's clocks, exposure and laser state."""
    words = (stream, index, monotonic_ns, utc_ns, lost, _UNKNOWN if exposure is None else repr(float(exposure)))
    mark = next(text for text, value in _LIT.items() if value is lit)
    return (" ".join(str(one) for one in words) + f" {mark}\n").encode("ascii")


def clocks(table: pa.Table, where: Path) -> pa.Table:
    """Return a table of frames with the current columns, null where an older version had none; refuse others."""
    if table.schema.equals(pa.schema(list(SCHEMA)[:_FIRST])):
        for field in list(SCHEMA)[_FIRST:]:
            table = table.append_column(field, pa.nulls(len(table), field.type))
    if not table.schema.equals(SCHEMA):
        raise InputError(f"columns are not {', '.join(SCHEMA.names)}", where=where, remedy="record again")
    return table


def read_journal(path: Path) -> pa.Table:
    """Read the clocks of an unfinished recording, ignoring a torn last line; refuse other damage."""
    try:
        text = path.read_bytes()
    except OSError as error:
        what = f"neither {FRAMES} nor {JOURNAL} can be read"
        raise InputError(what, where=path.parent, remedy="record again") from error
    rows = []
    for number, line in enumerate(text.split(b"\n")[:-1]):
        try:
            stream, index, monotonic, utc, dropped, *more = line.decode("ascii").split()
            exposure, lit = more or (_UNKNOWN, _UNKNOWN)
            known = (None if exposure == _UNKNOWN else float(exposure), _LIT[lit])
            rows.append((stream, int(index), int(monotonic), int(utc), int(dropped), *known))
        except (ValueError, KeyError) as error:
            raise InputError(f"line {number + 1} is damaged", where=path, remedy="cut the journal before it") from error
    columns = list(zip(*rows, strict=True)) or [()] * len(SCHEMA)
    return pa.table([pa.array(values, one.type) for values, one in zip(columns, SCHEMA, strict=True)], schema=SCHEMA)


def read_meta(place: Path) -> dict[str, Any]:
    """Read and check a recording's recording.json."""
    file = place / META
    if not file.is_file():
        raise InputError(f"holds no {META}", where=place, remedy="give a recording, a folder NAME.rec")
    try:
        meta = read_json(file)
    except (OSError, ValueError) as error:
        raise InputError("is damaged", where=file, remedy="restore it from a copy") from error
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        raise InputError(f"is not a {FORMAT}", where=file, remedy="give a recording made by tapetum record")
    version = meta.get("version")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise InputError(f"has no usable version ({version!r})", where=file, remedy="restore it from a copy")
    if version > VERSION:
        what = f"is of version {version}, this Tapetum reads up to {VERSION}"
        raise InputError(what, where=file, remedy="update Tapetum")
    streams = check(_Meta, meta, file, "restore it from a copy").streams
    for name, one in streams.items():
        if one.file != f"{name}.mkv" or one.full_scale >= 2**one.bits:
            what = f"streams.{name}: file and full_scale must be {name}.mkv and below 2^bits"
            raise InputError(what, where=file, remedy="restore it from a copy")
    return meta
