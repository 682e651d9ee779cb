"""Normal equations of a twin: parameters that all frames share, and nuisances of every frame, which are eliminated.

The model of a frame is linearised in both. Nuisances are the gaze (known by its label), the retro-reflection's place
and brightness, the photosites' phase where their diffraction orders return, and the target's roll where asked for. They
are eliminated by Schur's complement, so that the information on the shared parameters is what is left with all
nuisances unknown.

Derivatives by nuisances are those of the fit by simulation (`models.simulation.search`); those by shared parameters are
differences of pictures, for thin and for traced lenses alike. A thin lens could be differentiated automatically by
focus, focal length, gaze and power; but a backward pass costs more than a picture, and the differences agree with it to
1 % (tests/calibrate/test_twin.py), which is enough for a step of a least-squares search.

More than 400 lines, as linearising, eliminating and stepping share the layout of the equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from tapetum.bench import PrescriptionLens, Scene
from tapetum.calibrate.twin.frames import TwinFrame
from tapetum.calibrate.twin.parameters import Parameter, placed
from tapetum.models.simulation.counts import CountModel
from tapetum.models.simulation.noise import Noise
from tapetum.models.simulation.pictures import Pictures, Pose, period_of
from tapetum.models.simulation.search import PHASE, SLOW, Search
from tapetum.progress import Progress, quiet

__all__ = ["Linear", "Normal", "State", "by_labels", "by_parameters"]

Array = NDArray[np.float64]
# Frames whose pictures are held at once.
_CHUNK = 8
# A hand's roll, in radians: the width of its prior.
_ROLL = 0.05


@dataclass(frozen=True, eq=False)
class State:
    """Where a search stands: coordinates [P], and of every frame its pose and its slow gaze less the pose's [N, 2]."""

    coordinates: Array
    poses: tuple[Pose, ...]
    slow: Array

    @property
    def gazes(self) -> Array:
        """[N, 2] the fitted gazes, in fractions of the field."""
        return np.array([pose.gaze for pose in self.poses]).reshape(-1, 2) + self.slow


@dataclass(frozen=True, eq=False)
class _Tangent:
    """A frame's mean electrons [N], their slopes by its nuisances [n, N], and the light [N] without the slow gaze's."""

    mean: Array
    slopes: Array
    light: Array


@dataclass(frozen=True, eq=False)
class _Frame:
    """One frame linearised: information [P + n, P + n] and score [P + n] of its pixels and of the priors; weights.

    `rows` [P, N] are the derivatives of the mean electrons by the shared parameters; `squares` are the weighted squares
    of the residuals, `priors` those of the deviations from the priors, whose weight is `doubt`.
    """

    rows: NDArray[np.float32]
    pixels_told: tuple[Array, Array]
    priors_told: tuple[Array, Array]
    noise: Noise
    squares: float
    priors: float
    doubt: float
    pixels: int
    lit_squares: float
    lit: int

    @property
    def matrix(self) -> Array:
        return self.pixels_told[0] + self.doubt * self.priors_told[0]

    @property
    def score(self) -> Array:
        return self.pixels_told[1] + self.doubt * self.priors_told[1]


@dataclass(frozen=True, eq=False)
class Linear:
    """All frames linearised at a state, coordinates counted in spreads.

    Attributes
    ----------
    information, score
        [P, P] and [P] of the shared parameters, nuisances eliminated.
    frames
        The frames' own parts.
    at
        [P] coordinates at which the derivatives by the shared parameters were taken.
    doubt
        Factor by which the priors weigh more. While the scene does not explain the frames yet, its residuals are more
        than noise and the pixels determine the gaze less well, so that the labels must determine it.
    """

    state: State
    information: Array
    score: Array
    frames: tuple[_Frame, ...]
    at: Array
    doubt: float

    @property
    def objective(self) -> float:
        """Weighted squares of the residuals and of the priors."""
        return sum(one.squares + one.doubt * one.priors for one in self.frames)

    def doubted(self, doubt: float) -> Linear:
        """Return the same with another weight of the priors."""
        return _reduced(self.state, [replace(one, doubt=doubt) for one in self.frames], len(self.score), self.at, doubt)

    @property
    def log_likelihood(self) -> float:
        """Of the frames' pixels, without constants."""
        return -0.5 * sum(one.squares + one.noise.log_determinant for one in self.frames)

    def misfit(self, *, lit: bool = False) -> float:
        """Mean squared residual in variances, of all pixels or of those that the retro-reflection lights."""
        if lit:
            return sum(one.lit_squares for one in self.frames) / max(1, sum(one.lit for one in self.frames))
        return sum(one.squares for one in self.frames) / sum(one.pixels for one in self.frames)

    def misfits(self) -> Array:
        """[N] of every frame's lit pixels."""
        return np.array([one.lit_squares / max(1, one.lit) for one in self.frames])


class Normal:
    """The frames of one target, ready to be linearised.

    Parameters
    ----------
    scene
        The scene as it was.
    parameters
        What is fitted of it.
    frames
        Frames of one window's size.
    accuracy
        Of the simulation; the scene's own for None.
    roll
        Whether each frame's roll is unknown.
    scatter
        Relative standard deviation of the frames' brightness about the scene's power.
    unevenness, offsets
        As for `SimulationFit`.
    near
        Largest move, in spreads, over which derivatives by the shared parameters are kept.
    """

    def __init__(
        self,
        scene: Scene,
        parameters: Sequence[Parameter],
        frames: Sequence[TwinFrame],
        *,
        accuracy: float | None = None,
        roll: bool = False,
        scatter: float = 0.3,
        unevenness: float = 0.0,
        offsets: tuple[float, float] = (0.0, 0.0),
        near: float = 0.02,
    ) -> None:
        self.scene, self.parameters, self.frames = scene, tuple(parameters), tuple(frames)
        self.accuracy, self.scatter, self.near = accuracy, scatter, near
        self._unevenness, self._offsets = unevenness, offsets
        self.side = len(frames[0].counts)
        self.model = CountModel(scene.probe.sensor, unevenness)
        self.roll = roll
        self.spread = np.array([one.spread for one in self.parameters])
        self._shown = [n for n, one in enumerate(self.parameters) if one.name not in ("background", "power")]
        self._free = ("place_x", "place_y", "power", *(("roll",) if roll else ()))
        self._kept: tuple[Array, Pictures] | None = None

    def over(self, frames: Sequence[TwinFrame], accuracy: float | None = None, near: float | None = None) -> Normal:
        """Return the same for other frames, and where given at another accuracy or with derivatives kept longer."""
        return Normal(
            self.scene,
            self.parameters,
            frames,
            accuracy=self.accuracy if accuracy is None else accuracy,
            roll=self.roll,
            scatter=self.scatter,
            unevenness=self._unevenness,
            offsets=self._offsets,
            near=self.near if near is None else near,
        )

    def pictures(self, coordinates: Array) -> Pictures:
        """Return the pictures at some coordinates; the laser's power in them stays the scene's."""
        if self._kept is None or not np.array_equal(self._kept[0], coordinates):
            shown = [self.parameters[n] for n in self._shown]
            scene = placed(self.scene, shown, coordinates[self._shown].tolist())
            count = len(self.frames) * (1 + len(self.parameters))
            self._kept = coordinates.copy(), Pictures(scene, self.side, self.accuracy, torch.complex128, count=count)
        return self._kept[1]

    def value(self, name: str, coordinates: Array) -> float | None:
        """Return the coordinate of a parameter by name; None where it is not fitted."""
        return next((float(at) for one, at in zip(self.parameters, coordinates, strict=True) if one.name == name), None)

    def search(self, frame: TwinFrame, pictures: Pictures) -> Search:
        """Return one frame's likelihood."""
        return Search(pictures, frame.counts, self.model, self._free, self._offsets)

    @property
    def sites_wander(self) -> bool:
        """Whether another scene's photosites lie elsewhere under a gaze than a step foresees.

        The map from gazes to the tilts of a traced lens is fitted anew for each scene; what these fits differ by, some
        hundredths of a micrometre, changes the photosites' phase by more than its deviation.
        """
        return isinstance(self.scene.target.lens, PrescriptionLens) and period_of(self.scene) is not None

    def names(self, pictures: Pictures) -> tuple[str, ...]:
        """Return a frame's nuisances."""
        return (*SLOW, *(PHASE if pictures.period is not None else ()), *self._free)

    def moved(self, state: State, coordinates: Array) -> State:
        """Return the state with other coordinates, and the poses' focus that belongs to them."""
        pictures = self.pictures(coordinates)
        background = self.value("background", coordinates)
        dark = pictures.start().background - self.scene.probe.sensor.background
        own = {
            "object_distance": pictures.scene.target.object_distance,
            "focal_length": pictures.scene.target.lens.focal_length,
        }
        if background is not None:
            own["background"] = background + dark
        return State(coordinates, tuple(replace(pose, **own) for pose in state.poses), state.slow)

    def linear(
        self,
        state: State,
        *,
        shared: bool = True,
        near: Linear | None = None,
        doubt: float = 1.0,
        progress: Progress = quiet,
    ) -> Linear:
        """Linearise all frames at a state; without `shared` by the nuisances alone.

        The derivatives by the shared parameters, which take most of the time, are those of `near` where the state is
        near enough.
        """
        pictures = self.pictures(state.coordinates)
        if near is not None and np.abs((state.coordinates - near.at) / self.spread).max() > self.near:
            near = None
        chunks = [range(k, min(k + _CHUNK, len(self.frames))) for k in range(0, len(self.frames), _CHUNK)]
        found: list[_Tangent] = []
        rows: list[NDArray[np.float32]] = []
        moved: tuple[int, Pictures, float] | None = None
        # One parameter after the other: fine pictures have tables of hundreds of megabytes.
        wanted = [None, *(self._shown if shared and near is None else [])]
        for m, chunk in progress([(m, chunk) for m in wanted for chunk in chunks], "simulating frames"):
            if m is None:
                found += self._tangents(chunk, state, pictures)
                rows += [self._steady(found[n].light.size, shared) for n in chunk]
                continue
            if moved is None or moved[0] != m:
                moved = None  # Frees its tables before there are new ones.
                moved = (m, *self._neighbour(state.coordinates, m))
            _, beside, step = moved
            for n, made in zip(chunk, self._beside(beside, [state.poses[n] for n in chunk]), strict=True):
                scale = state.poses[n].power / self.scene.illumination.power
                rows[n][m] = (scale * made.ravel() - found[n].light) * (self.spread[m] / step)
        if near is not None and shared:
            rows = [one.rows for one in near.frames]
        frames = [self._frame(n, state, pictures, one, rows[n], doubt) for n, one in enumerate(found)]
        at = state.coordinates if near is None else near.at
        return _reduced(state, frames, len(self.parameters) if shared else 0, at, doubt)

    def left(self, linear: Linear, state: State) -> float:
        """Return the objective at another state, with the weights of `linear`."""
        pictures = self.pictures(state.coordinates)
        total = 0.0
        for chunk in (range(k, min(k + _CHUNK, len(self.frames))) for k in range(0, len(self.frames), _CHUNK)):
            poses = [state.poses[n] for n in chunk]
            made = None if pictures.period is not None else pictures.render_each(poses)
            for at, n in enumerate(chunk):
                search, pose = self.search(self.frames[n], pictures), state.poses[n]
                if made is None:
                    mean, _ = search.tangent(pose, state.slow[n], self.names(pictures)[:4])
                else:
                    mean = (pose.background + pose.power / self.scene.illumination.power * made[at]).ravel()
                rest = search.residual(self.model(mean)[0])
                total += float(linear.frames[n].noise(rest, rest)[0, 0]) + linear.doubt * self._prior(n, state)[0]
        return total

    def _steady(self, size: int, shared: bool) -> NDArray[np.float32]:
        """Return derivatives [P, size] by the shared parameters, if wanted: those that take no picture, else 0."""
        rows = np.zeros((len(self.parameters) if shared else 0, size), np.float32)
        for m in range(len(rows)):
            if self.parameters[m].name == "background":
                rows[m] = self.spread[m]
        return rows

    def _neighbour(self, coordinates: Array, number: int) -> tuple[Pictures, float]:
        """Return the pictures a step away along a parameter, and the step."""
        one, own = self.parameters[number], self.pictures(coordinates)
        step = one.step * one.spread
        # Steps stay within the range.
        if coordinates[number] + step > one.most:
            step = -step
        beside = coordinates.copy()
        beside[number] += step
        scene = placed(self.scene, [self.parameters[m] for m in self._shown], beside[self._shown].tolist())
        return Pictures(scene, self.side, self.accuracy, torch.complex128, like=own), step

    def _beside(self, pictures: Pictures, poses: list[Pose]) -> Array:
        target = pictures.scene.target
        own = {"object_distance": target.object_distance, "focal_length": target.lens.focal_length}
        return pictures.render_each([replace(pose, **own) for pose in poses])

    def _tangents(self, chunk: Sequence[int], state: State, pictures: Pictures) -> list[_Tangent]:
        """Return the frames' mean electrons, and their derivatives by the nuisances."""
        names, poses = self.names(pictures), [state.poses[n] for n in chunk]
        searches = [self.search(self.frames[n], pictures) for n in chunk]
        images: list[Array | None] = [None] * len(poses)
        # Pictures with a roll and without are not rendered together: then each frame makes its own.
        if len({pose.roll != 0 for pose in poses}) == 1:
            gazes = np.stack([one.gazes(pose, names) for one, pose in zip(searches, poses, strict=True)])
            pairs = zip(poses, gazes, strict=True)
            made = pictures.render_each(
                [replace(pose, gaze=(float(x), float(y))) for pose, own in pairs for x, y in own]
            )
            images = list(made.reshape(*gazes.shape[:2], *made.shape[1:]))
        found: list[_Tangent] = []
        for n, search, pose, own in zip(chunk, searches, poses, images, strict=True):
            slow = state.slow[n]
            mean, slopes = search.tangent(pose, slow, names, own)
            # The picture at the pose itself: without the slow gaze's part, which the neighbours do not have either.
            light = mean - pose.background - (slow @ slopes[:2] if pictures.period is not None else 0.0)
            found.append(_Tangent(mean, slopes, light))
        return found

    def _frame(
        self,
        n: int,
        state: State,
        pictures: Pictures,
        tangent: _Tangent,
        rows: NDArray[np.float32],
        doubt: float,
    ) -> _Frame:
        pose, search = state.poses[n], self.search(self.frames[n], pictures)
        expected, bend, variance = self.model(tangent.mean)
        bent = np.concatenate([rows, tangent.slopes]) * bend
        noise, rest = search.noise(bend, variance), search.residual(expected)
        matrix, score = noise(bent, bent), noise(bent, rest)[:, 0]
        priors, *told = self._prior(n, state, self.names(pictures), len(rows))
        lit = tangent.mean - pose.background > 3 * np.sqrt(variance) / max(float(bend.max()), 1e-12)
        each = rest[0] ** 2 / variance
        squares = float(noise(rest, rest)[0, 0])
        own = float(each[lit].sum()), int(lit.sum())
        size = tangent.mean.size
        return _Frame(rows, (matrix, score), (told[0], told[1]), noise, squares, priors, doubt, size, *own)

    def _prior(self, n: int, state: State, names: tuple[str, ...] = (), shared: int = 0) -> tuple[float, Array, Array]:
        """Return the squares of the priors, their information and their score: label, brightness, roll."""
        size = shared + len(names)
        matrix, score = np.zeros((size, size)), np.zeros(size)
        pose, frame = state.poses[n], self.frames[n]
        off = frame.gaze - (np.array(pose.gaze) + state.slow[n])
        squares = float(np.square(off / frame.deviation).sum())
        free = self.value("power", state.coordinates)
        power = self.scene.illumination.power if free is None else free
        wide = self.scatter * power
        squares += ((pose.power - power) / wide) ** 2
        if self.roll:
            squares += (pose.roll / _ROLL) ** 2
        if names:
            for axis in (0, 1):
                matrix[shared + axis, shared + axis] = 1 / frame.deviation[axis] ** 2
                score[shared + axis] = off[axis] / frame.deviation[axis] ** 2
            k = shared + names.index("power")
            matrix[k, k] = 1 / wide**2
            score[k] = (power - pose.power) / wide**2
            if shared and free is not None:
                m = next(m for m, one in enumerate(self.parameters) if one.name == "power")
                size_of = self.spread[m]
                matrix[m, m] = (size_of / wide) ** 2
                matrix[m, k] = matrix[k, m] = -size_of / wide**2
                score[m] = size_of * (pose.power - power) / wide**2
            if self.roll:
                k = shared + names.index("roll")
                matrix[k, k] = 1 / _ROLL**2
                score[k] = -pose.roll / _ROLL**2
        return squares, matrix, score

    def stepped(self, linear: Linear, step: Array) -> State:
        """Return the state after a step of the shared parameters, in spreads, with each frame's best own step."""
        state, shared = linear.state, len(step)
        coordinates = state.coordinates
        if shared:
            moved = coordinates + step * self.spread
            coordinates = np.array([one.clipped(at) for one, at in zip(self.parameters, moved, strict=True)])
            step = (coordinates - state.coordinates) / self.spread
        pictures = self.pictures(state.coordinates)
        names = self.names(pictures)
        poses: list[Pose] = []
        slow = np.zeros_like(state.slow)
        for n, one in enumerate(linear.frames):
            matrix = one.matrix
            own = one.score[shared:] - matrix[shared:, :shared] @ step
            change = _inverse(matrix[shared:, shared:]) @ own
            search = self.search(self.frames[n], pictures)
            pose, slow[n] = search.moved(state.poses[n], state.slow[n], names, change)
            poses.append(pose)
        return self.moved(State(coordinates, tuple(poses), slow), coordinates)

    def own_information(self, linear: Linear, n: int) -> tuple[Array, Array]:
        """Return one frame's information [P, P] and score [P] on the shared parameters, nuisances eliminated."""
        return _eliminated(linear.frames[n], len(linear.score))


def by_labels(normal: Normal, linear: Linear) -> Array:
    """Return the score [2, P] of an offset along x and along y, of 1 of the field, that all labels have in common."""
    shared = len(linear.score)
    found = np.zeros((2, shared))
    for frame, one in zip(normal.frames, linear.frames, strict=True):
        matrix = one.matrix
        inverse, cross = _inverse(matrix[shared:, shared:]), matrix[:shared, shared:]
        # The gaze comes first among a frame's nuisances.
        found -= ((cross @ inverse)[:, :2] * (one.doubt / frame.deviation**2)).T
    return found


def by_parameters(linear: Linear) -> Array:
    """Return the derivatives [N, 2, P] of the gaze that is read from each frame alone by the shared parameters.

    The frame's own place, brightness and, where photosites show, phase are unknown too, and it has no label.
    """
    shared = len(linear.score)
    found = np.zeros((len(linear.frames), 2, shared))
    for n, one in enumerate(linear.frames):
        matrix = one.pixels_told[0]
        # The gaze comes first among a frame's nuisances.
        found[n] = -(_inverse(matrix[shared:, shared:]) @ matrix[shared:, :shared])[:2]
    return found


def _reduced(state: State, frames: list[_Frame], shared: int, at: Array, doubt: float) -> Linear:
    information, score = np.zeros((shared, shared)), np.zeros(shared)
    for one in frames:
        matrix, push = _eliminated(one, shared)
        information, score = information + matrix, score + push
    return Linear(state, information, score, tuple(frames), at, doubt)


def _eliminated(one: _Frame, shared: int) -> tuple[Array, Array]:
    matrix, score = one.matrix, one.score
    inverse, cross = _inverse(matrix[shared:, shared:]), matrix[:shared, shared:]
    information = matrix[:shared, :shared] - cross @ inverse @ cross.T
    return information, score[:shared] - cross @ inverse @ score[shared:]


def _inverse(matrix: Array) -> Array:
    """Return the inverse of a positive matrix whose rows have different units."""
    own = np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    return np.linalg.pinv(matrix / np.outer(own, own), rcond=1e-11, hermitian=True) / np.outer(own, own)
