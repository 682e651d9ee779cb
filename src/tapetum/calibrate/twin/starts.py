"""Where the searches for a twin begin: places of the retro-reflections, and a gaze offset common to all frames.

A tilted sensor and a decentred lens change a picture nearly as another gaze would, by up to a tenth of the field. This
common offset is found by comparing a few frames with pictures at gazes around their labels, because the fit itself
converges only from near by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tapetum.bench import Target
from tapetum.calibrate.twin.frames import TwinFrame
from tapetum.calibrate.twin.normal_equations import Normal, State
from tapetum.models.simulation.pictures import Pictures, Pose
from tapetum.models.simulation.starts import Templates
from tapetum.progress import Progress, quiet
from tapetum.simulate.exposure import gain_of
from tapetum.simulate.gaze import field_size

__all__ = ["placed_in", "shifts", "starting"]

Array = NDArray[np.float64]
# The grid of shifts: its half width in standard deviations of a unit's own shift, its largest step in fractions of the
# field, its largest number of nodes along an axis, and frames that are compared.
_REACH, _STEP, _NODES, _FRAMES = 2.2, 0.028, 11, 4
# Largest shift, in fractions of the field, that a search makes up for itself: about the spacing of the bank of a fit by
# simulation, without and with photosites that show.
_NEAR, _NEAR_SITES = 0.02, 0.1


def placed_in(normal: Normal, coordinates: Array) -> State:
    """Return a state with every gaze at its label, and every place and brightness as they match the frame best."""
    pictures = normal.pictures(coordinates)
    poses: list[Pose] = []
    templates = Templates(pictures, [replace(pictures.start(), gaze=_inside(frame.gaze)) for frame in normal.frames])
    for number, frame in enumerate(normal.frames):
        ((found, _),) = templates.match(*_weighed(normal, frame), [number])
        if pictures.period is not None:
            found = normal.search(frame, pictures).in_phase(found)
        poses.append(found)
    slow = np.array([frame.gaze for frame in normal.frames]) - [pose.gaze for pose in poses]
    if pictures.period is None:
        slow = np.zeros_like(slow)
    return normal.moved(State(coordinates, tuple(poses), slow), coordinates)


def shifts(normal: Normal, coordinates: Array, progress: Progress = quiet) -> list[Array]:
    """Return shifts of the gaze [2], the best first, by which the pictures at some coordinates explain the frames."""
    # Single precision serves here, and takes two thirds of the time.
    pictures = Pictures(normal.pictures(coordinates).scene, normal.side, normal.accuracy, count=_NODES**2)
    usual = np.array([_usual_shift(normal, pictures, axis) for axis in (0, 1)])
    if _REACH * usual.max() < (_NEAR if pictures.period is None else _NEAR_SITES):
        return [np.zeros(2)]
    lines: list[Array] = []
    for reach in _REACH * usual:
        nodes = min(_NODES, 2 * int(np.ceil(reach / _STEP)) + 1)
        lines.append(np.linspace(-reach, reach, nodes) if nodes > 1 else np.zeros(1))
    grid = np.stack(np.meshgrid(*lines), -1)
    flat = grid.reshape(-1, 2)
    total = np.zeros(len(flat))
    chosen = np.linspace(0, len(normal.frames) - 1, min(_FRAMES, len(normal.frames))).round().astype(int)
    for n in progress(chosen.tolist(), "looking for the unit's shift"):
        frame = normal.frames[n]
        poses = [replace(pictures.start(), gaze=_inside(frame.gaze + shift)) for shift in flat]
        electrons, weight = _weighed(normal, frame)
        found = Templates(pictures, poses).match(electrons, weight)
        total += [score for _, score in found]
    # Maxima of the grid, the best first.
    high, wide = len(lines[1]), len(lines[0])
    table = total.reshape(high, wide)
    padded = np.pad(table, 1, constant_values=-np.inf)
    around = np.stack([padded[r : r + high, c : c + wide] for r in range(3) for c in range(3)])
    top = np.argwhere(table >= around.max(0))
    order = np.argsort([-table[r, c] for r, c in top])
    return [grid[tuple(top[k])] for k in order]


def starting(normal: Normal, coordinates: Array, shift: Array) -> Array:
    """Return coordinates whose tilt and decentre, as far as they are fitted, shift the pictures by a gaze [2]."""
    pictures, found = normal.pictures(coordinates), coordinates.copy()
    size, z = field_size(pictures.scene).numpy(), _image_distance(pictures)
    names = [one.name for one in normal.parameters]
    for axis, letter in enumerate("xy"):
        # Light sees the tilt as a gaze of z times it farther, the decentre as one that much nearer.
        by = {f"tilt_{letter}": z / size[axis], f"decentre_{letter}": -1 / size[axis]}
        own = {names.index(name): slope for name, slope in by.items() if name in names}
        power = sum((slope * normal.spread[n]) ** 2 for n, slope in own.items())
        for n, slope in own.items():
            change = shift[axis] * slope * normal.spread[n] ** 2 / power
            found[n] = normal.parameters[n].clipped(found[n] + change)
    return found


def _usual_shift(normal: Normal, pictures: Pictures, axis: int) -> float:
    size, z = field_size(pictures.scene).numpy()[axis], _image_distance(pictures)
    names = [one.name for one in normal.parameters]
    by = {f"tilt_{'xy'[axis]}": z / size, f"decentre_{'xy'[axis]}": 1 / size}
    own = [slope * normal.spread[names.index(name)] for name, slope in by.items() if name in names]
    return float(np.hypot.reduce(own)) if own else 0.0


def _image_distance(pictures: Pictures) -> float:
    target = pictures.scene.target
    assert isinstance(target, Target)
    return 1 / (1 / target.lens.focal_length - 1 / target.object_distance)


def _weighed(normal: Normal, frame: TwinFrame) -> tuple[Array, Array]:
    sensor = normal.scene.probe.sensor
    electrons = (frame.counts - sensor.offset) / gain_of(sensor)
    _, slope, variance = normal.model(np.maximum(electrons, 1.0))
    return electrons, slope**2 / variance


def _inside(gaze: Sequence[float] | Array) -> tuple[float, float]:
    x, y = np.clip(np.asarray(gaze, dtype=np.float64), -0.499, 0.499)
    return float(x), float(y)
