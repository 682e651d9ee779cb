"""The virtual bench: films a scene as two cameras with clocks of their own would."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from tapetum.bench import Scene, as_scene
from tapetum.progress import Progress, quiet
from tapetum.record.beats import CameraClock
from tapetum.record.recording import Recording, StreamInfo, open_recording
from tapetum.record.session import Placed, Session
from tapetum.record.shot import Shot, probe_frames
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
    """Film a hand-held target on the virtual bench, as a recording with two streams and the bench's truth beside.

    Parameters
    ----------
    scene
        What stands on the bench, or its name or path; the target's rotation is the hand's.
    out
        The recording's folder, by custom `NAME.rec`.
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
    scene, session = as_scene(scene), session or Session()
    shot = Shot(scene, session)
    # First of all: what cannot be simulated is refused before anything is written.
    truth = shot.truth()
    start_ns = int(session.start.timestamp()) * 10**9
    probe, (columns, rows) = scene.probe.sensor, shot.picture
    streams = {
        "probe": StreamInfo(probe.pixels[1], probe.pixels[0], probe.bits, 2**probe.bits - 1, session.rate),
        "target": StreamInfo(rows, columns, 8, 255, session.rate),
    }
    pictures = {"probe": shot.probe, "target": shot.target}
    clocks = {"probe": session.probe_clock, "target": session.target_clock}
    order = sorted((t, name, i) for name, beat in shot.beats.items() for i, t in enumerate(beat.times))
    writer = RecordingWriter(
        Path(out),
        streams=streams,
        rate=session.rate,
        hardware={"bench": "virtual (simulated)", "probe": "simulated", "target": "simulated"},
        extra=shot.parameters(),
        start_utc_ns=start_ns,
        overwrite=overwrite,
    )
    with writer:
        for t, name, i in progress(order, "filming", total=len(order)):
            writer.write(
                name,
                pictures[name](i, i + 1)[0],
                monotonic_ns=round((t + 1e3) * (1 + clocks[name].drift) * 1e9),
                utc_ns=start_ns + round(t * 1e9),
                dropped_before=int(shot.beats[name].dropped_before[i]),
                exposure=shot.exposure(name, i),
                lit=shot.lit(name, i),
            )
    recording = open_recording(out)
    recording.write_truth(truth)
    return recording


def without_second_beam(scene: Scene) -> Scene:
    """The same scene with an ideal beam splitter."""
    return replace(scene, illumination=replace(scene.illumination, second_beam=None))
