"""Correction of a recording's clocks: the UTC of one stream is shifted by a lag that was measured."""

from __future__ import annotations

from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from tapetum.errors import InputError
from tapetum.record.layout import FRAMES, META, write_json, write_table
from tapetum.record.recording import Recording, open_recording

__all__ = ["shift_stream"]


def shift_stream(recording: Recording, stream: str, seconds: float, told: dict[str, Any]) -> Recording:
    """Add seconds to the UTC of a stream's frames; the camera's own clock, `monotonic_ns`, stays.

    Parameters
    ----------
    recording, stream, seconds
        A finished recording, the stream, and what to add.
    told
        How that was found, kept in `recording.json` under `aligned`.

    Raises
    ------
    InputError
        When there is no such stream, the recording is not finished, or it has labels already, which rest on its clocks.
    """
    recording.stream(stream)
    if not recording.finished:
        raise InputError("is not finished", where=recording.path, remedy="align a whole recording")
    if recording.labels() is not None:
        remedy = "remove labels.parquet, align, and label it again"
        raise InputError("has labels, which rest on its clocks", where=recording.path, remedy=remedy)
    tables = [recording.frames(name) for name in recording.streams]
    shifted = []
    for name, table in zip(recording.streams, tables, strict=True):
        if name == stream:
            utc = pc.add(table["utc"].cast(pa.int64()), round(seconds * 1e9))  # type: ignore[attr-defined]
            table = table.set_column(
                table.schema.get_field_index("utc"), table.schema.field("utc"), utc.cast(table.schema.field("utc").type)
            )
        shifted.append(table)
    write_table(recording.path / FRAMES, pa.concat_tables(shifted))
    before = recording.meta.get("aligned") or []
    meta = {**recording.meta, "aligned": [*before, {"stream": stream, "seconds": seconds, **told}]}
    write_json(recording.path / META, meta)
    return open_recording(recording.path)
