"""Guesses from names and values: meaning of a column, unit of gaze, depth of images."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.data.crop import find_centre
from tapetum.data.importing.columns import Reader, numbers
from tapetum.data.importing.mapping import Column
from tapetum.errors import InputError

__all__ = ["WORDS", "constants", "depth", "key", "looks_centred", "meaning", "unit"]

WORDS = {
    "gaze_x": ("gazex", "gx", "x", "spotx", "laserx", "targetx", "posx", "xpx", "labelx", "theta"),
    "gaze_y": ("gazey", "gy", "y", "spoty", "lasery", "targety", "posy", "ypx", "labely", "phi"),
    "gaze": ("gaze", "xy", "labels", "label", "targets", "target", "positions", "position", "spot", "laser", "angles"),
    "object_distance": ("objectdistance", "xd", "distance", "focusdistance", "focus", "depth"),
    "focal_length": ("focallength", "ft", "focal", "f"),
    "device": ("device", "phone", "model", "phonemodel", "camera", "class"),
    "recording": ("recording", "video", "clip", "session", "sequence", "videoid", "take"),
    "order": ("frame", "index", "frameindex", "framenumber", "order", "idx"),
    "time": ("time", "timestamp", "t", "seconds"),
    "split": ("split", "subset", "partition", "set"),
    "names": ("file", "filename", "image", "imagefile", "img", "path", "name"),
}
"""Usual names of columns, without case and punctuation; the first match counts."""

_NOISE = re.compile(
    r"(images?|imgs?|frames?|crops?|rrs?|probe|labels?|targets?|gaze|positions?|xy|data|timestamps?|times?|[-_. ])",
    re.IGNORECASE,
)
_SCALES = (255, 1023, 4095, 16383, 65535)


def meaning(name: str) -> str | None:
    """Return the probable meaning of a column or array by its name: a key of `WORDS`."""
    plain = re.sub(r"[^a-z0-9]", "", PurePosixPath(name).name.casefold())
    return next((what for what, words in WORDS.items() if plain in words), None)


def key(path: str) -> str:
    """Return the common part of the names of related files: the name without words such as images and labels."""
    return _NOISE.sub("", PurePosixPath(path).stem).casefold()


def constants(path: str) -> dict[str, str]:
    """Return focal length and object distance from a path such as `50mm/3.5m.mp4`."""
    plain = path.replace("_", " ")
    focal = re.search(r"(\d+(?:\.\d+)?) ?mm(?![a-z])", plain, re.IGNORECASE)
    distance = re.search(r"(\d+(?:\.\d+)?) ?m(?![a-z0-9])", plain, re.IGNORECASE)
    found = {"object_distance": distance and f"{distance[1]} m", "focal_length": focal and f"{focal[1]} mm"}
    return {name: value for name, value in found.items() if value}


def unit(name: str, column: dict[str, Any], reader: Reader, count: int) -> tuple[dict[str, Any], str]:
    """Guess a label's unit from its values; return what to add to the column, and a note."""
    try:
        values = numbers(reader.values(Column(**column), count), str(column))
    except InputError:
        values = np.empty(0)
    if not np.isfinite(values).any():
        return {}, "unit unknown"
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if not name.startswith("gaze"):
        # Focal lengths above 1.5 m and object distances above 100 m must be in millimetres.
        length = "mm" if high > (1.5 if name == "focal_length" else 100) else "m"
        return {"unit": length}, f"up to {high:.4g}: taken as {length}"
    span = f"{low:.3g} to {high:.3g}: taken as"
    if -0.75 <= low < 0 and high <= 0.75:
        return {}, f"{span} fractions of the field from its centre"
    if low >= 0 and high <= 1:
        return {"origin": "corner"}, f"{span} fractions of the field from its upper left corner"
    return {"unit": "px", "size": None}, f"{span} pixels; write the target frame's size in place of null"


def depth(sample: Sequence[NDArray[Any]]) -> int:
    """Return the smallest usual full scale that holds the largest count of some images."""
    high = max((float(picture.max()) for picture in sample), default=0.0)
    if all(picture.dtype.kind == "f" for picture in sample) and high <= 1:
        return 1
    return next((scale for scale in _SCALES if high <= scale), 65535)


def looks_centred(sample: Sequence[NDArray[Any]]) -> bool:
    """Return whether images are square, with the brightest point of most in their middle."""
    if any(picture.shape[0] != picture.shape[1] for picture in sample):
        return False

    def near(picture: NDArray[Any]) -> bool:
        x, y = find_centre(picture)
        off = np.hypot(x - (picture.shape[1] - 1) / 2, y - (picture.shape[0] - 1) / 2)
        return bool(off < 0.12 * min(picture.shape))

    return bool(sample) and float(np.mean([near(picture) for picture in sample])) > 0.8
