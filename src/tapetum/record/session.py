"""Settings of a take on the virtual bench."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from typing import Any

from tapetum.bench import Target
from tapetum.errors import InputError, number, whole
from tapetum.record.beats import CameraClock
from tapetum.record.clutter import Clutter
from tapetum.record.imaging import Imaging
from tapetum.record.laser import BlinkCode, Exposure
from tapetum.record.motion import HandMotion, ProbeShake
from tapetum.record.stray import Stray

__all__ = ["Placed", "Session"]

# Generous limits in seconds and frames per second, those of `tapetum record`.
_LONGEST, _FASTEST = 1e6, 1e5


@dataclass(frozen=True)
class Placed:
    """A further target before the same probe.

    Parameters
    ----------
    offset
        Of its place from the first one's, along x and y in the probe's image, in metres at the target.
    target, distance
        The target and its distance from the probe, in metres; None for those of the first one.
    motion, seed
        How it is held; its seed is combined with the session's and its number among the others.
    """

    offset: tuple[float, float]
    target: Target | None = None
    distance: float | None = None
    motion: HandMotion = field(default_factory=HandMotion)
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", _seed(self.seed))


def _seed(value: int) -> int:
    """Return a seed as the int that a recording keeps; raises an InputError."""
    return whole(value, "seed", "give 0 or more", least=0, most=2**63 - 1)


def _untriggered() -> CameraClock:
    """Clock of a video camera without a trigger: its frames lag by any part of an interval, its rate is off by up to
    a thousandth (as 29.97 of 30 Hz), and its rows are read one after another, as in most phones (assumed: 15 ms)."""
    return CameraClock(offset=None, drift=-3e-5, rate_error=1e-3, readout=0.015)


@dataclass(frozen=True)
class Session:
    """Length of a take, motion of the target, clocks, light, and other objects in the image.

    Parameters
    ----------
    seconds, rate, start
        Length, frames per second of both cameras, and UTC of the beginning.
    target_rate
        Frames per second of the target's camera; None for the probe's.
    seed
        Of everything random. The same scene, session and seed give the same frames.
    motion
        How the target is held.
    probe_clock, target_clock, exposure, target_exposure
        The two cameras' clocks, and their exposures over time.
    laser, code
        Whether the target sees the probe's laser, and its blink code; None for constant light.
    power_jitter
        Relative RMS of the laser's power from frame to frame.
    shake
        How the probe is held; None for one that stands. Its stray light, which its own lens spreads, stays.
    imaging
        When the first target images; None for always as its scene says.
    stray, clutter
        Additional light in the probe's frame, the sensor's fixed pattern included, and objects that are not cameras.
    others
        Further targets. Labels are the first one's: only its camera films.
    """

    seconds: float = 60.0
    rate: float = 15.0
    seed: int = 0
    motion: HandMotion = field(default_factory=HandMotion)
    probe_clock: CameraClock = field(default_factory=CameraClock)
    target_clock: CameraClock = field(default_factory=_untriggered)
    start: datetime = datetime(2026, 1, 1, tzinfo=UTC)
    laser: bool = True
    code: BlinkCode | None = None
    power_jitter: float = 0.0
    shake: ProbeShake | None = None
    imaging: Imaging | None = None
    exposure: Exposure = field(default_factory=Exposure)
    target_exposure: Exposure = field(default_factory=Exposure)
    stray: tuple[Stray, ...] = ()
    clutter: tuple[Clutter, ...] = ()
    others: tuple[Placed, ...] = ()
    target_rate: float | None = None

    def __post_init__(self) -> None:
        if self.target_rate is not None and not 0 < self.target_rate <= 1000:
            what = f"must lie above 0 and up to 1000 Hz, is {self.target_rate}"
            raise InputError(what, where="target_rate", remedy="give frames per second")
        seconds = number(self.seconds, "seconds", "give a length", above=0, most=_LONGEST)
        rate = number(self.rate, "rate", "give frames per second", above=0, most=_FASTEST)
        for name, value in (("seconds", seconds), ("rate", rate), ("seed", _seed(self.seed))):
            object.__setattr__(self, name, value)
        if not 0 <= self.power_jitter < 0.3:
            what = f"must lie from 0 to 0.3, is {self.power_jitter}"
            raise InputError(what, where="power_jitter", remedy="give the laser's noise in parts of one")

    @property
    def frames(self) -> int:
        """Nominal frames of each camera; raises an InputError when there are none."""
        count = round(self.seconds * self.rate)
        if count < 1:
            raise InputError(f"{self.seconds:g} s hold no frame", where="seconds", remedy="film longer")
        return count

    @property
    def start_ns(self) -> int:
        """UTC of the beginning in nanoseconds since 1970, to the second."""
        return int(self.start.timestamp()) * 10**9

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for a recording; None for absent parts."""
        return {
            "seed": self.seed,
            "seconds": self.seconds,
            "motion": self.motion.as_dict(),
            "clocks": {"probe": asdict(self.probe_clock), "target": asdict(self.target_clock)},
            "laser": {
                "seen_by_target": self.laser,
                "power_jitter": self.power_jitter,
                "code": self.code and {**asdict(self.code), "word": list(self.code.sent)},
            },
            "shake": self.shake and asdict(self.shake),
            "imaging": self.imaging and asdict(self.imaging),
            "exposure": {"probe": asdict(self.exposure), "target": asdict(self.target_exposure)},
            "stray": [_named(one) for one in self.stray],
            "clutter": [_named(one) for one in self.clutter],
        }


def _named(one: Any) -> dict[str, Any]:
    return {"kind": type(one).__name__.lower(), **asdict(one)}
