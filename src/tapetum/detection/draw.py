"""What was found, drawn into the frame."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.detection.found import Found
from tapetum.errors import InputError
from tapetum.files import atomic_file

__all__ = ["draw_found"]

_LIKELY, _UNSURE = (80, 220, 255), (200, 160, 80)


def draw_found(image: NDArray[np.generic], found: Found, path: Path) -> None:
    """Write a frame [H, W] or [H, W, 3] as PNG with a ring and the probability, in percent, at each candidate.

    Rings of candidates more likely than not are thick and yellow, the others thin and blue.
    """
    levels = np.asarray(image, dtype=np.float32)
    top = 255.0 if image.dtype == np.uint8 else float(max(levels.max(), 1))
    grey = np.clip(levels * (255 / top), 0, 255).astype(np.uint8)
    canvas = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR if grey.ndim == 2 else cv2.COLOR_RGB2BGR)
    scale = max(1.0, min(canvas.shape[:2]) / 700)
    for x, y, diameter, probability in zip(found.x, found.y, found.diameter, found.probability, strict=True):
        likely = probability > 0.5
        colour, thick = (_LIKELY, round(2 * scale)) if likely else (_UNSURE, max(1, round(scale)))
        radius = round(max(8 * scale, 1.2 * diameter))
        cv2.circle(canvas, (round(x), round(y)), radius, colour, thick, cv2.LINE_AA)
        place = (round(x) + radius + 2, round(y) - radius // 2)
        text = f"{100 * probability:.0f}"
        cv2.putText(
            canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45 * scale, colour, max(1, thick // 2), cv2.LINE_AA
        )
    with atomic_file(path) as part:
        written, data = cv2.imencode(".png", canvas)
        if not written:
            raise InputError("cannot be written", where=path, remedy="give another name")
        part.write_bytes(data.tobytes())
