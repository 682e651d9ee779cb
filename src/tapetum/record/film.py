"""The virtual bench: films a scene as two cameras with clocks of their own would."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import torch

from tapetum.bench import Scene, scene_dict
from tapetum.errors import InputError
from tapetum.progress import Progress, quiet
from tapetum.record.motion import HandMotion
from tapetum.record.recording import Recording, StreamInfo, open_recording
from tapetum.record.room import Room
from tapetum.record.writer import RecordingWriter
from tapetum.simulate import Camera, tilt_of_gaze
from tapetum.simulate.exposure import digitise
from tapetum.simulate.gaze import largest_sine
from tapetum.simulate.radiometry import electrons

__all__ = ["CameraClock", "Session", "film"]

_BATCH = 8


@dataclass(frozen=True)
class CameraClock:
    """When a camera takes its frames, and what its own clock says.

    Parameters
    ----------
    offset
        Of the first frame after the recording's start, in seconds.
    jitter
        Root mean square of a frame's time about its even beat, in seconds.
    drift
        Of its monotonic clock, in parts of one.
    loss
        Probability that a frame is lost.
    """

    offset: float = 0.0
    jitter: float = 1.5e-3
    drift: float = 2e-5
    loss: float = 0.004

    def draw(self, count: int, rate: float, rng: np.random.Generator) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Times of the frames that were kept, in seconds from the start, and the number lost before each."""
        times = self.offset + np.arange(count) / rate
        # A quarter of the beat at the most: frames never change places.
        times = times + np.clip(self.jitter * rng.standard_normal(count), -0.25 / rate, 0.25 / rate)
        kept = np.flatnonzero(np.r_[True, rng.random(count - 1) >= self.loss] if count else [])
        return times[kept], np.diff(kept, prepend=kept[:1]) - np.r_[0, np.ones(len(kept) - 1, int)]


@dataclass(frozen=True)
class Session:
    """How long to film, how the target is held, and how the clocks run.

    Parameters
    ----------
    seconds, rate
        Length and frames a second of both cameras.
    seed
        Of everything random. The same scene, session and seed give the same frames.
    motion
        How the target is held.
    probe_clock, target_clock
        The two cameras' clocks.
    start
        UTC of the beginning.
    laser
        Whether the target sees the probe's laser.
    """

    seconds: float = 60.0
    rate: float = 15.0
    seed: int = 0
    motion: HandMotion = field(default_factory=HandMotion)
    probe_clock: CameraClock = field(default_factory=CameraClock)
    target_clock: CameraClock = field(default_factory=lambda: CameraClock(offset=0.021, drift=-3e-5))
    start: datetime = datetime(2026, 1, 1, tzinfo=UTC)
    laser: bool = True


def film(
    scene: Scene,
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
        What stands on the bench; the target's rotation is the hand's.
    out
        The recording's folder, by custom `NAME.rec`.
    session
        Length, motion, clocks and seed.
    progress
        Shows the frames.
    overwrite
        Whether a recording at `out` may be replaced.

    Raises
    ------
    InputError
        For a session without frames, a full disk, or an existing recording.
    """
    session = session or Session()
    count = round(session.seconds * session.rate)
    if count < 1:
        raise InputError(f"{session.seconds:g} s hold no frame", where="seconds", remedy="film longer")
    start_ns = int(session.start.timestamp()) * 10**9
    gaze, place = session.motion.draw(session.seed)
    target, probe = scene.target.sensor, scene.probe.sensor
    beats = {
        "probe": session.probe_clock.draw(count, session.rate, np.random.default_rng([session.seed, 3])),
        "target": session.target_clock.draw(count, session.rate, np.random.default_rng([session.seed, 4])),
    }
    streams = {
        "probe": StreamInfo(probe.pixels[1], probe.pixels[0], probe.bits, 2**probe.bits - 1, session.rate),
        "target": StreamInfo(target.pixels[1], target.pixels[0], 8, 255, session.rate),
    }
    pictures = {
        "probe": probe_frames(scene, gaze(beats["probe"][0]), place(beats["probe"][0]), session.seed),
        "target": target_frames(scene, gaze(beats["target"][0]), session),
    }
    clocks = {"probe": session.probe_clock, "target": session.target_clock}
    order = sorted((t, name, i) for name, (times, _) in beats.items() for i, t in enumerate(times))
    writer = RecordingWriter(
        Path(out),
        streams=streams,
        rate=session.rate,
        hardware={"bench": "virtual (simulated)", "probe": "simulated", "target": "simulated"},
        extra={
            "scene": scene_dict(scene),
            "seed": session.seed,
            "seconds": session.seconds,
            "motion": session.motion.as_dict(),
            "clocks": {name: vars(clock) for name, clock in clocks.items()},
        },
        start_utc_ns=start_ns,
        overwrite=overwrite,
    )
    with writer:
        for t, name, i in progress(order, "filming", total=len(order)):
            writer.write(
                name,
                next(pictures[name]),
                monotonic_ns=round((t + 1e3) * (1 + clocks[name].drift) * 1e9),
                utc_ns=start_ns + round(t * 1e9),
                dropped_before=int(beats[name][1][i]),
            )
    recording = open_recording(out)
    recording.write_truth(_truth({n: b[0] for n, b in beats.items()}, gaze, place))
    return recording


def probe_frames(
    scene: Scene, gaze: npt.NDArray[np.float64], place: npt.NDArray[np.float64], seed: int
) -> Iterator[npt.NDArray[Any]]:
    """Frames of the probe's camera for gazes [T, 2] (fractions of the field) and places [T, 2] (metres sideways)."""
    sines = tilt_of_gaze(scene, torch.from_numpy(gaze))
    # A camera moved to the right in the probe's view shifts its RR by f_p/d times that.
    centres = torch.from_numpy(place * (scene.probe.lens.focal_length / scene.distance))
    steepest = largest_sine(sines)
    # Only the RR's own neighbourhood is computed: light beyond it would not make one electron.
    camera = Camera(scene, steepest, output=Camera(scene, steepest).window())
    sensor, rng = scene.probe.sensor, np.random.default_rng([seed, 5])
    for i in range(0, len(sines), _BATCH):
        frames = torch.zeros(len(sines[i : i + _BATCH]), sensor.pixels[1], sensor.pixels[0])
        for tilts, places, share in camera.beams(sines[i : i + _BATCH], centres[i : i + _BATCH]):
            pixel = torch.round(places / sensor.pitch)
            patches = camera.render(tilts, places - pixel * sensor.pitch, share, equivalent=True)
            for frame, patch, (x, y) in zip(frames, patches, pixel.to(torch.int64).tolist(), strict=True):
                _add(frame, patch, x, y)
        yield from digitise(electrons(frames, sensor, scene.illumination.wavelength), sensor, rng)


def _add(frame: torch.Tensor, patch: torch.Tensor, x: int, y: int) -> None:
    """Add a patch whose middle lies (x, y) pixels from the frame's, as far as it lies inside."""
    top = (frame.shape[0] - patch.shape[0]) // 2 + y
    left = (frame.shape[1] - patch.shape[1]) // 2 + x
    inside = frame[max(0, top) : top + patch.shape[0], max(0, left) : left + patch.shape[1]]
    if top + patch.shape[0] > 0 and left + patch.shape[1] > 0 and inside.numel():
        dy, dx = max(0, -top), max(0, -left)
        inside += patch[dy : dy + inside.shape[0], dx : dx + inside.shape[1]]


def target_frames(scene: Scene, gaze: npt.NDArray[np.float64], session: Session) -> Iterator[npt.NDArray[np.uint8]]:
    """Pictures of the target's camera for gazes [T, 2]: the room, the laser, and the second beam's spot beside it."""
    sensor, second = scene.target.sensor, None
    beam = scene.illumination.second_beam
    if beam is not None and beam.ratio > 0:
        reach = scene.target.lens.focal_length / sensor.pitch
        second = (reach * math.tan(beam.angle[0]), reach * math.tan(beam.angle[1]), beam.ratio)
    room = Room(*sensor.pixels, session.seed, second=second, **({} if session.laser else {"spot_peak": 0.0}))
    rng = np.random.default_rng([session.seed, 6])
    for one in gaze:
        yield room.picture(one, rng)


def without_second_beam(scene: Scene) -> Scene:
    """The same scene with an ideal beam splitter."""
    return replace(scene, illumination=replace(scene.illumination, second_beam=None))


def _truth(times: dict[str, npt.NDArray[np.float64]], gaze: Any, place: Any) -> pa.Table:
    rows: dict[str, list[Any]] = {n: [] for n in ("stream", "frame", "gaze_x", "gaze_y", "offset_x", "offset_y")}
    for name, t in times.items():
        g, p = gaze(t), place(t)
        rows["stream"] += [name] * len(t)
        rows["frame"] += list(range(len(t)))
        for key, values in (
            ("gaze_x", g[:, 0]),
            ("gaze_y", g[:, 1]),
            ("offset_x", p[:, 0]),
            ("offset_y", p[:, 1]),
        ):
            rows[key] += values.tolist()
    return pa.table(rows)
