"""The virtual bench: films a scene with two cameras, each with its own clock."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterator
from dataclasses import replace

from tapetum.bench import Scene, as_scene
from tapetum.errors import of_type
from tapetum.progress import Progress, quiet
from tapetum.record.beats import CameraClock
from tapetum.record.layout import StreamInfo
from tapetum.record.recording import Recording, open_recording
from tapetum.record.session import Placed, Session
from tapetum.record.shot import BenchCamera, Shot, probe_frames
from tapetum.record.source import Frame
from tapetum.record.writer import RecordingWriter

__all__ = ["CameraClock", "Placed", "Session", "film", "probe_frames", "without_second_beam"]


def film(
    scene: Scene | str | os.PathLike[str],
    out: str | os.PathLike[str],
    session: Session | None = None,
    *,
    progress: Progress = quiet,
    overwrite: bool = False,
) -> Recording:
    """Film a hand-held target on the virtual bench: a recording with two streams and the bench's truth.

    Parameters
    ----------
    scene, session
        The scene, or its name or path (the target's rotation is the hand's); and length, motion, clocks, light,
        surroundings and seed.
    out, overwrite
        The recording's folder, usually `NAME.rec`, and whether a recording there may be replaced.
    progress
        Shown over the frames.

    Raises
    ------
    InputError
        For a session without frames, a full disk, an existing recording, or an unsupported scene.
    """
    of_type(out, (str, os.PathLike), "out", "give the path of a folder, NAME.rec")
    shot = Shot(as_scene(scene), session or Session())
    # Refuses unsupported scenes before anything is written.
    truth = shot.truth()
    writer = RecordingWriter(
        out,
        streams={name: StreamInfo.of(camera) for name, camera in shot.cameras.items()},
        rate=shot.session.rate,
        hardware={"bench": "virtual (simulated)", "probe": "simulated", "target": "simulated"},
        extra=shot.parameters(),
        start_utc_ns=shot.session.start_ns,
        overwrite=overwrite,
    )
    with writer:
        cameras = shot.cameras.values()
        frames = heapq.merge(*map(_named, cameras), key=lambda one: (one[1].utc_ns, one[0]))
        for stream, frame in progress(frames, "filming", total=sum(map(len, cameras))):
            writer.add(stream, frame)
    recording = open_recording(out)
    recording.write_truth(truth)
    return recording


def _named(camera: BenchCamera) -> Iterator[tuple[str, Frame]]:
    for frame in camera:
        yield camera.name, frame


def without_second_beam(scene: Scene) -> Scene:
    """Return the same scene with an ideal beam splitter."""
    return replace(scene, illumination=replace(scene.illumination, second_beam=None))
