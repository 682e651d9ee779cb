"""One part of a set: its frames filmed, labelled by the laser in the target's images, selected and cut."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import torch
from threadpoolctl import threadpool_limits

from tapetum.bench import Scene
from tapetum.data.build import add_frames, labels_of
from tapetum.data.dataset import TRUE_GAZE
from tapetum.data.synth.clip import Clip
from tapetum.data.synth.plan import Part, Video
from tapetum.data.synth.store import Made, Staging
from tapetum.data.write import Rules
from tapetum.record import Session, label_recording
from tapetum.record.clocks import NoOverlapError
from tapetum.record.labels import NoLaserError
from tapetum.record.shot import Shot

__all__ = ["keep_part", "make_part", "one_thread", "shot_of"]


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Compute in one thread: workers share a machine, and the last bit of a sum depends on how it is divided."""
    before, before_cv = torch.get_num_threads(), cv2.getNumThreads()
    with threadpool_limits(1):
        try:
            torch.set_num_threads(1)
            cv2.setNumThreads(1)
            yield
        finally:
            torch.set_num_threads(before)
            cv2.setNumThreads(before_cv)


# A worker makes parts of one video at a time, and of two when it goes on to the next.
@functools.lru_cache(maxsize=2)
def shot_of(scene: Scene, session: Session) -> Shot:
    """Prepare a shot, which takes a while, and cache it for the next part of the same video."""
    return Shot(scene, session)


@functools.lru_cache(maxsize=2)
def _seen_of(shot: Shot) -> dict[int, Any]:
    """Return what was seen of a shot's target so far, by frame: the labels of a part need some 20 s of it beside."""
    del shot
    return {}


def make_part(video: Video, part: Part, rules: Rules, classes: list[str]) -> Made:
    """Make one part of a set whose devices are `classes`; equal arguments give equal bits.

    Return the crops and labels of the frames that are kept, and the counts of those that are not.
    """
    with one_thread():
        shot = shot_of(video.scene, video.session)
        clip = Clip.of(video, shot, part.first, part.last, _seen_of(shot))
        total = len(shot.beats["probe"].times)
        first, last = clip.ranges["probe"]
        made = Made(told={"frames": total, "used": 0, "left_out": {"no label": last - first}})
        if part.first == 0:
            made.parameters = shot.parameters()
        if _labelled(clip):
            labels = labels_of(clip, classes)
            made.told = add_frames(clip, part.video, labels, made.add, rules, total)
        if made.crops:
            true = shot.gaze([int(number) for number in made.columns["frame_index"]])
            made.columns |= {name: true[:, axis].tolist() for axis, name in enumerate(TRUE_GAZE)}
        return made


def keep_part(path: str | Path, video: Video, part: Part, rules: Rules, classes: list[str]) -> None:
    """Make one part and keep it in the folder `path`, unless it is done already."""
    staging = Staging(Path(path))
    if not staging.has(part):
        staging.keep(part, make_part(video, part, rules, classes))


def _labelled(clip: Clip) -> bool:
    """Label a clip; return False where the laser is not seen, or the clip is empty."""
    if any(first == last for first, last in clip.ranges.values()):
        return False
    try:
        label_recording(clip)
    except (NoLaserError, NoOverlapError):
        # Only in a whole recording is a missing laser an error; and a video's last probe frames may be a part of their
        # own and come after the target's last one.
        return False
    return True
