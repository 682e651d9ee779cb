"""The labelled frames of a recording that a twin is fitted to: spread over the field, their RR visible."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapetum.bench import Scene
from tapetum.data.build import labels_of
from tapetum.data.dataset import DEVICE
from tapetum.data.write import Rules
from tapetum.errors import InputError
from tapetum.models.simulation.images import checked, looked_at
from tapetum.progress import Progress, quiet
from tapetum.record.recording import Recording, open_recording

__all__ = ["FEWEST", "MOST", "TwinFrame", "frames_of"]

Array = NDArray[np.float64]
FEWEST, MOST = 20, 200
"""Frames that a twin takes."""
# Candidates for each frame wanted: some show no retro-reflection.
_SPARE = 1.5
# Label deviation, in fractions of the field, where a recording states none, and the least that is believed.
_UNSTATED, _LEAST = 1e-3, 1e-5
# Quality from which a label counts, as in `build_dataset`.
_GOOD = 0.5


@dataclass(frozen=True, eq=False)
class TwinFrame:
    """One labelled frame.

    Attributes
    ----------
    index, time
        In its recording, and in seconds from the first frame.
    counts
        [side, side] digital numbers about the retro-reflection.
    gaze, deviation
        [2] the label and its standard deviation, in fractions of the field.
    """

    index: int
    time: float
    counts: Array
    gaze: Array
    deviation: Array


def frames_of(
    recording: str | os.PathLike[str],
    scene: Scene,
    count: int,
    *,
    window: int = 200,
    progress: Progress = quiet,
) -> tuple[Recording, list[TwinFrame]]:
    """Return a recording and `count` of its frames, or all that serve, in the order of time.

    Parameters
    ----------
    recording, scene
        The labelled recording, and the scene whose probe took it.
    count
        Of frames, 20 to 200.
    window
        Edge in pixels of the square about the retro-reflection.
    progress
        Shown over the recording.

    Raises
    ------
    InputError
        Without gaze labels, with labels of several devices, with fewer than 20 frames that serve, and for frames that
        the scene's probe cannot have taken.
    """
    if not FEWEST <= count <= MOST:
        what = f"must lie from {FEWEST} to {MOST}, is {count}"
        raise InputError(what, where="--frames", remedy="60 are usual")
    opened = open_recording(recording)
    labels, deviations = _labels(opened)
    order = _spread(np.array(list(labels)), np.array(list(labels.values())), int(_SPARE * count))
    source, sensor = opened.source("probe"), scene.probe.sensor
    stream = opened.stream("probe")
    if (stream.width, stream.height) != sensor.pixels:
        what = f"its frames have {stream.width} x {stream.height} pixels, the scene's probe {sensor.pixels[0]} x"
        remedy = "give the scene that it was filmed of"
        raise InputError(f"{what} {sensor.pixels[1]}", where=opened.path, remedy=remedy)
    if source.full_scale != 2**sensor.bits - 1:
        what = f"its full scale is {source.full_scale}, the scene's probe has {sensor.bits} bits"
        raise InputError(what, where=opened.path, remedy="set probe.sensor.bits")
    found: dict[int, TwinFrame] = {}
    wanted, rules = set(order), Rules()
    for frame in progress(source, f"reading {opened.path.name}", total=source.count):
        if frame.index not in wanted or frame.lit is False or rules.cut(frame.image) is None:
            continue
        image = checked(np.asarray(frame.image)[None], None, sensor, window)[0]
        counts, _ = looked_at(image, sensor, window)
        at = labels[frame.index], deviations[frame.index]
        found[frame.index] = TwinFrame(frame.index, frame.time, counts, *at)
    kept = [index for index in order if index in found][:count]
    if len(kept) < FEWEST:
        what = f"only {len(kept)} labelled frames show a retro-reflection, and {FEWEST} are needed"
        raise InputError(what, where=opened.path, remedy="film for longer, over the whole field")
    return opened, [found[index] for index in sorted(kept)]


def _labels(recording: Recording) -> tuple[dict[int, Array], dict[int, Array]]:
    """Return the good gaze labels by frame, and their deviations."""
    where = recording.path / "labels.parquet"
    table = recording.labels()
    if table is None:
        what, remedy = "the recording has no labels", "label it first: tapetum.record.label_recording"
        raise InputError(what, where=where, remedy=remedy)
    devices = set(table.column(DEVICE).to_pylist() if DEVICE in table.column_names else [])
    named = sorted(str(one) for one in devices if one is not None)
    if len(named) > 1:
        what = f"the recording shows {len(named)} cameras, {', '.join(named)}"
        raise InputError(what, where=where, remedy="give a recording of one camera")
    kept = labels_of(recording, named)
    if not {"gaze_x", "gaze_y"} <= set(kept.names):
        raise InputError("its labels name no gaze", where=where, remedy="label it again, by the target's video")
    places = [kept.names.index(name) for name in ("gaze_x", "gaze_y")]
    stated = {"gaze_x", "gaze_y"} <= set(kept.deviating)
    apart = [kept.deviating.index(name) for name in ("gaze_x", "gaze_y")] if stated else []
    labels: dict[int, Array] = {}
    deviations: dict[int, Array] = {}
    for frame, (values, quality, _) in kept.by_frame.items():
        gaze = values[places].astype(np.float64)
        if quality < _GOOD or np.abs(gaze).max() > 0.5:
            continue
        labels[frame] = gaze
        wide = kept.deviations[frame][apart].astype(np.float64) if stated else np.full(2, _UNSTATED)
        deviations[frame] = np.maximum(wide, _LEAST)
    if len(labels) < FEWEST:
        what = f"has {len(labels)} frames with a good gaze label, and {FEWEST} are needed"
        raise InputError(what, where=where, remedy="film for longer")
    return labels, deviations


def _spread(frames: NDArray[np.int64], gazes: Array, count: int) -> list[int]:
    """Return `count` frames, each as far as possible in gaze from those before; the first is nearest to the middle."""
    first = int(np.argmin(np.hypot(*gazes.T)))
    order, far = [first], np.hypot(*(gazes - gazes[first]).T)
    while len(order) < min(count, len(frames)):
        order.append(int(np.argmax(far)))
        far = np.minimum(far, np.hypot(*(gazes - gazes[order[-1]]).T))
    return [int(frames[one]) for one in order]
