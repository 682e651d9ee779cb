"""What `tapetum detect` finds of drawn cameras and what it takes for one: by their height, size and surroundings.

    python scripts/measure_detection.py [FIRST [COUNT]]

Writes docs/numbers/detection.json and docs/images/detection-limits.png, or with -o a file and a picture of its name.
Scenes are those of drawn_scenes.py, COUNT seeds of each of the twelve kinds from FIRST on with four cameras, and six
times as many from FIRST + 1000 on with none; a seed that anything was chosen or fitted on is no measurement. Cameras on
what is overexposed, which cannot be seen, are left out.

A camera's height is given over the sensor's noise alone, and over what surrounds it as well: the standard deviation
within 20 pixels of the registered difference of the same scene without cameras, over √2, as two frames' noise adds.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure

from drawn_scenes import KINDS, Drawn, draw
from tapetum.detection import Found, find_cameras
from tapetum.detection.registration import register
from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.progress import bar

RATES = (0.01, 0.1, 1.0)
EMPTY = 6
"""How many times as many scenes there are without cameras."""
PLAIN = ("noise", "shade", "hot pixels", "room")
"""Kinds of little clutter; the others move, repeat or shine."""
HEIGHTS, DIAMETERS = (4.0, 8.0, 16.0, 32.0, 64.0), (2.4, 4.0, 8.0, 16.0)
SEEN = 8.0
"""From this height on, over the noise or over what surrounds it, a camera is one that should be found."""
WAYS: tuple[str, ...] = ("pair", "frame")
NUMBERS, PICTURE = (
    Path(__file__).parents[1] / "docs" / name for name in ("numbers/detection.json", "images/detection-limits.png")
)


@dataclass(frozen=True)
class Camera:
    """A drawn camera, and the false alarms a frame that it costs to find it, by a pair and by the lit frame alone."""

    kind: str
    snr: float
    around: float
    diameter: float
    cost: dict[str, float]


def found_in(scene: Drawn, way: str) -> Found:
    return find_cameras(scene.lit, scene.dark if way == "pair" else None, false_alarms=math.inf, swaps=False)


def cameras(kind: str, seed: int) -> list[Camera]:
    scene = draw(kind, seed, cameras=4, snr=(HEIGHTS[0], HEIGHTS[-1]), tape=False)
    same = draw(kind, seed, tape=False)  # the same scene: what comes later is drawn later
    empty = cv2.medianBlur(same.lit, 5)
    try:
        left = same.lit - register(same.lit, same.dark).dark.astype(np.float32)
        found = {way: found_in(scene, way) for way in WAYS}
    except InputError as error:
        # In a pair that is refused nothing is found; what surrounds its cameras is not known.
        print(f"{kind} {seed}: {error}", file=sys.stderr)
        left, found = None, {"frame": found_in(scene, "frame")}
    listed = []
    for (x, y), sigma, height, snr in zip(scene.places, scene.sigma, scene.height, scene.snr, strict=True):
        if empty[round(y), round(x)] > 245:
            continue
        cost: dict[str, float] = dict.fromkeys(WAYS, math.inf)
        for way, one in found.items():
            near = np.hypot(one.x - x, one.y - y) <= max(2.5, 1.6 * sigma)
            cost[way] = float(one.false_alarms[near].min(initial=math.inf))
        around = math.nan
        if left is not None:
            near = left[max(0, int(y) - 20) : int(y) + 21, max(0, int(x) - 20) : int(x) + 21]
            around = float(height / max(near.std() / math.sqrt(2), 1e-3))
        listed.append(Camera(kind, float(snr), around, 4 * float(sigma), cost))
    return listed


def alarms(kind: str, seed: int, tape: bool) -> dict[str, list[int]]:
    scene, told = draw(kind, seed, tape=tape), {}
    for way in WAYS:
        try:
            costs = found_in(scene, way).false_alarms
        except InputError as error:
            # What is refused does not alarm; that it was is said.
            print(f"{kind} {seed}: {error}", file=sys.stderr)
            costs = np.empty(0)
        told[way] = [int((costs <= rate).sum()) for rate in RATES]
    return told


def recall(listed: list[Camera], way: str) -> list[float]:
    return [float(np.mean([one.cost[way] <= rate for one in listed])) if listed else math.nan for rate in RATES]


def row(name: str, listed: list[Camera]) -> dict[str, Any]:
    """Return the share of some cameras that is found at each rate, in a pair and in the lit frame alone."""
    return {"name": name, "cameras": len(listed), **{way: recall(listed, way) for way in WAYS}}


def alarm_row(name: str, told: list[dict[str, list[int]]]) -> dict[str, Any]:
    """Return the alarms a scene of some scenes at each rate."""
    return {
        "name": name,
        "scenes": len(told),
        **{way: np.mean([one[way] for one in told], axis=0).tolist() for way in WAYS},
    }


def drawn(listed: list[Camera]) -> Figure:
    """Recall at 0.1 false alarms a frame against height, for sizes and clutter."""
    figure = Figure(figsize=(7.2, 2.8), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    middles = np.sqrt(np.array(HEIGHTS[1:]) * HEIGHTS[:-1])

    def curve(ax, chosen: list[Camera], name: str, way: str = "pair", style: str = "-") -> None:
        shares = []
        for low, high in pairwise(HEIGHTS):
            own = [one for one in chosen if low <= one.snr < high]
            shares.append(recall(own, way)[1])
        ax.plot(middles, shares, style, marker="o", markersize=3, label=name)

    for low, high in pairwise(DIAMETERS):
        curve(axes[0], [one for one in listed if low <= one.diameter < high], f"{low:g} to {high:g} px wide")
    for plain, name in ((True, "plain"), (False, "cluttered")):
        own = [one for one in listed if (one.kind in PLAIN) == plain]
        curve(axes[1], own, f"{name}, pair")
        curve(axes[1], own, f"{name}, one frame", "frame", "--")
    for ax in axes:
        ax.set_xscale("log", base=2)
        ax.set_xticks(middles, [f"{one:.0f}" for one in middles])
        ax.set_xlabel("height over the noise")
        ax.legend(fontsize=7, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
        ax.set_ylim(0, 1.03)
    axes[0].set_ylabel("found at 0.1 false alarms a frame")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int, nargs="?", default=88000, help="seed of the first scene of each kind")
    parser.add_argument("count", type=int, nargs="?", default=20, help="scenes of each kind")
    parser.add_argument("-o", "--out", type=Path, default=NUMBERS)
    options = parser.parse_args()
    first, count = options.first, options.count
    seeds = range(first, first + count)
    listed = [
        one for kind in KINDS for seed in bar(seeds, f"cameras in {kind}", total=count) for one in cameras(kind, seed)
    ]
    seen = [one for one in listed if one.snr >= SEEN]

    def between(values: tuple[float, ...], of: str, chosen: list[Camera]) -> list[dict[str, Any]]:
        told = []
        for low, high in pairwise(values):
            name = f"{low:g} to {high:g}" if math.isfinite(high) else f"more than {low:g}"
            told.append(row(name, [one for one in chosen if low <= getattr(one, of) < high]))
        return told

    many = range(first + 1000, first + 1000 + EMPTY * count)
    empty = {
        kind: [alarms(kind, seed, False) for seed in bar(many, f"empty {kind}", total=len(many))] for kind in KINDS
    }
    tape = [alarms(kind, seed, True) for kind in KINDS for seed in bar(seeds, f"tape, {kind}", total=count)]
    numbers = {
        "refused": sum(math.isnan(one.around) for one in listed),
        "first": first,
        "count": count,
        "rates": RATES,
        "by_height": between(HEIGHTS, "snr", listed),
        "by_diameter": between(DIAMETERS, "diameter", seen),
        "by_kind": [row(kind, [one for one in seen if one.kind == kind]) for kind in KINDS],
        "seen": row("all", seen),
        "by_surroundings": between((8.0, 16.0, 32.0, math.inf), "around", listed),
        "clear": row("all", [one for one in listed if one.around >= SEEN]),
        "alarms_by_kind": [alarm_row(kind, told) for kind, told in empty.items()],
        "alarms": alarm_row("all", [one for told in empty.values() for one in told]),
        "alarms_with_tape": alarm_row("a strip of tape in every fifth", tape),
    }
    with atomic_file(options.out) as part:
        part.write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    picture = PICTURE if options.out == NUMBERS else options.out.with_suffix(".png")
    drawn(listed).savefig(picture, dpi=150)


if __name__ == "__main__":
    main()
