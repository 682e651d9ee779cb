"""Maximisation of one crop's likelihood by damped Fisher scoring, with photosites separated from the slow image.

Behind a fast lens, the photosites' diffraction orders make an image nearly periodic in the gaze, with a period of some
thousandth of the field. What changes from period to period is slow and smooth. Both are fitted together as separate
variables: the *slow* gaze moves by whole periods, the *phase* within one. Their likelihood has one maximum where that
of the gaze has hundreds; the period is determined last.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from tapetum.models.simulation.counts import CountModel
from tapetum.models.simulation.noise import Noise
from tapetum.models.simulation.pictures import Pictures, Pose

__all__ = ["FREE", "PHASE", "SLOW", "Search", "Top"]

Array = NDArray[np.float64]

SLOW = ("gaze_x", "gaze_y")
PHASE = ("phase_x", "phase_y")
FREE = ("place_x", "place_y", "power", "background", "roll", "object_distance", "focal_length")
"""Parameters that may be free besides gaze and phase (the photosites' place under the spot, fractions of the field)."""

# Steps of finite differences: of the gaze in λf/2r or in photosite periods, of the roll in radians.
_SPOT_SHARE, _PERIODS, _PERIOD_SHARE, _ROLL_STEP = 1 / 20, 2, 1 / 200, 1e-3
# Step of the focus: its phase at the pupil's edge, in radians.
_FOCUS_STEP = 0.05
# Largest change in one step: gaze (fractions of the field), place (pixels), roll (radians), factor of the power.
_MOST_GAZE, _MOST_PLACE, _MOST_ROLL, _MOST_POWER = 0.05, 8.0, 0.02, 2.0
_STEPS, _SETTLED, _HARDEST = 25, 0.03, 1e6
# Derivatives are kept so far, in λf/2r of the gaze, in pixels of the place and as a share of the power, if only these
# and the background are free: pictures are nearly linear there.
_SAME = 0.1
_STRAIGHT = {*SLOW, "place_x", "place_y", "power", "background"}
# Periods from which the slow gaze moves the images that it is counted from.
_HALFWAY = 0.75


@dataclass(frozen=True)
class Top:
    """A local maximum of the likelihood, at `pose`.

    `slow` [2] is the slow gaze less the pose's, in fractions of the field (0 unless the phase is free). `names` are the
    free parameters, `information` [P, P] their Fisher information. `log_likelihood` omits constants. `misfit` is the
    mean squared residual in variances (1 for a true model); `settled` says whether the search converged.
    """

    pose: Pose
    slow: Array
    names: tuple[str, ...]
    information: Array
    log_likelihood: float
    misfit: float
    settled: bool

    @property
    def covariance(self) -> Array:
        """[P, P], the inverse of the information."""
        own = np.sqrt(np.maximum(self.information.diagonal(), 1e-300))
        return np.linalg.pinv(self.information / np.outer(own, own), hermitian=True) / np.outer(own, own)


class Search:
    """One crop's likelihood: digital numbers `counts` [side, side] against the images of `pictures`.

    `free` names the unknowns of `FREE`; the gaze is always free. `offsets` are the RMS offsets of the sensor's columns
    and rows, in electrons.
    """

    def __init__(
        self,
        pictures: Pictures,
        counts: Array,
        model: CountModel,
        free: tuple[str, ...],
        offsets: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.pictures, self.counts, self.model, self.free, self.offsets = pictures, counts, model, free, offsets
        scene = pictures.scene
        wave = 2 * np.pi / scene.illumination.wavelength * scene.target.lens.aperture_radius**2 / 2
        self._vergence = _FOCUS_STEP / wave

    def climb(self, pose: Pose, *, phase: bool, slow: Array | None = None, steps: int = _STEPS) -> Top:
        """Return the maximum near a pose, within `steps` steps; `phase` fits slow gaze and phase separately."""
        names = (*SLOW, *(PHASE if phase else ()), *self.free)
        at, beside, taken = pose, np.zeros(2) if slow is None else slow, pose
        mean, slopes = self.tangent(at, beside, names)
        expected, bend, variance = self.model(mean)
        hardness, settled = 1e-3, False
        for _ in range(steps):
            noise = self.noise(bend, variance)
            bent, residual = slopes * bend, self.residual(expected)
            information, score = noise(bent, bent), noise(bent, residual)[:, 0]
            own = np.sqrt(np.maximum(information.diagonal(), 1e-300))
            shared = information / np.outer(own, own)
            step = np.linalg.lstsq(shared + hardness * np.eye(len(own)), score / own, rcond=1e-12)[0] / own
            if settled := float(np.abs(step * own).max()) < _SETTLED:
                break
            new_at, new_beside = self.moved(at, beside, names, step)
            if kept := self._near(taken, new_at, names):
                mean, new_slopes = self._mean(new_at), slopes
            else:
                mean, new_slopes = self.tangent(new_at, new_beside, names)
            new = self.model(mean)
            # Same weights as for the step: a larger variance must not count as a better fit.
            left = self.residual(new[0])
            if float(noise(left, left)[0, 0]) > float(noise(residual, residual)[0, 0]) + 1e-3:
                hardness = max(1e-3, hardness) * 8
                if hardness > _HARDEST:
                    break
                continue
            at, beside, slopes = new_at, new_beside, new_slopes
            taken = taken if kept else at
            expected, bend, variance = new
            hardness = hardness / 6 if hardness > 1e-6 else 0.0
        noise = self.noise(bend, variance)
        bent, residual = slopes * bend, self.residual(expected)
        squares = float(noise(residual, residual)[0, 0])
        value, misfit = -0.5 * (squares + noise.log_determinant), squares / residual.size
        return Top(at, beside, names, noise(bent, bent), value, misfit, settled)

    def _near(self, one: Pose, other: Pose, names: tuple[str, ...]) -> bool:
        """Return whether the derivatives at two poses are the same for the search."""
        if self.pictures.period is not None or not set(names) <= _STRAIGHT:
            return False
        turned = np.abs(np.subtract(other.gaze, one.gaze)) / self.pictures.spot
        shifted = np.abs(np.subtract(other.place, one.place)) / self.pictures.pitch
        brighter = abs(other.power / one.power - 1)
        return bool(max(*turned, *shifted, brighter) < _SAME)

    def _mean(self, pose: Pose) -> Array:
        """Return the mean electrons [N] at a pose."""
        light = self.pictures.render_each([pose])[0]
        return (pose.background + pose.power / self.pictures.scene.illumination.power * light).ravel()

    def noise(self, bend: Array, variance: Array) -> Noise:
        """Return the covariance of the digital numbers, of slope and variance from the count model."""
        return Noise(bend.reshape(self.counts.shape), variance, self.offsets)

    def residual(self, expected: Array) -> Array:
        """Return the digital numbers less those expected, [1, N]."""
        return (self.counts.ravel() - expected)[None]

    def in_phase(self, pose: Pose) -> Pose:
        """Return the pose with its gaze moved to the best photosite phase within a period."""
        period = self.pictures.period
        if period is None:
            return pose
        thirds = np.arange(3) / 3
        gazes = np.array(pose.gaze) + np.stack(np.meshgrid(thirds, thirds), -1).reshape(-1, 2) * period
        made = self.pictures.render(pose, gazes)
        scale = pose.power / self.pictures.scene.illumination.power
        left = [self._unexplained(one, pose.background + scale * one) for one in made]
        x, y = gazes[int(np.argmin(left))]
        return replace(pose, gaze=(float(x), float(y)))

    def _unexplained(self, light: Array, mean: Array) -> float:
        """Return the weighted sum of squares after a fit of scale, background and small shift of an image."""
        expected, bend, variance = self.model(mean.ravel())
        weight = bend / np.sqrt(variance)
        columns = np.stack([light.ravel(), np.ones(light.size), *(one.ravel() for one in _slopes(light))]) * weight
        rest = (self.counts.ravel() - expected) / np.sqrt(variance)
        solved = np.linalg.solve(columns @ columns.T + 1e-9 * np.eye(4), columns @ rest)
        return float((rest - solved @ columns) @ (rest - solved @ columns))

    def gazes(self, pose: Pose, names: tuple[str, ...]) -> Array:
        """Return the gazes [G, 2] whose images `tangent` compares, the pose's own first."""
        gaze, inward = np.array(pose.gaze), _inward(pose)
        return np.stack([gaze, *(gaze + inward * step for step in self._steps(names))])

    def _steps(self, names: tuple[str, ...]) -> list[Array]:
        period = self.pictures.period
        steps = [*np.diag(self.pictures.spot * _SPOT_SHARE if period is None else period * _PERIOD_SHARE)]
        if PHASE[0] in names:
            assert period is not None
            steps = [*np.diag(_PERIODS * period), *steps]
        return steps

    def tangent(
        self, pose: Pose, slow: Array, names: tuple[str, ...], made: Array | None = None
    ) -> tuple[Array, Array]:
        """Return the mean electrons [N] at a pose, and their derivatives [P, N] by the free parameters.

        `made` are the images of the pose at its `gazes`, where they are there already.
        """
        pictures, scene = self.pictures, self.pictures.scene
        gaze, phase, inward, steps = np.array(pose.gaze), PHASE[0] in names, _inward(pose), self._steps(names)
        if made is None:
            made = pictures.render(pose, self.gazes(pose, names))
        scale = pose.power / scene.illumination.power
        shown = light = made[0]
        sizes = [float(inward @ step) for step in steps]
        by_gaze = [(one - light) / size for one, size in zip(made[1:], sizes, strict=True)]
        if phase:
            # A shift by whole periods changes the slow part alone, a fraction of one changes both.
            by_gaze[2:] = [fast - slowly for fast, slowly in zip(by_gaze[2:], by_gaze[:2], strict=True)]
            light = light + slow[0] * by_gaze[0] + slow[1] * by_gaze[1]
        found = {name: scale * one for name, one in zip((*SLOW, *PHASE), by_gaze, strict=False)}
        if "place_x" in names or "place_y" in names:
            dx, dy = _slopes(light)
            found |= {"place_x": -scale * dx / pictures.pitch, "place_y": -scale * dy / pictures.pitch}
        found |= {"power": light / scene.illumination.power, "background": np.ones_like(light)}
        focus = {name: self._vergence * getattr(pose, name) ** 2 for name in ("object_distance", "focal_length")}
        for name, size in {"roll": _ROLL_STEP, **focus}.items():
            if name in names:
                moved = replace(pose, **{name: getattr(pose, name) + size})
                base = shown
                if name == "roll" and pose.roll == 0:
                    # Images without roll are not interpolated: compare with one of a tiny roll, which is.
                    base = pictures.render(replace(pose, roll=1e-12), gaze[None])[0]
                found[name] = scale * (pictures.render(moved, gaze[None])[0] - base) / size
        mean = pose.background + scale * light
        return mean.ravel(), np.stack([found[name].ravel() for name in names])

    def moved(self, pose: Pose, slow: Array, names: tuple[str, ...], step: Array) -> tuple[Pose, Array]:
        """Return the pose and slow gaze after a step, limited to where the derivatives hold."""
        by = dict(zip(names, step, strict=True))
        most = dict.fromkeys(SLOW, _MOST_GAZE) | {"roll": _MOST_ROLL}
        most |= dict.fromkeys(("place_x", "place_y"), _MOST_PLACE * self.pictures.pitch)
        for name in ("object_distance", "focal_length"):
            most[name] = 5 * self._vergence / _FOCUS_STEP * getattr(pose, name) ** 2
        if self.pictures.period is not None:
            most |= dict(zip(PHASE if PHASE[0] in names else SLOW, 0.3 * self.pictures.period, strict=True))
        by = {name: float(np.clip(size, -most.get(name, np.inf), most.get(name, np.inf))) for name, size in by.items()}
        wanted = np.array(pose.gaze) + slow + [by[name] for name in SLOW]
        if PHASE[0] in names:
            assert self.pictures.period is not None
            turned = np.array(pose.gaze) + [by[name] for name in PHASE]
            # Only a slow gaze that is clearly nearer to another period moves there: it would go to and fro halfway.
            away = (wanted - turned) / self.pictures.period
            gaze = turned + self.pictures.period * np.where(np.abs(away) > _HALFWAY, np.rint(away), 0.0)
        else:
            gaze = wanted
        gaze = np.clip(gaze, -0.499, 0.499)
        moved = replace(
            pose,
            gaze=(float(gaze[0]), float(gaze[1])),
            place=(pose.place[0] + by.get("place_x", 0.0), pose.place[1] + by.get("place_y", 0.0)),
            power=float(np.clip(pose.power + by.get("power", 0.0), pose.power / _MOST_POWER, pose.power * _MOST_POWER)),
            background=max(0.0, pose.background + by.get("background", 0.0)),
            roll=float(np.clip(pose.roll + by.get("roll", 0.0), -0.5, 0.5)),
            object_distance=pose.object_distance + by.get("object_distance", 0.0),
            focal_length=pose.focal_length + by.get("focal_length", 0.0),
        )
        return moved, wanted - gaze if PHASE[0] in names else np.zeros(2)


def _inward(pose: Pose) -> Array:
    """Return the directions of steps of the gaze: towards the middle, and so within the field."""
    return np.where(np.array(pose.gaze) > 0, -1.0, 1.0)


def _slopes(picture: Array) -> tuple[Array, Array]:
    """Return derivatives [H, W] per pixel along columns and rows: five points, 1 % error at periods of 5 pixels."""
    points = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12
    return correlate1d(picture, points, axis=1, mode="nearest"), correlate1d(picture, points, axis=0, mode="nearest")
