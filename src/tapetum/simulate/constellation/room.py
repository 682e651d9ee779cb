"""The room: probes and their kit, the rail that holds them, and the volume they light."""

# SciPy types its samplers in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.stats import qmc

from tapetum.bench import ProbeSensor
from tapetum.errors import InputError

__all__ = ["Array", "Constellation", "PlacedProbe", "Point", "ProbeKit", "Rail", "Volume", "between", "points_of"]
__all__ += ["whole"]

Array = npt.NDArray[np.float64]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class PlacedProbe:
    """A probe somewhere in the room; it sees the cone that it lights.

    Parameters
    ----------
    position
        In metres.
    direction
        Unit vector of the cone's axis.
    divergence
        Full angle of the cone, in radians, below π/2.
    power
        Of its laser, in watts.
    focal_length, aperture_radius
        Of its lens, in metres.
    transmission
        For power, on the way back.
    """

    position: Point
    direction: Point
    divergence: float
    power: float
    focal_length: float = 0.2
    aperture_radius: float = 0.0125
    transmission: float = 0.5

    def __post_init__(self) -> None:
        points_of([self.position], "probe.position")
        length = float(np.linalg.norm(points_of([self.direction], "probe.direction")[0]))
        if abs(length - 1) > 1e-6:
            raise InputError(f"has length {length:g}", where="probe.direction", remedy="give a unit vector")
        between("probe.divergence", self.divergence, 0, math.pi / 2)
        between("probe.power", self.power, 0, math.inf, low_too=True)
        between("probe.focal_length", self.focal_length, 0, math.inf)
        between("probe.aperture_radius", self.aperture_radius, 0, math.inf)
        between("probe.transmission", self.transmission, 0, 1, high_too=True)


@dataclass(frozen=True)
class Constellation:
    """Probes that work together, with equal sensors and lasers of one wavelength (metres)."""

    probes: tuple[PlacedProbe, ...]
    sensor: ProbeSensor
    wavelength: float = 640e-9

    def __post_init__(self) -> None:
        if not self.probes:
            raise InputError("has no probe", where="constellation.probes", remedy="give at least one")
        between("constellation.wavelength", self.wavelength, 200e-9, 2e-6)

    def scaled(self, factor: float) -> Constellation:
        """The same probes with `factor` times the power."""
        between("factor", factor, 0, math.inf)
        return replace(self, probes=tuple(replace(one, power=factor * one.power) for one in self.probes))


@dataclass(frozen=True)
class Volume:
    """A box, sheared upwards by the rake of the floor.

    Parameters
    ----------
    low, high
        Corners in metres; y is the height above the floor.
    rake
        Rise of the floor per metre of z, from `low`'s z on.
    look_at
        Where its cameras point, in metres, or None for cameras that turn to whichever probe looks at them.
    """

    low: Point
    high: Point
    rake: float = 0.0
    look_at: Point | None = None

    def __post_init__(self) -> None:
        low, high = points_of([self.low], "volume.low")[0], points_of([self.high], "volume.high")[0]
        if not (low < high).all():
            raise InputError(f"{self.high} is not above {self.low}", where="volume.high", remedy="swap or widen")
        between("volume.rake", self.rake, -2, 2, low_too=True, high_too=True)
        if self.look_at is not None:
            points_of([self.look_at], "volume.look_at")

    def place(self, fractions: npt.ArrayLike) -> Array:
        """Points [N, 3] in metres at `fractions` (0 to 1) of the box."""
        low = np.asarray(self.low)
        points = low + points_of(fractions, "fractions") * (np.asarray(self.high) - low)
        points[:, 1] += self.rake * (points[:, 2] - low[2])
        return points

    def sample(self, count: int, seed: int = 0) -> Array:
        """Points [count, 3], spread evenly (scrambled Halton sequence); the same seed gives the same."""
        whole("count", count)
        return self.place(qmc.Halton(3, rng=np.random.default_rng(seed)).random(count))

    def facing(self, points: npt.ArrayLike) -> Array | None:
        """Unit vectors [N, 3] from `points` to `look_at`; None where cameras turn to the probes."""
        if self.look_at is None:
            return None
        ray = np.asarray(self.look_at) - points_of(points, "points")
        return ray / np.linalg.norm(ray, axis=1, keepdims=True)


@dataclass(frozen=True)
class Rail:
    """The line on which probes may stand: its ends in metres, how many mounts are tried, and the least spacing."""

    start: Point
    end: Point
    mounts: int = 5
    spacing: float = 0.1

    def __post_init__(self) -> None:
        points_of([self.start, self.end], "rail")
        whole("rail.mounts", self.mounts)
        between("rail.spacing", self.spacing, 0, math.inf)
        if self.length <= 0:
            raise InputError("has no length", where="rail.end", remedy="give another end")

    @property
    def length(self) -> float:
        return math.dist(self.start, self.end)

    def at(self, along: npt.ArrayLike) -> Array:
        """Points [N, 3] at `along` [N] metres from the start."""
        along = np.asarray(along, dtype=np.float64)[:, None] / self.length
        return np.asarray(self.start) * (1 - along) + np.asarray(self.end) * along


@dataclass(frozen=True)
class ProbeKit:
    """The parts of a probe: the sensor, and a lens whose field is the cone.

    The shorter side of the sensor spans the cone, f = side/(2 tan(divergence/2)); the aperture is the largest that both
    `aperture_radius` (metres) and the smallest `f_number` allow. So a wide probe has a small aperture.
    """

    sensor: ProbeSensor
    wavelength: float = 640e-9
    aperture_radius: float = 0.0125
    f_number: float = 1.4
    transmission: float = 0.5

    def __post_init__(self) -> None:
        between("kit.aperture_radius", self.aperture_radius, 0, math.inf)
        between("kit.f_number", self.f_number, 0, math.inf)

    def probe(self, position: npt.ArrayLike, aim: npt.ArrayLike, divergence: float, power: float = 1.0) -> PlacedProbe:
        """A probe at `position` whose cone of full angle `divergence` points to `aim`."""
        between("divergence", divergence, 0, math.pi / 2)
        here, there = points_of(np.stack([np.asarray(position), np.asarray(aim)]), "position, aim")
        ray = there - here
        if not ray.any():
            raise InputError("is the probe's own position", where="aim", remedy="aim elsewhere")
        focal = min(self.sensor.pixels) * self.sensor.pitch / (2 * math.tan(divergence / 2))
        aperture = min(self.aperture_radius, focal / (2 * self.f_number))
        x, y, z = (ray / np.linalg.norm(ray)).tolist()
        px, py, pz = here.tolist()
        return PlacedProbe((px, py, pz), (x, y, z), divergence, power, focal, aperture, self.transmission)

    def constellation(self, probes: Sequence[PlacedProbe]) -> Constellation:
        """These probes with the kit's sensor and wavelength."""
        return Constellation(tuple(probes), self.sensor, self.wavelength)


def points_of(values: npt.ArrayLike, where: str) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1:] != (3,) or len(array) == 0:
        raise InputError(f"has shape {array.shape}", where=where, remedy="give [N, 3]")
    if not np.isfinite(array).all():
        raise InputError("is not finite", where=where, remedy="remove NaN and infinity")
    return array


def between(
    where: str, value: float, low: float, high: float, *, low_too: bool = False, high_too: bool = False
) -> None:
    above = value >= low if low_too else value > low
    below = value <= high if high_too else value < high
    # Infinity fails every bound, and NaN every comparison.
    if not (above and below and math.isfinite(value)):
        remedy = f"give one {'from' if low_too else 'above'} {low:g} {'to' if high_too else 'and below'} {high:g}"
        raise InputError(f"is {value:g}", where=where, remedy=remedy)


def whole(where: str, value: int) -> None:
    if value < 1:
        raise InputError(f"is {value}", where=where, remedy="give at least 1")
