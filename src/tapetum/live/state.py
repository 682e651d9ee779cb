"""What a watch publishes: the state of each camera, and of itself."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

__all__ = ["CameraState", "Health", "State"]


@dataclass(frozen=True)
class CameraState:
    """A camera that is followed.

    Parameters
    ----------
    id
        Of its event, from its first to its last message.
    track
        Number of its track.
    x, y, diameter
        Place and diameter of its return in the probe's frame, in pixels.
    seen
        Whether it was seen in the latest lit frame.
    since_utc_ns, seen_utc_ns
        When it was first and last seen, UTC in nanoseconds since 1970.
    snr
        Signal-to-noise ratio of its return when it was last seen.
    active
        Whether it images; None where that is unknown.
    device, device_probability
        What it is taken for, and how likely that is; None without a model of devices.
    gaze_x, gaze_y
        Gaze as [value, low, high], in fractions of its field from the centre; None without a model, and where the
        model does not apply.
    regions
        Names of the regions of its field that the probe stands in.
    estimated_utc_ns
        When the frame was taken that device and gaze are of: with many cameras models see each by turns. None without
        a model.
    opened_utc_ns
        When a shutter last opened on its sensor, of a camera that was idle; None where that was not seen.
    """

    id: str
    track: int
    x: float
    y: float
    diameter: float
    seen: bool
    since_utc_ns: int
    seen_utc_ns: int
    snr: float | None = None
    active: bool | None = None
    device: str | None = None
    device_probability: float | None = None
    gaze_x: tuple[float, float, float] | None = None
    gaze_y: tuple[float, float, float] | None = None
    regions: tuple[str, ...] = ()
    estimated_utc_ns: int | None = None
    opened_utc_ns: int | None = None

    def is_fresh(self, utc_ns: int) -> bool:
        """Return whether its gaze is of the frame that was taken then, and not of an earlier one."""
        return self.seen_utc_ns == utc_ns and self.estimated_utc_ns in (None, utc_ns)


@dataclass(frozen=True)
class Health:
    """The state of the watch: frames a second, seconds from a frame to its result, counts, and faults.

    `receivers` has an entry for each receiver that lost messages: how many, and why.
    """

    rate: float = 0.0
    delay: float = 0.0
    frames: int = 0
    lost: int = 0
    refused: int = 0
    connected: bool = False
    ended: bool = False
    fault: str = ""
    receivers: tuple[str, ...] = ()


@dataclass(frozen=True)
class State:
    """A moment of the watch.

    Parameters
    ----------
    source, frame, utc_ns
        Name of the source, number of the frame, and when it was taken, UTC in nanoseconds since 1970.
    size
        Width and height of the frame, in pixels.
    cameras, health
        The cameras that were reported, and the state of the watch.
    monotonic_ns, camera_time
        When the frame was taken by this machine's monotonic clock, in nanoseconds, and by the source's own, in seconds
        since it was opened; None where that is not known.
    """

    source: str
    frame: int
    utc_ns: int
    size: tuple[int, int]
    cameras: tuple[CameraState, ...]
    health: Health
    monotonic_ns: int | None = None
    camera_time: float | None = None

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)
