"""Results as plain JSON values, with pictures as PNG."""

from __future__ import annotations

import base64
import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from tapetum.bench import Scene, lens_names, scene_names, scene_yaml
from tapetum.live.playground.core import Limit, Result
from tapetum.live.playground.rays import Drawing
from tapetum.live.playground.settings import SETTINGS, limits_of_lens, settings_of

__all__ = ["described", "limit_json", "result_json"]

_HELD = 0.98
"""Share of the light that the part of the picture shown at first holds."""
_LEAST = 12


def described() -> dict[str, Any]:
    """The settings, the scenes to begin with, and what each catalogue lens offers."""
    from tapetum.bench import load_scene

    lenses: dict[str, Any] = {}
    for name in lens_names():
        states, number = limits_of_lens(name)
        lenses[name] = {"focal_length": [states[0] * 1e3, states[-1] * 1e3], "f_number": number}
    return {
        "settings": [{**vars(one), "choices": list(one.choices)} for one in SETTINGS],
        "scenes": {name: settings_of(load_scene(name)) for name in scene_names()},
        "lenses": lenses,
    }


def result_json(scene: Scene, result: Result) -> dict[str, Any]:
    """What the page draws; numbers that are not finite are None."""
    image = result.image.numpy()[0]
    sensor, known = scene.probe.sensor, result.image.metadata
    # A page shows eight bits.
    frame = (result.frame >> max(0, sensor.bits - 8)).astype(np.uint8)
    peak = float(image.max())
    return _finite(
        {
            # A thin lens in place of another is not the scene that was asked for.
            "settings": {} if result.draft == "thin lens" else settings_of(scene),
            "yaml": "" if result.draft == "thin lens" else scene_yaml(scene),
            "image": _png(np.round(255 * np.sqrt(np.clip(image, 0, None) / (peak or 1.0))).astype(np.uint8)),
            "frame": _png(frame),
            "width": image.shape[1],
            "height": image.shape[0],
            "pitch": sensor.pitch,
            "half": _half(image),
            "peak": peak,
            "brightest": int(result.frame.max()),
            "top": 2**sensor.bits - 1,
            "budget": _rows(result.budget.lines()),
            "powers": _powers(result),
            "snr": result.budget.snr,
            "saturation": result.budget.saturation,
            "eye": {"class": result.eye.as_dict()["laser_class"], "rows": [list(one) for one in result.eye.rows()]},
            "notice": result.eye.as_dict()["notice"],
            "rays": _drawn(result.rays),
            "error": known["expected_error"],
            "propagation": known["propagation"],
            "draft": result.draft,
            "prepared": result.prepared,
            "milliseconds": result.seconds * 1e3,
        }
    )


def limit_json(limit: Limit) -> dict[str, Any]:
    """Limits by parameter, in SI units."""
    found = limit.found
    return _finite(
        {
            "bounds": dict(found.bounds) if found else {},
            "alone": dict(found.alone) if found else {},
            "units": dict(found.units) if found else {},
            "left_out": limit.left_out,
            "milliseconds": limit.seconds * 1e3,
        }
    )


def _powers(result: Result) -> list[list[Any]]:
    budget = result.budget
    return [
        ["laser", budget.laser_watts],
        ["into target", budget.accepted_watts],
        ["reflected", budget.reflected_watts],
        ["leaves target", budget.leaving_watts],
        ["enters probe", budget.probe_watts],
        ["on sensor", budget.sensor_watts],
    ]


def _rows(lines: list[str]) -> list[list[str]]:
    return [[line[:18].strip(), line[18:].strip()] for line in lines]


def _drawn(rays: Drawing) -> dict[str, Any]:
    def points(lines: tuple[Any, ...]) -> list[list[list[float]]]:
        return [[[float(f"{z:.6g}"), float(f"{y:.6g}")] for z, y in line] for line in lines]

    return {
        "in": points(rays.rays_in),
        "back": points(rays.rays_back),
        "glass": points(rays.glass),
        "sensor": points((rays.sensor,))[0],
        "stop": points((rays.stop,))[0],
        "notes": list(rays.notes),
    }


def _half(image: npt.NDArray[np.float64]) -> int:
    """Half the side of the smallest square about the middle that holds most of the light, in steps of a quarter."""
    rows, columns = image.shape
    most, total = max(rows, columns) // 2, float(image.sum())
    half = _LEAST
    while half < most:
        top, left = max(0, rows // 2 - half), max(0, columns // 2 - half)
        if float(image[top : rows // 2 + half, left : columns // 2 + half].sum()) >= _HELD * total:
            break
        half = math.ceil(half * 1.25)
    return min(math.ceil(half * 1.25), most)


def _png(pixels: npt.NDArray[np.uint8]) -> str:
    _, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode()


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
