"""Recordings on disk: a video for every stream, the clocks of every frame, labels and truth.

`NAME.rec/` holds `recording.json`, `<stream>.mkv`, `frames.parquet` and, once made, `labels.parquet` and
`truth.parquet`. During writing the clocks are in `frames.journal`, one line per frame; closing turns it into
`frames.parquet`. If the writer was killed, the recording stays readable: the journal counts, as far as the video goes.
"""

from __future__ import annotations

import html
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tapetum.errors import InputError, of_type
from tapetum.record import layout
from tapetum.record.layout import FRAMES, JOURNAL, LABELS, TRUTH, StreamInfo, is_recording, read_table, write_table
from tapetum.record.marks import recording_marks
from tapetum.record.source import Frame, Stored, existing
from tapetum.record.video import count_frames, decoded, truncated
from tapetum.record.writer import RecordingWriter

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Recording",
    "RecordingSource",
    "RecordingWriter",
    "StreamInfo",
    "as_recording",
    "is_recording",
    "open_recording",
]

T = TypeVar("T")


@dataclass(frozen=True, repr=False)
class Recording:
    """A recording on disk, opened for reading by `open_recording`.

    Attributes
    ----------
    path, meta, streams
        The folder, all that recording.json says, and the streams by name.
    """

    path: Path
    meta: dict[str, Any]
    streams: dict[str, StreamInfo]

    def __repr__(self) -> str:
        return f"<Recording {self.name}: {self._words()}>"

    def _words(self) -> str:
        parts: list[str] = []
        for name, info in self.streams.items():
            count = self.meta["streams"].get(name, {}).get("frames")
            frames = "" if count is None else f"{count} frames of "
            parts.append(f"{name} {frames}{info.width} x {info.height}, {info.bits} bit")
        return "; ".join([*parts, "labelled" if (self.path / LABELS).exists() else "not labelled"])

    def _repr_html_(self) -> str:
        """Return a summary for notebooks."""
        name, words, path = (html.escape(str(one)) for one in (self.name, self._words(), self.path))
        return f"<p><b>{name}</b>: {words}<br><small>{path}</small></p>"

    def plot(self) -> Figure:
        """Draw the first frame of every stream and, where there are labels, the gaze over the frames.

        The figure has no window: a notebook shows it, `savefig` writes it.
        """
        from matplotlib.figure import Figure

        labels = self.labels()
        known = [] if labels is None else [one for one in ("gaze_x", "gaze_y") if one in labels.column_names]
        figure = Figure(figsize=(8, 5 if known else 3), layout="constrained")
        rows, columns = 2 if known else 1, len(self.streams)
        for n, name in enumerate(self.streams):
            axis = figure.add_subplot(rows, columns, n + 1)
            frame = next(iter(self.source(name)), None)
            if frame is not None:
                axis.imshow(frame.image, cmap="gray")
            axis.set_title(name)
            axis.set_axis_off()
        if labels is not None and known:
            axis = figure.add_subplot(rows, 1, rows)
            for name in known:
                axis.plot(labels["frame"].to_numpy(), labels[name].to_numpy(), ".", markersize=2, label=name)
            axis.set_xlabel("probe frame")
            axis.set_ylabel("gaze, fraction of the field")
            axis.legend()
        return figure

    @property
    def name(self) -> str:
        """The folder's name without `.rec`."""
        return self.path.name.removesuffix(".rec")

    @property
    def uuid(self) -> str:
        """Unique identifier of the recording."""
        return str(self.meta["uuid"])

    @property
    def finished(self) -> bool:
        """Whether the recording was closed; False if its writer died."""
        return bool(self.meta["finished"])

    def stream(self, name: str) -> StreamInfo:
        """Return a stream's format; raise an InputError when there is no such stream."""
        if name not in self.streams:
            has = ", ".join(self.streams)
            raise InputError(f"no stream {name!r}", where=self.path, remedy=f"the recording has {has}")
        return self.streams[name]

    def video(self, stream: str) -> Path:
        """Return the path of a stream's video."""
        self.stream(stream)
        return self.path / f"{stream}.mkv"

    def frames(self, stream: str) -> pa.Table:
        """Return the clocks of a stream's frames; of an unfinished recording, those that are complete in its video.

        Columns: `stream`, `index` (from 0), `monotonic_ns`, `utc` (timestamp of ns, UTC), `dropped_before` (frames lost
        since the one before), and where known `exposure` (s) and `lit` (whether the laser was on). Raises an InputError
        when there is no such stream, or a file is missing or damaged.
        """
        self.stream(stream)
        # Closing removes the journal last, so that one of the two is always complete.
        whole = (self.path / FRAMES).exists()
        table = read_table(self.path / FRAMES) if whole else layout.read_journal(self.path / JOURNAL)
        table = layout.clocks(table, self.path / FRAMES)
        table = table.filter(pc.equal(table["stream"], stream))  # type: ignore[attr-defined]
        if not np.array_equal(table["index"].to_numpy(), np.arange(len(table))):
            raise InputError(f"frames of {stream} are not numbered 0, 1, 2 …", where=self.path, remedy="record again")
        if self.finished:
            return table
        return table.slice(0, count_frames(existing(self.video(stream))) if len(table) else 0)

    def utc_ns(self, stream: str) -> np.ndarray:
        """Return UTC of a stream's frames in nanoseconds since 1970, [N] int64."""
        return self.frames(stream)["utc"].cast(pa.int64()).to_numpy()

    def source(self, stream: str = "probe") -> RecordingSource:
        """Return a stream as a source of frames; errors as of `frames`."""
        info, frames = self.stream(stream), self.frames(stream)
        utc = frames["utc"].cast(pa.int64())
        times = (utc.to_numpy() - utc.to_numpy()[:1]) / 1e9
        columns = {"utc_ns": utc, "monotonic_ns": frames["monotonic_ns"], "lost": frames["dropped_before"]}
        known = pa.table({**columns, "exposure": frames["exposure"], "lit": frames["lit"]}).to_pylist()
        video, full_scale = existing(self.video(stream)), int(info.full_scale or 0)
        marks = recording_marks(self.meta)
        return RecordingSource(video, stream, full_scale, times, self.finished, info.rate, tuple(known), marks=marks)

    def readout(self, stream: str) -> float:
        """Return the time from the exposure of a stream's first row to that of its last, in s; 0 where unknown."""
        clocks = self.meta.get("clocks")
        one = clocks.get(stream) if isinstance(clocks, dict) else None
        found = one.get("readout") if isinstance(one, dict) else None
        return float(found) if isinstance(found, int | float) and 0 <= found < 1 else 0.0

    def labels(self) -> pa.Table | None:
        """Return the labels, or None before there are any."""
        return read_table(self.path / LABELS) if (self.path / LABELS).exists() else None

    def truth(self) -> pa.Table | None:
        """Return the virtual bench's truth of the probe frames; None for real recordings."""
        return read_table(self.path / TRUTH) if (self.path / TRUTH).exists() else None

    def write_labels(self, table: pa.Table) -> None:
        """Store labels in place of any before; `frame`, `how` and `quality` must be among their columns."""
        if missing := {"frame", "how", "quality"} - set(table.column_names):
            raise InputError(f"labels lack the columns {', '.join(sorted(missing))}", where=self.path / LABELS)
        write_table(self.path / LABELS, table)

    def write_truth(self, table: pa.Table) -> None:
        """Store the virtual bench's truth; `frame` must be among its columns."""
        if "frame" not in table.column_names:
            raise InputError("truth lacks the column frame", where=self.path / TRUTH)
        write_table(self.path / TRUTH, table)


@dataclass(frozen=True, eq=False)
class RecordingSource(Stored):
    """A stream of a recording as a source of frames; times count from its first frame by UTC.

    Attributes
    ----------
    video, stream
        The stream's video file and name.
    full_scale, rate
        Digital number of saturation, and nominal frames per second.
    times
        [N] seconds of every frame from the first one.
    finished
        Whether the recording was closed: then a video with too few frames raises an error.
    known
        Further arguments of each `Frame`.
    late
        Whether the readable frames come before that error.
    marks
        Of the recording (`tapetum.record.marks`).
    """

    video: Path
    stream: str
    full_scale: int
    times: np.ndarray
    finished: bool
    rate: float | None = None
    known: tuple[dict[str, Any], ...] = ()
    late: bool = field(default=False, kw_only=True)
    marks: frozenset[str] = field(default=frozenset(), kw_only=True)

    @property
    def name(self) -> str:
        """Recording and stream, for messages."""
        return f"{self.video.parent}:{self.stream}"

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.times)

    def looked(self, look: Callable[[Frame], T]) -> Iterator[T]:
        """Yield what `look` returns of every frame; a source that makes its frames may keep that."""
        return map(look, self)

    def frame(self, number: int, image: np.ndarray) -> Frame:
        """Return a frame with its times, exposure and laser state."""
        known = self.known[number] if self.known else {}
        return Frame(number, float(self.times[number]), image, f"{self.stream}[{number}]", self.full_scale, **known)

    def __iter__(self) -> Iterator[Frame]:
        number = 0
        if self.count:
            for image, _, _ in decoded(self.video, tolerant=not self.finished, late=self.late):
                if number == self.count:
                    return
                yield self.frame(number, image)
                number += 1
        if number < self.count:
            raise truncated(self.video, number)


def open_recording(path: str | os.PathLike[str]) -> Recording:
    """Open a recording, a folder `NAME.rec`.

    Raises
    ------
    InputError
        When it is missing, not a recording, damaged, or of a newer version.
    """
    place = existing(path)
    meta = layout.read_meta(place)
    names = ("height", "width", "bits", "full_scale", "rate")
    streams = {
        name: StreamInfo(**{**{key: value[key] for key in names}, "rate": value["rate"] or meta["rate"]})
        for name, value in meta["streams"].items()
    }
    return Recording(place, meta, streams)


def as_recording(recording: Recording | str | os.PathLike[str], where: str = "recording") -> Recording:
    """Return a recording that is open already or, given its path, opened; raises an InputError as `open_recording`."""
    of_type(recording, (Recording, str, os.PathLike), where, "give its folder NAME.rec, or a recording that is open")
    return recording if isinstance(recording, Recording) else open_recording(recording)
