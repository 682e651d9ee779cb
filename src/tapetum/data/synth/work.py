"""One part of a set: its frames filmed, labelled by the laser in the target's pictures, judged and cut."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from tapetum.bench import Scene
from tapetum.data.build import add_frames, labels_of
from tapetum.data.dataset import TRUE_GAZE
from tapetum.data.synth.clip import Clip, Filmed
from tapetum.data.synth.plan import Part, Video
from tapetum.data.write import Rules
from tapetum.record import Session, label_recording
from tapetum.record.spot import NoLaserError

__all__ = ["MALLOC", "Made", "make_part", "one_thread", "shot_of"]

MALLOC = {
    "MALLOC_MMAP_THRESHOLD_": str(1 << 30),
    "MALLOC_TRIM_THRESHOLD_": str(2**31 - 1),
    "MALLOC_ARENA_MAX": "1",
}
"""Environment of processes that make parts. What `tapetum` itself does by mallopt (see tapetum.cli.memory); Dask sets
the contrary, which costs a part half its time. A worker's tasks run in a thread, and only the first arena keeps big
blocks."""


@dataclass
class Made:
    """What became of a part: its crops, and all else that the set keeps of it.

    Parameters
    ----------
    crops
        [side, side] each.
    columns
        Labels and places of the crops, by name.
    told
        Frames used and left out, by reason, and the frames of the whole video.
    parameters
        All that was drawn for the video, with its first part only.
    digests
        Of the crops, in hexadecimal, once they are kept: what is read back is checked by them.
    """

    crops: list[NDArray[np.generic]] = field(default_factory=list)
    columns: dict[str, list[float]] = field(default_factory=dict)
    told: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, Any] | None = None
    digests: list[str] | None = None

    def add(self, image: NDArray[np.generic], /, **values: float) -> None:
        """Keep a crop, and what is known of it."""
        self.crops.append(image)
        for name, value in values.items():
            self.columns.setdefault(name, []).append(value)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Compute in one thread: several workers share a machine, and the last bit of a sum hangs on its parts."""
    before, before_cv = torch.get_num_threads(), cv2.getNumThreads()
    with threadpool_limits(1):
        try:
            torch.set_num_threads(1)
            cv2.setNumThreads(1)
            yield
        finally:
            torch.set_num_threads(before)
            cv2.setNumThreads(before_cv)


# One video at a time is being worked on, seldom two where a worker goes on to the next.
@functools.lru_cache(maxsize=2)
def shot_of(scene: Scene, session: Session) -> Filmed:
    """Prepare a shot, which takes a while, and keep it for the next part of the same video."""
    from tapetum.record.shot import Shot

    return Shot(scene, session)


def make_part(
    video: Video,
    part: Part,
    rules: Rules,
    classes: list[str],
    shoot: Callable[[Scene, Session], Any] = shot_of,
) -> Made:
    """Make one part of a set; the same arguments give the same bits, wherever and whenever.

    Parameters
    ----------
    video
        The video it belongs to.
    part
        Which frames of it.
    rules
        How frames are judged, cut and split.
    classes
        Names of all devices in the set.
    shoot
        Prepares the shot.

    Returns
    -------
    Made
        Crops and labels of the frames that are kept, counts of those that are not.
    """
    with one_thread():
        shot = shoot(video.scene, video.session)
        clip = Clip.of(video, shot, part.first, part.last)
        made = Made()
        total = len(shot.beats["probe"].times)
        first, last = clip.ranges["probe"]
        made.told = {"frames": total, "used": 0, "left_out": {"no label": last - first}}
        if part.first == 0:
            made.parameters = shot.parameters()
        if _labelled(clip):
            labels = labels_of(clip, classes)
            made.told = add_frames(clip, part.video, labels, made.add, rules, total)
        if made.crops:
            true = shot.gaze([int(number) for number in made.columns["frame_index"]])
            made.columns |= {name: true[:, axis].tolist() for axis, name in enumerate(TRUE_GAZE)}
        return made


def _labelled(clip: Clip) -> bool:
    """Label a clip; False where the laser is nowhere to be seen, or the clip is empty."""
    if any(first == last for first, last in clip.ranges.values()):
        return False
    try:
        label_recording(clip)
    except NoLaserError:
        # A whole recording without the laser is a fault; a few seconds without it are not.
        return False
    return True
