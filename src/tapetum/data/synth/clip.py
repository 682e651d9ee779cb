"""Some frames of a shot as a recording, filmed only when they are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pyarrow as pa

from tapetum.data.synth.plan import Video
from tapetum.record.labels import REACH
from tapetum.record.recording import Recording, RecordingSource, StreamInfo
from tapetum.record.smoother import block_seconds
from tapetum.record.source import Frame
from tapetum.record.spot import LONGEST, NEIGHBOURS

if TYPE_CHECKING:
    from tapetum.record.shot import Shot

__all__ = ["Clip"]

T = TypeVar("T")

MARGIN = LONGEST + 2 * NEIGHBOURS + 2 + REACH
"""Target frames on either side that affect a place: `tapetum.record.spot.follow` lets a row of doubtful ones confirm
each other between good ones, which it compares with their neighbours; interpolation uses one more beyond the next; and
what stands under a spot is seen in frames up to `REACH` away.
Smoothing needs whole blocks besides: `tapetum.record.smoother.block_seconds`."""

_BATCH = 16


@dataclass(frozen=True, eq=False)
class ClipSource(RecordingSource):
    """Frames of one stream of a shot from number `begin` on, made when they are read.

    `seen` keeps what was seen of frames, by their numbers: neighbouring clips share frames of the target.
    """

    shot: Any = None
    begin: int = 0
    seen: dict[int, Any] = field(default_factory=dict)

    def __iter__(self) -> Iterator[Frame]:
        for start in range(0, self.count, _BATCH):
            yield from self._made(start, min(start + _BATCH, self.count))

    def looked(self, look: Callable[[Frame], T]) -> Iterator[T]:
        """Yield what `look` returns of every frame, making those alone that it has not seen."""
        for n in range(self.count):
            if self.begin + n not in self.seen:
                (frame,) = self._made(n, n + 1)
                self.seen[frame.index] = look(frame)
            yield self.seen[self.begin + n]

    def _made(self, start: int, stop: int) -> Iterator[Frame]:
        """Make frames `start` to `stop` (excluded) of this source."""
        images = getattr(self.shot, self.stream)(self.begin + start, self.begin + stop)
        for n, image in enumerate(images, start):
            index = self.begin + n
            where, exposure = f"{self.name}[{index}]", self.shot.exposure(self.stream, index)
            yield Frame(index, float(self.times[n]), image, where, self.full_scale, exposure=exposure)


@dataclass(frozen=True)
class Clip(Recording):
    """A range of a video's probe frames, with the target's frames that label them.

    `shot` is the whole video, `ranges` the first and last (excluded) frame of each stream, `labelled` the constant
    labels. `seen` keeps what was seen of the target's frames, for further clips of the same shot.
    """

    shot: Any = None
    ranges: dict[str, tuple[int, int]] = field(default_factory=dict)
    labelled: tuple[tuple[str, float | str], ...] = ()
    seen: dict[int, Any] = field(default_factory=dict)
    _tables: list[pa.Table] = field(default_factory=list)

    @classmethod
    def of(cls, video: Video, shot: Shot, first: int, last: int, seen: dict[int, Any] | None = None) -> Clip:
        """Return the probe's frames `first` to `last` (excluded), as far as the video has them; `seen` is the memory
        of earlier clips of the same shot."""
        count = len(shot.beats["probe"].times)
        first, last = min(first, count), min(last, count)
        target = shot.beats["target"].times
        low = high = 0
        if first < last:
            ends = shot.beats["probe"].times[[first, last - 1]]
            length, back, ahead = block_seconds(shot.cameras["target"].rate)
            blocks = np.floor((ends - target[0]) / length) * length + target[0]
            wanted = np.stack([np.minimum(blocks - back, ends), np.maximum(blocks + length + ahead, ends)])
            low, high = (int(index) for index in np.searchsorted(target, [wanted[0, 0], wanted[1, 1]]))
        ranges = {"probe": (first, last), "target": (max(0, low - MARGIN), min(len(target), high + MARGIN))}
        # An empty range of frames still has the size of an image.
        (_, rows, columns), (_, high, wide) = shot.probe(0, 0).shape, shot.target(0, 0).shape
        probe = StreamInfo(rows, columns, video.scene.probe.sensor.bits)
        streams = {"probe": probe, "target": StreamInfo(high, wide, rate=shot.cameras["target"].rate)}
        meta = {"clocks": {name: {"readout": camera.clock.readout} for name, camera in shot.cameras.items()}}
        return cls(Path(video.name), meta, streams, shot, ranges, video.labels, {} if seen is None else seen)

    def utc_ns(self, stream: str) -> np.ndarray:
        """Return times of the clip's frames of a stream in nanoseconds from the shot's start, [N] int64."""
        first, last = self.ranges[stream]
        return np.rint(self.shot.beats[stream].times[first:last] * 1e9).astype(np.int64)

    def source(self, stream: str = "probe") -> ClipSource:
        """Return the clip's frames of a stream; times count from the first frame of the whole video."""
        first, last = self.ranges[stream]
        times = self.shot.beats[stream].times
        # Rounded to nanoseconds like a recording on disk.
        since = (np.rint(times[first:last] * 1e9) - np.rint(times[:1] * 1e9)) / 1e9
        full_scale = int(self.streams[stream].full_scale or 0)
        # Probe frames are read once.
        seen = self.seen if stream == "target" else {}
        return ClipSource(self.video(stream), stream, full_scale, since, True, shot=self.shot, begin=first, seen=seen)

    def labels(self) -> pa.Table | None:
        """Return the labels, or None before there are any."""
        return self._tables[-1] if self._tables else None

    def write_labels(self, table: pa.Table) -> None:
        """Keep labels, with the constant ones; frames are numbered as in the whole video."""
        frames = pa.array(np.arange(*self.ranges["probe"]), pa.int64())
        table = table.set_column(table.column_names.index("frame"), "frame", frames)
        for name, value in self.labelled:
            table = table.append_column(name, pa.array([value] * len(table)))
        self._tables.append(table)
