"""The choice of a set of probes: a linear program over all places, aims and angles, reduced to few probes."""

# SciPy types its solvers in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import isotonic_regression, linprog

from tapetum.bench import Target
from tapetum.errors import InputError
from tapetum.simulate.constellation.light import irradiance, paraxial_reach, signal
from tapetum.simulate.constellation.room import Array, Constellation, Point, ProbeKit, Rail, Volume, between, whole

__all__ = ["Design", "design", "single_probe"]


@dataclass(frozen=True)
class Design:
    """A constellation and how far it is from constant: illumination and SNR² were fitted to 1 ± `deviation`.

    The deviation of the illumination is taken over cones narrower and wider by the margin. It therefore also bounds
    points that near a sample and aims that far off, up to the change of the range.
    """

    constellation: Constellation
    deviation: float
    candidates: int


def design(
    volume: Volume,
    target: Target,
    kit: ProbeKit,
    rail: Rail,
    *,
    cap: float,
    probes: int = 32,
    divergences: Sequence[float] = (0.35, 0.52, 0.79, 1.05, 1.4),
    aims: tuple[int, int] = (5, 10),
    samples: int = 500,
    margin: float = 0.4,
    snr_weight: float = 1.0,
    seed: int = 0,
) -> Design:
    """Choose number, places, aims, divergences and powers of probes so that illumination and SNR are even.

    Candidates are all mounts × aims × divergences. In their powers p ≥ 0 the illumination at the samples is linear, A
    p, and a linear program finds the p that minimises δ in 1 - δ ≤ A p ≤ 1 + δ; this minimises the ratio of the largest
    to the smallest, (1 + δ)/(1 - δ). The cones' edges are sharp, so the lower bound takes them narrower by `margin` and
    the upper bound wider. SNR² = Σ g²p²/(gp + B) joins as Σ w p with w = g·S/(S + B) of the last solution, M -
    2δ/weight ≤ Σ w p ≤ M + 2δ/weight around a free level M. Re-weighted least sums (Candès, Wakin and Boyd, J. Fourier
    Anal. Appl. 14, 877 (2008)) then reduce the solution to few probes; the strongest are spread along the rail by the
    least shifts that keep its spacing, and their powers are solved for again.

    Parameters
    ----------
    volume, target, kit, rail
        Where cameras are, what they are, what probes are made of and where they may stand.
    cap
        Largest illumination at the samples, and at twenty times as many other points, in W/m².
    probes
        Largest number of probes.
    divergences
        Full angles to choose from, in radians.
    aims
        Points to aim at, across and in depth, at the volume's middle height.
    samples, margin
        Number of points that represent the volume, and the distance (metres) that cones' edges keep from them.
    snr_weight
        Weight of the SNR: 0 leaves it free, 1 bounds it like the illumination.
    seed
        Of the samples.

    Raises
    ------
    InputError
        When an argument is out of range, or no choice of these candidates lights every sample and the points between.
    """
    between("cap", cap, 0, math.inf)
    between("margin", margin, 0, math.inf, low_too=True)
    between("snr_weight", snr_weight, 0, math.inf, low_too=True)
    for name, value in (("probes", probes), ("aims", min(aims)), ("samples", samples)):
        whole(name, value)
    if (probes - 1) * rail.spacing > rail.length:
        raise InputError(
            f"{probes} do not fit on {rail.length:g} m", where="probes", remedy="take fewer or a longer rail"
        )
    points = volume.sample(samples, seed)
    across, deep = np.meshgrid(*((np.arange(n) + 0.5) / n for n in aims))
    goals = volume.place(np.stack([across.ravel(), np.full(across.size, 0.5), deep.ravel()], axis=1))
    along = (np.arange(rail.mounts) + 0.5) / rail.mounts * rail.length
    choices = [(t, goal, angle) for t in along.tolist() for goal in goals for angle in divergences]
    tried = kit.constellation([kit.probe(rail.at([t])[0], goal, angle) for t, goal, angle in choices])
    problem = _Problem(tried, target, volume, points, margin, snr_weight, cap)
    power, deviation = problem.solve(np.arange(len(choices)))
    _lights_all(deviation, len(choices))
    power = problem.thin(power, deviation)
    chosen = np.flatnonzero(power > 1e-6 * power.max())
    chosen = chosen[np.argsort(-power[chosen])][:probes]
    # Neighbours on the rail keep their order, ties broken by where they aim.
    chosen = chosen[np.lexsort([[choices[i][1][0] for i in chosen], [choices[i][0] for i in chosen]])]
    steps = rail.spacing * np.arange(len(chosen))
    wanted = np.array([choices[i][0] for i in chosen])
    places = np.clip(isotonic_regression(wanted - steps).x, 0.0, max(rail.length - steps[-1], 0.0)) + steps
    spots = rail.at(places)
    built = [kit.probe(spot, choices[i][1], choices[i][2]) for spot, i in zip(spots, chosen, strict=True)]
    final = _Problem(kit.constellation(built), target, volume, points, margin, snr_weight, cap)
    power, deviation = final.solve(np.arange(len(built)))
    _lights_all(deviation, len(built))
    power = final.capped(power)
    dense = irradiance(final.probes, volume.sample(20 * samples, seed + 1)) @ power
    if not (dense > 0).all():
        raise InputError(
            f"{(dense == 0).mean():.2g} of the volume is dark between the samples",
            where="design",
            remedy="take more samples or a wider margin",
        )
    power = power * min(1.0, cap / float(dense.max()))
    lit = [replace(probe, power=float(p)) for probe, p in zip(built, power, strict=True) if p > 1e-6 * power.max()]
    return Design(kit.constellation(lit), deviation, len(choices))


def single_probe(volume: Volume, kit: ProbeKit, position: Point, *, cap: float, seed: int = 0) -> Constellation:
    """The baseline: one diverging probe whose narrowest cone holds the volume and whose peak there is `cap` (W/m²).

    Raises
    ------
    InputError
        When the volume spans 90° or more from there.
    """
    corners = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0]), axis=-1).reshape(-1, 3)
    rays = volume.place(corners) - np.asarray(position)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    axis = rays.mean(axis=0)
    # Badoiu and Clarkson's iteration for the centre of the smallest ball: a step of 1/n towards the farthest.
    for step in range(2, 2000):
        axis += (rays[np.argmin(rays @ axis)] - axis) / step
    axis /= np.linalg.norm(axis)
    half = math.acos(float(np.clip((rays @ axis).min(), -1.0, 1.0)))
    if half >= math.pi / 4:
        raise InputError("sees the volume under 90° or more", where="position", remedy="step back")
    one = kit.constellation([kit.probe(position, np.asarray(position) + axis, min(2 * half + 1e-6, 1.57))])
    points = np.concatenate([volume.place(corners), volume.sample(4000, seed)])
    return one.scaled(cap / float(irradiance(one, points).sum(axis=1).max()))


def _lights_all(deviation: float, count: int) -> None:
    if deviation >= 0.999:
        raise InputError(
            f"{count} probes of these angles leave a part of the volume dark",
            where="design",
            remedy="allow more probes, more aims or wider divergences",
        )


class _Problem:
    """The linear program over the powers of fixed probes of 1 W each."""

    def __init__(
        self,
        probes: Constellation,
        target: Target,
        volume: Volume,
        points: Array,
        margin: float,
        snr_weight: float,
        cap: float,
    ) -> None:
        self.probes, self.cap, self.weight = probes, cap, snr_weight
        # Scaled to about 1: the solver's tolerances are absolute.
        self.low = irradiance(probes, points, margin=-margin)
        self.high = irradiance(probes, points, margin=margin)
        self.unit = float(self.high.max()) or 1.0
        self.low, self.high = self.low / self.unit, self.high / self.unit
        paraxial_reach(probes, target, points)
        # The links take longest, and an SNR of weight 0 does not need them.
        self._seen = functools.cache(lambda: signal(probes, target, points, volume.facing(points)))

    def capped(self, power: Array) -> Array:
        """Powers in watts at which the largest illumination, with the wider cones, is the cap."""
        return power * (self.cap / (self.unit * float((self.high @ power).max())))

    def solve(self, chosen: npt.NDArray[np.intp], rounds: int = 3) -> tuple[Array, float]:
        """Relative powers of the `chosen` (zero elsewhere) and the deviation δ."""
        power, deviation = self._even(chosen, None)
        if self.weight > 0 and deviation < 0.999:
            for _ in range(rounds):
                power, deviation = self._even(chosen, self._rows(power))
        return power, deviation

    def thin(self, power: Array, deviation: float, slack: float = 0.03, rounds: int = 4) -> Array:
        """Powers of fewer probes, whose deviation is at most `slack` more."""
        rows = self._rows(power) if self.weight > 0 else None
        matrix, bound, columns = self._constraints(np.arange(len(power)), rows)
        bound = bound - matrix[:, columns] * (deviation + slack)
        matrix = matrix[:, :columns]
        weight = np.ones(columns)
        # The free level M has no cost.
        weight[len(power) :] = 0
        for _ in range(rounds):
            found = linprog(weight, A_ub=matrix, b_ub=bound, method="highs").x
            if found is None:
                return power
            power = found[: self.low.shape[1]]
            weight[: len(power)] = 1 / (power / power.max() + 0.01)
        return power

    def _even(self, chosen: npt.NDArray[np.intp], rows: Array | None) -> tuple[Array, float]:
        matrix, bound, columns = self._constraints(chosen, rows)
        cost = np.zeros(columns + 1)
        cost[-1] = 1
        found = linprog(cost, A_ub=matrix, b_ub=bound, method="highs")
        if found.x is None or found.x[-1] >= 0.999:
            return np.zeros(self.low.shape[1]), 1.0
        power = np.zeros(self.low.shape[1])
        power[chosen] = found.x[: len(chosen)]
        return power, float(found.x[-1])

    def _constraints(self, chosen: npt.NDArray[np.intp], rows: Array | None) -> tuple[Array, Array, int]:
        """Unknowns: powers, M where the SNR counts, δ. Returns matrix, bound, and the number of unknowns before δ."""
        ones = np.ones((len(self.low), 1))
        zeros = [] if rows is None else [0 * ones]
        light = [np.hstack([self.high[:, chosen], *zeros, -ones]), np.hstack([-self.low[:, chosen], *zeros, -ones])]
        bound = [ones[:, 0], -ones[:, 0]]
        if rows is not None:
            part = rows[:, chosen]
            light += [np.hstack([part, -ones, -2 / self.weight * ones])]
            light += [np.hstack([-part, ones, -2 / self.weight * ones])]
            # M between a half and twice the last level; otherwise darkness would count as even.
            free = np.zeros((2, light[0].shape[1]))
            free[:, -2] = 1, -1
            light.append(free)
            bound += [0 * ones[:, 0], 0 * ones[:, 0], np.array([2.0, -0.5])]
        return np.vstack(light), np.concatenate(bound), len(chosen) + len(zeros)

    def _rows(self, power: Array) -> Array:
        """SNR² per relative power of each probe, its own noise as at `power`; of mean 1 there."""
        watts = self.capped(power)
        # Probes without power count as if they had the median power of the others.
        usual = float(np.median(watts[watts > 1e-6 * watts.max()]))
        seen = self._seen()
        counts = seen.electrons * np.where(watts > 1e-6 * watts.max(), watts, usual)
        rows = seen.electrons * counts / (counts + seen.noise)
        return rows / float((rows @ power).mean())
