"""Cameras that are plugged into this machine, with their modes."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Any

import cv2

from tapetum.record.genicam import find_genicam
from tapetum.record.images import hushed
from tapetum.record.v4l2 import Device, card_of, modes_of, v4l2_devices

__all__ = ["Plugged", "look_for_cameras"]

_TRIED = 5  # numbers that are tried where the system has no list


@dataclass(frozen=True)
class Plugged:
    """A camera: what to write for it, its name, and its modes (form, width, height, bits, frames a second)."""

    source: str
    name: str
    modes: tuple[dict[str, Any], ...] = ()
    note: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {"source": self.source, "name": self.name, "modes": list(self.modes), "note": self.note}


@dataclass
class _Search:
    """Cameras found, and what was not searched or could not be read."""

    cameras: list[Plugged] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def look_for_cameras() -> tuple[list[Plugged], list[str]]:
    """Return the cameras of this machine, and notes on what could not be searched or read."""
    search = _Search()
    if sys.platform.startswith("linux"):
        for path in v4l2_devices():
            _look_at(path, search)
    else:
        _try_numbers(search)
    found = find_genicam()
    if found is None:
        search.notes.append("GenICam was not searched: neither Aravis nor Harvesters is installed (extra: cameras)")
    for ident, name, forms in found or ():
        modes = tuple({"form": form, "bits": _bits(form)} for form in forms)
        search.cameras.append(Plugged(f"genicam:{ident}", name, modes))
    return search.cameras, search.notes


def _bits(form: str) -> int | None:
    from tapetum.record.pixels import FORMATS

    return FORMATS[form].bits if form in FORMATS else None


def _look_at(path: str, search: _Search) -> None:
    """Add a device of Linux, unless it gives no frames (as the second one of most webcams)."""
    number = path.removeprefix("/dev/video")
    try:
        device = Device(path)
    except OSError as error:
        search.notes.append(f"{path} cannot be opened ({error.strerror}); are you in the group video?")
        return
    try:
        card = card_of(device)
        if card is None:
            return
        modes = modes_of(device)
    except OSError as error:
        search.notes.append(f"{path} does not answer ({error.strerror})")
        return
    finally:
        device.close()
    told = tuple(
        {"form": mode.code, "width": mode.width, "height": mode.height, "bits": mode.bits, "rates": list(mode.rates)}
        for mode in modes
    )
    colour = any(mode.bits is None for mode in modes)
    if any(mode.bits is not None for mode in modes):
        note = f"camera:{number} reads its colour forms as 8 bit grey" if colour else ""
        search.cameras.append(Plugged(f"v4l2:{number}", card[0], told, note))
    else:
        search.cameras.append(Plugged(f"camera:{number}", card[0], told, "colour becomes grey, 8 bit"))


def _try_numbers(search: _Search) -> None:
    """Open the first few numbers by OpenCV, where the system offers no list."""
    for number in range(_TRIED):
        with hushed():
            capture = cv2.VideoCapture(number)
            if capture.isOpened():
                size = {"width": int(capture.get(3)), "height": int(capture.get(4)), "bits": 8}
                search.cameras.append(Plugged(f"camera:{number}", capture.getBackendName(), (size,)))
            capture.release()
    search.notes.append(f"beyond camera:{_TRIED - 1} nothing was tried")
