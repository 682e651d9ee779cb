"""A table of tracks of what is watched: a row for each camera of each frame, which a killed process does not tear."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pyarrow as pa

from tapetum.errors import InputError, TapetumError
from tapetum.live.events import Event
from tapetum.live.outputs.base import Queued
from tapetum.live.state import CameraState, State
from tapetum.track.tables import TableWriter, table_writer, track_schema

__all__ = ["Tracks"]

_WAITING = 10_000  # states: minutes, while a disk is slow
_PATIENCE = 120.0  # s: hours of rows become Parquet at the end
_open: set[Path] = set()


class Tracks(Queued):
    """Writes `FILE.parquet`, `.csv` or `.jsonl`: the columns of `track_schema`, and the camera's `id`.

    Rows grow in `FILE.unfinished.arrow` (or with the table's own suffix), written at least each second, and take
    their name at the end; `read_tracks` reads both. A file that is there is not replaced: a watch cannot be done again.
    """

    def __init__(self, text: str) -> None:
        path = Path(text)
        # An error of writing shows now, not at the end of a day's watch.
        if path.is_dir() or path.exists():
            raise InputError("exists already", where=path, remedy="name another file, or move this one away")
        if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
            remedy = "name a folder that you may write to"
            raise InputError(f"no folder {path.parent} to write to", where=path, remedy=remedy)
        super().__init__(str(path), states=_WAITING, patience=_PATIENCE)
        schema = track_schema()
        self._stack = ExitStack()
        # The lock that `table_writer` takes lets its own thread take it again.
        if path.absolute() in _open:
            raise InputError("is named twice", where=path, remedy="name it once")
        _open.add(path.absolute())
        self._stack.callback(_open.discard, path.absolute())
        try:
            whole = pa.schema([*schema, pa.field("id", pa.string())])
            self._writer: TableWriter | None = self._stack.enter_context(table_writer(path, whole))
        except BaseException:
            self._stack.close()
            raise
        self._begin: int | None = None
        self._frame = -1
        self._broken = ""

    def event(self, event: Event) -> None:
        """Events are no rows."""

    def send_event(self, event: Event) -> None:
        """Events are no rows."""

    def send_state(self, state: State) -> None:
        """Write a row for each camera; a frame is written once."""
        if self._writer is None:
            raise TapetumError(self._broken)
        if state.frame == self._frame:
            return
        self._frame = state.frame
        self._begin = state.utc_ns if self._begin is None else self._begin
        moment = {"frame": state.frame, "time": (state.utc_ns - self._begin) / 1e9, "utc_ns": state.utc_ns}
        try:
            for camera in state.cameras:
                self._writer.write({**moment, **_row(camera, state.utc_ns)})
        except OSError as error:
            self._stop(error)

    def idle(self) -> None:
        """Let no row wait for the next camera."""
        if self._writer is not None:
            try:
                self._writer.flush()
            except OSError as error:
                self._stop(error)

    def end(self) -> None:
        """Give the table its name."""
        self._writer = None
        try:
            self._stack.close()
        except Exception as error:
            raise TapetumError(_with_note(error)) from error

    def _stop(self, error: OSError) -> None:
        """Keep what was written, and write no more: what the disk did not take is lost."""
        self._writer = None
        try:
            # As at any failure, the rows so far stay beside the table's name.
            self._stack.__exit__(type(error), error, error.__traceback__)
        except Exception as told:
            self._broken = _with_note(told)
            raise TapetumError(self._broken) from error


def _with_note(error: Exception) -> str:
    """What went wrong, and where the rows are."""
    return "; ".join([str(error), *getattr(error, "__notes__", [])])


def _row(camera: CameraState, utc_ns: int) -> dict[str, Any]:
    """A camera as a row; a gaze estimated in an earlier frame is left out."""
    row: dict[str, Any] = {name: getattr(camera, name) for name in ("id", "track", "x", "y", "active", "seen")}
    if camera.seen_utc_ns == utc_ns:
        row |= {name: getattr(camera, name) for name in ("snr", "diameter")}
    if camera.is_fresh(utc_ns):
        row |= {name: getattr(camera, name) for name in ("device", "device_probability")}
        for name, values in (("gaze_x", camera.gaze_x), ("gaze_y", camera.gaze_y)):
            if values is not None:
                row |= {name: values[0], f"{name}_low": values[1], f"{name}_high": values[2]}
    return row
