"""The virtual bench: films a scene as two cameras with clocks of their own would."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from tapetum.bench import Scene, as_scene
from tapetum.progress import Progress, quiet
from tapetum.record.beats import CameraClock
from tapetum.record.layout import StreamInfo
from tapetum.record.recording import Recording, open_recording
from tapetum.record.session import Placed, Session
from tapetum.record.shot import Shot, probe_frames
from tapetum.record.source import Frame, Stored
from tapetum.record.writer import RecordingWriter

__all__ = ["BenchSource", "CameraClock", "Placed", "Session", "film", "probe_frames", "without_second_beam"]


class BenchSource(Stored):
    """One camera of the virtual bench, `probe` or `target`, as a source of frames that are made as they are read."""

    def __init__(self, shot: Shot, stream: str) -> None:
        self.shot, self.name, self.rate = shot, stream, shot.session.rate
        self.count = len(shot.beats[stream])
        self.full_scale = 2**shot.scene.probe.sensor.bits - 1 if stream == "probe" else 255

    @property
    def hardware(self) -> dict[str, Any]:
        """That there is none."""
        return {"camera": "simulated"}

    def __iter__(self) -> Iterator[Frame]:
        shot, session = self.shot, self.shot.session
        beat, make, clock = shot.beats[self.name], shot.target, session.target_clock
        if self.name == "probe":
            make, clock = shot.probe, session.probe_clock
        start_ns = int(session.start.timestamp()) * 10**9
        for i, t in enumerate(beat.times):
            yield Frame(
                i,
                float(t - beat.times[0]),
                make(i, i + 1)[0],
                f"{self.name}[{i}]",
                self.full_scale,
                utc_ns=start_ns + round(t * 1e9),
                monotonic_ns=round((t + 1e3) * (1 + clock.drift) * 1e9),
                exposure=shot.exposure(self.name, i),
                lit=shot.lit(self.name, i),
                lost=int(beat.dropped_before[i]),
            )


def film(
    scene: Scene | str | os.PathLike[str],
    out: str | os.PathLike[str],
    session: Session | None = None,
    *,
    progress: Progress = quiet,
    overwrite: bool = False,
) -> Recording:
    """Film a hand-held target on the virtual bench, as a recording with two streams and the bench's truth beside.

    Parameters
    ----------
    scene
        What stands on the bench, or its name or path; the target's rotation is the hand's.
    out
        The recording's folder, usually `NAME.rec`.
    session
        Length, motion, clocks, light, surroundings and seed.
    progress
        Shows the frames.
    overwrite
        Whether a recording at `out` may be replaced.

    Raises
    ------
    InputError
        For a session without frames, a full disk, an existing recording, or what cannot be simulated.
    """
    session = session or Session()
    shot = Shot(as_scene(scene), session)
    # First of all: what cannot be simulated is refused before anything is written.
    truth = shot.truth()
    sources = [BenchSource(shot, name) for name in shot.beats]
    writer = RecordingWriter(
        out,
        streams={source.name: StreamInfo.of(source) for source in sources},
        rate=session.rate,
        hardware={"bench": "virtual (simulated)", "probe": "simulated", "target": "simulated"},
        extra=shot.parameters(),
        start_utc_ns=int(session.start.timestamp()) * 10**9,
        overwrite=overwrite,
    )
    with writer:
        frames = heapq.merge(*map(_named, sources), key=lambda one: (one[1].utc_ns, one[0]))
        for stream, frame in progress(frames, "filming", total=sum(map(len, sources))):
            writer.add(stream, frame)
    recording = open_recording(out)
    recording.write_truth(truth)
    return recording


def _named(source: BenchSource) -> Iterator[tuple[str, Frame]]:
    for frame in source:
        yield source.name, frame


def without_second_beam(scene: Scene) -> Scene:
    """The same scene with an ideal beam splitter."""
    return replace(scene, illumination=replace(scene.illumination, second_beam=None))
