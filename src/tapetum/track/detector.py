"""Finding retro-reflections in a whole frame of the probe.

A spot may be an Airy pattern five pixels wide or a saturated, ringed beam of several hundred; it may have lobes and
fringes, and reflections of reflections beside it. Each becomes one detection: light is sought at two scales, the
brightest place first, and everything within the reach of a spot's second moments belongs to it.

`Detector` is the interface that tracking uses, `SpotDetector` its implementation for a dark bench; that for a room is
in `cameras`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from inspect import signature
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tapetum.blas import one_blas_thread
from tapetum.data.crop import find_centre
from tapetum.errors import InputError
from tapetum.record.source import Frame
from tapetum.track.cameras import CameraDetector
from tapetum.track.detections import Detections
from tapetum.track.ghosts import Ghost
from tapetum.track.spots import make_maps, search
from tapetum.track.tracker import Tracker

__all__ = ["DETECTORS", "LARGEST_FRAME", "Detector", "SpotDetector", "detect"]

LARGEST_FRAME = 2**27
"""Most pixels of a frame: where light is everywhere the search keeps some forty bytes for each, here 5 GB."""
# Heights of stray light over those of the frame's brightest spot, and of rings over their own spot's.
_STRAY, _RINGS = 0.03, 0.07
# The same of light that touches a brighter spot: lobes of a defocused retro-reflection reach 0.12 of its height.
_LOBES = 0.2


def _ghosts(spots: dict[str, NDArray[Any]], ratio: float, radius: float, floor: float) -> NDArray[np.bool_]:
    """Return which spots accompany a brighter one. Spots come brightest first."""
    x, y, peak = spots["x"], spots["y"], spots["peak"]
    # A saturated spot's true height is unknown: its ghost may be twice as bright.
    limit = ratio * peak * np.where(spots["saturated"] > 0, 2.0, 1.0)
    stray = peak < floor * peak[0]
    # Of a spot, all for which it may be the brighter one.
    dims = (np.hypot(x[:, None] - x, y[:, None] - y) <= radius) & (peak < limit[:, None])
    ghost = np.zeros(len(x), dtype=bool)
    for n in range(1, len(x)):
        ghost[n] = stray[n] or (dims[:n, n] & ~ghost[:n]).any()
    return ghost


def _halos(spots: dict[str, NDArray[Any]], stray: float) -> NDArray[np.bool_]:
    """Return which spots are stray light close around a brighter one, or a lobe that touches it."""
    x, y, peak, size = (spots[name] for name in ("x", "y", "peak", "diameter"))
    away = np.hypot(x[:, None] - x, y[:, None] - y)
    near = (away <= 3 * size) & (peak[:, None] < stray * peak)
    # A lobe is no smaller than the spot that it belongs to: a second camera close by mostly is.
    touching = (away <= 0.6 * (size[:, None] + size)) & (size[:, None] > size)
    return np.asarray((near | (touching & (peak[:, None] < _LOBES * peak))).any(1))


def detect(
    image: NDArray[np.generic],
    *,
    full_scale: float | None = None,
    min_snr: float = 7.0,
    max_count: int = 100,
    ghosts: str = "drop",
    ghost_ratio: float = 0.25,
    ghost_radius: float | None = None,
    stray: float | None = None,
    largest: float | None = None,
    known_ghost: Ghost | None = None,
) -> Detections:
    """Find the retro-reflections in a frame.

    A quick look at a reduced frame finds the parts that may hold light (see `tapetum.track.screen`); only these are
    looked at closely. The background is a surface of the fourth order fitted from below, the noise comes from
    differences of neighbours, and single hot pixels are replaced. Light above the noise at 1.5 or 6 px of smoothing is
    a spot; its centroid and size come from the second moments within 1.5 times its own diameter (ISO 11146-1 with a
    narrower aperture), and everything within it, lobes, fringes, inner rings, is part of it.

    A probe's beam splitter gives every retro-reflection a dim companion at a fixed offset, and bright light causes
    stray reflections in lenses. A spot is a *ghost* when a brighter one within `ghost_radius` outshines it by more than
    1/`ghost_ratio` (half as much where the brighter one is saturated), or when it has less than `stray` of the height
    of the brightest spot of the frame. A second camera that near and that much dimmer is therefore taken for a ghost;
    set ``ghosts="mark"`` to see them all.

    Parameters
    ----------
    image
        [H, W], uint8, uint16 or float, grey.
    full_scale
        Value at which a pixel is saturated; default: the type's largest (none for float).
    min_snr
        Smallest height of a spot over the noise, after smoothing. Noise alone reaches 6 in one frame of some hundreds.
    max_count
        Most spots to return; the brightest are kept.
    ghosts
        "drop" leaves ghosts out, "mark" returns them with ``ghost`` set.
    ghost_ratio
        Largest height of a ghost, as a fraction of the spot it belongs to. 0: there are no ghosts nearby.
    ghost_radius
        Largest distance of a ghost in pixels; default: 0.35 of the frame's diagonal.
    stray
        Height, as a fraction of the brightest spot's, below which light anywhere is stray. 0: never; default: 0.03.
    largest
        Largest diameter of a spot in pixels. Wider ones, such as walls and blurred lamps, are removed before ghosts are
        sought. None: no limit.
    known_ghost
        Of this probe's beam splitter, calibrated: then only spots at its offset and ratio are ghosts, `ghost_ratio` and
        `ghost_radius` do not apply, and `stray`, 0.07 by default for the rings of a defocused beam, does only within
        three diameters of a brighter spot.

    Returns
    -------
    Detections
        Brightest first; always finite.

    Raises
    ------
    InputError
        When the image is not a grey picture of finite values, or an option is out of range.

    Examples
    --------
    >>> image = np.zeros((48, 64), np.uint8)
    >>> image[20:25, 30:35] = 200
    >>> found = detect(image)
    >>> len(found), round(float(found.x[0])), round(float(found.y[0]))
    (1, 32, 22)
    """
    array = _checked(image)
    if not min_snr > 0:
        raise InputError(f"must be positive, is {min_snr}", where="min_snr", remedy="7 is usual")
    if max_count < 1:
        raise InputError(f"must be at least 1, is {max_count}", where="max_count")
    if ghosts not in ("drop", "mark"):
        raise InputError(f"unknown value {ghosts!r}", where="ghosts", remedy="use one of drop, mark")
    if stray is None:
        stray = _STRAY if known_ghost is None else _RINGS
    if not (0 <= ghost_ratio <= 1 and 0 <= stray <= 1):
        raise InputError(f"must lie in 0...1, are {ghost_ratio}, {stray}", where="ghost_ratio, stray")
    if largest is not None and not largest > 0:
        raise InputError(f"must be positive, is {largest}", where="largest", remedy="give a diameter in pixels")
    whole = array.dtype.kind in "iu"
    for name, value in (("full_scale", full_scale), ("ghost_radius", ghost_radius)):
        if value is not None and not value > 0:
            raise InputError(f"must be positive, is {value}", where=name, remedy="leave it out for the usual one")
    if full_scale is None:
        full_scale = float(np.iinfo(array.dtype).max) if whole else math.inf
    limit = math.inf if largest is None else largest
    with one_blas_thread():
        maps = make_maps(array, 1.0 if whole else 1e-6 * max(float(np.ptp(array)), 1e-30), min_snr)
        found = [one for one in search(maps, array, full_scale, min_snr, max_count, limit) if one.diameter <= limit]
    if not found:
        return Detections.empty()

    measured = ("x", "y", "peak", "diameter", "snr", "area", "saturated", "edge")
    spots = {name: np.array([getattr(spot, name) for spot in found]) for name in measured}
    radius = 0.35 * math.hypot(*array.shape) if ghost_radius is None else ghost_radius
    if known_ghost is None:
        spots["ghost"] = _ghosts(spots, ghost_ratio, radius, stray)
    else:
        columns = (spots[name] for name in ("x", "y", "peak", "saturated", "diameter"))
        spots["ghost"] = known_ghost.among(*columns) | _halos(spots, stray)
    if ghosts == "drop":
        spots = {name: values[~spots["ghost"]] for name, values in spots.items()}
    reach = np.maximum(4.0, 0.75 * spots["diameter"])
    near = zip(spots["x"].tolist(), spots["y"].tolist(), reach.tolist(), strict=True)
    with one_blas_thread():
        centres = np.array([find_centre(array, near=one) for one in near]).reshape(-1, 2)
    return Detections.of({**spots, "peak_x": centres[:, 0], "peak_y": centres[:, 1]})


def _checked(image: NDArray[np.generic]) -> NDArray[Any]:
    array = np.asarray(image)
    if array.size > LARGEST_FRAME:
        what = f"{' x '.join(map(str, array.shape[::-1]))} pixels are more than can be searched at once"
        remedy = f"cut it into parts of at most {LARGEST_FRAME // 10**6} megapixels"
        raise InputError(what, where="image", remedy=remedy)
    if array.ndim != 2 or min(array.shape) < 8:
        raise InputError(f"expected a grey image [H, W] of at least 8 x 8, got shape {array.shape}", where="image")
    if array.dtype in (np.uint8, np.uint16):
        return array
    if array.dtype.kind not in "iuf":
        what = f"images of type {array.dtype} are not grey levels"
        raise InputError(what, where="image", remedy="give uint8, uint16 or float")
    if not np.isfinite(array).all():
        what = "the image holds values that are not finite"
        raise InputError(what, where="image", remedy="replace NaN and infinite pixels")
    return array.astype(np.float32)


class Detector(Protocol):
    """What tracking asks of a detector: the spots of each frame. It gets the frames of a source in order, each once.

    It may have a method `tracker()`, which returns the `Tracker` that suits it, and an attribute `usual_largest`, the
    largest diameter of a spot that it looks for by default, in pixels. A thread of its own may call it.
    """

    def __call__(self, frame: Frame, /) -> Detections: ...


class SpotDetector:
    """Applies `detect` to every frame separately; InputError for options that `detect` does not have.

    A frame's own full scale applies where none is given.
    """

    def __init__(self, **options: Any) -> None:
        known = sorted(set(signature(detect).parameters) - {"image"})
        if unknown := sorted(set(options) - set(known)):
            remedy = f"use {', '.join(known)}"
            raise InputError(f"unknown option {', '.join(unknown)}", where="detect_options", remedy=remedy)
        self.options = options

    def tracker(self) -> Tracker:
        """Return a tracker; where the ghost is known it needs no guard of its own against ghosts.

        A spot is numbered then once it was seen in two of three frames: single lobes and pieces of ghosts are not.
        """
        return Tracker() if self.options.get("known_ghost") is None else Tracker(ghost_ratio=0.0, persist=(2, 3))

    def __call__(self, frame: Frame, /) -> Detections:
        return detect(frame.image, **{"full_scale": frame.full_scale, **self.options})


DETECTORS: dict[str, Callable[..., Detector]] = {"spots": SpotDetector, "cameras": CameraDetector}
"""Detectors by name, made with the options that a person gives: "spots" of a dark bench, "cameras" of a room.

To add one, write a class that is a `Detector` in a file of its own, and name it here.
"""
