"""From pairs of videos to recordings: two streams on one clock, labelled by the laser in the target's video."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tapetum.data.build import build_dataset
from tapetum.data.importing.align import align_blink, brightness
from tapetum.data.importing.columns import Reader, label_values, seconds
from tapetum.data.importing.mapping import Column, ImportMapping, Pair
from tapetum.data.importing.write import check_size
from tapetum.errors import InputError
from tapetum.files import atomic_folder
from tapetum.progress import Progress
from tapetum.record import label_recording, open_frames, open_recording
from tapetum.record.recording import RecordingWriter, StreamInfo, is_recording
from tapetum.record.source import Frame, Source
from tapetum.record.video import VideoSource, count_frames

__all__ = ["pair_name", "write_videos"]


@dataclass(frozen=True)
class _Stream:
    """One video of a pair: its frames, the first of them, and the times of all by its own clock in seconds."""

    source: Source
    first: Frame
    times: NDArray[np.float64] | None

    @property
    def where(self) -> str:
        return self.source.name

    @property
    def rate(self) -> float:
        return float(self.source.rate or 15.0)

    def time(self, frame: Frame) -> float:
        if self.times is None:
            return frame.time
        if frame.index >= len(self.times):
            what = f"holds more frames than there are times ({len(self.times)})"
            raise InputError(what, where=self.where, remedy="give the table of this video")
        return float(self.times[frame.index])


def pair_name(pair: Pair) -> str:
    """Return the name of a pair's recording: its own, or that of the probe's file without the word probe."""
    stem = Path(pair.probe).stem
    bare = re.sub(r"(?i)[-_. ]*probe[-_. ]*", "", stem) or Path(pair.probe).parent.name or stem
    return re.sub(r"[^\w.+-]+", "-", pair.name or bare)


def _opened(name: str, column: Column | None, reader: Reader) -> _Stream:
    place = reader.root / name
    source = open_frames(place)
    first = source.first()
    times = None
    if column is not None:
        count = count_frames(place) if isinstance(source, VideoSource) else len(source)
        where = f"{reader.place(column, None)}: {column.column}"
        times = seconds(reader.values(column, None), column, where)
        if len(times) != count:
            what = f"has {len(times)} times for the {count} frames of {place}"
            raise InputError(what, where=where, remedy="copy both again, or give the table of this video")
        back = np.flatnonzero(np.diff(times) <= 0)
        if len(back):
            raise InputError(f"time does not rise at row {back[0] + 1}", where=where, remedy="correct it")
    return _Stream(source, first, times)


def _write_pair(pair: Pair, mapping: ImportMapping, reader: Reader, path: Path, progress: Progress) -> str:
    """Write one recording with its labels; return a line that describes it."""
    probe = _opened(pair.probe, pair.probe_times, reader)
    target = _opened(pair.target, pair.target_times, reader)
    check_size(probe.first.image.shape, mapping, probe.where, "frames")
    alignment, offset = None, pair.offset
    if pair.align == "blink":
        levels = [brightness(one.source, progress, f"blinking of {Path(one.where).name}") for one in (probe, target)]
        alignment = align_blink(levels[0], levels[1], where=f"{probe.where} and {target.where}")
        offset += alignment.offset
    streams = {"probe": (probe, 0.0), "target": (target, offset)}
    begin = min(one.time(one.first) + later for one, later in streams.values())
    # Without dates, times are stored as seconds since 1970.
    dated = all(one.times is not None and one.times[0] > 1e8 for one, _ in streams.values())
    start = round(begin * 1e9) if dated else 0
    told: dict[str, Any] = {"align": pair.align, "offset": offset, "probe": pair.probe, "target": pair.target}
    if alignment is not None:
        told["blink"] = vars(alignment)
    with RecordingWriter(
        path,
        streams={name: replace(StreamInfo.of(one.source), rate=one.rate) for name, (one, _) in streams.items()},
        rate=probe.rate,
        hardware={"imported": {"probe": pair.probe, "target": pair.target}},
        extra={"imported": told},
        start_utc_ns=start,
    ) as writer:
        for name, (one, later) in streams.items():
            frames = progress(iter(one.source), f"copying {Path(one.where).name}", total=one.source.count)
            for frame in frames:
                moment = round((one.time(frame) + later - begin) * 1e9)
                writer.write(name, frame.image, monotonic_ns=moment, utc_ns=start + moment)
    recording = open_recording(path)
    try:
        summary = label_recording(recording, progress)
    except InputError as error:
        # The message must not name the temporary folder of the recording.
        raise InputError(error.what, where=f"{probe.where} with {target.where}", remedy=error.remedy) from error
    constants = label_values(pair.labels, reader, 1)
    if constants and (table := recording.labels()) is not None:
        for name, value in constants.items():
            table = table.append_column(name, pa.array(value.tolist() * len(table)))
        recording.write_labels(table)
    text = f"{path.name}: {pair.align}, " + (alignment.text if alignment else f"target {offset:+.4f} s")
    return f"{text}; labelled {summary.labelled} of {summary.n} frames"


def write_videos(mapping: ImportMapping, root: Path, out: Path, progress: Progress, overwrite: bool) -> list[str]:
    """Write recordings and a dataset from the pairs of a mapping; see `import_dataset`."""
    reader, folder = Reader(root), out.with_name(f"{out.stem}-recordings")
    names = [pair_name(pair) for pair in mapping.videos]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"two recordings would be called {twice!r}", where="videos", remedy="give them a 'name'")
    if folder.exists() and not (overwrite and all(map(is_recording, folder.iterdir()))):
        raise InputError("exists already", where=folder, remedy="choose another name or remove it first")
    with atomic_folder(folder, overwrite=overwrite) as part:
        told, paths = [], []
        for name, pair in zip(names, mapping.videos, strict=True):
            paths.append(part / f"{name}.rec")
            told.append(_write_pair(pair, mapping, reader, paths[-1], progress))
        build_dataset(
            paths, out, side=mapping.side, test_fraction=mapping.test_fraction, progress=progress, overwrite=overwrite
        )
    return told
