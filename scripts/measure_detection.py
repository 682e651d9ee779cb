"""What `tapetum detect` finds of drawn cameras and what it takes for one: by their height, size and surroundings.

    python scripts/measure_detection.py [FIRST [COUNT]]

Prints two tables, and writes docs/images/detection-limits.png. Scenes are those of drawn_scenes.py, COUNT seeds of each
of the twelve kinds from FIRST on with four cameras, and six times as many from FIRST + 1000 on with none; a seed that
anything was chosen or fitted on is no measurement. Cameras on what is overexposed, which cannot be seen, are left out.

A camera's height is given over the sensor's noise alone, and over what surrounds it as well: the standard deviation
within 20 pixels of the registered difference of the same scene without cameras, over √2, as two frames' noise adds.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

from drawn_scenes import KINDS, Drawn, draw
from tapetum.detection import Found, find_cameras
from tapetum.detection.registration import register
from tapetum.errors import InputError

RATES = (0.01, 0.1, 1.0)
EMPTY = 6
"""How many times as many scenes there are without cameras."""
PLAIN = ("noise", "shade", "hot pixels", "room")
"""Kinds of little clutter; the others move, repeat or shine."""
HEIGHTS, DIAMETERS = (4.0, 8.0, 16.0, 32.0, 64.0), (2.4, 4.0, 8.0, 16.0)
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "detection-limits.png"


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
    empty, left = cv2.medianBlur(same.lit, 5), same.lit - register(same.lit, same.dark).dark.astype(np.float32)
    found = {way: found_in(scene, way) for way in ("pair", "frame")}
    listed = []
    for (x, y), sigma, height, snr in zip(scene.places, scene.sigma, scene.height, scene.snr, strict=True):
        if empty[round(y), round(x)] > 245:
            continue
        cost = {}
        for way, one in found.items():
            near = np.hypot(one.x - x, one.y - y) <= max(2.5, 1.6 * sigma)
            cost[way] = float(one.false_alarms[near].min(initial=math.inf))
        near = left[max(0, int(y) - 20) : int(y) + 21, max(0, int(x) - 20) : int(x) + 21]
        around = float(height / max(near.std() / math.sqrt(2), 1e-3))
        listed.append(Camera(kind, float(snr), around, 4 * float(sigma), cost))
    return listed


def alarms(kind: str, seed: int, tape: bool) -> dict[str, list[int]]:
    scene, told = draw(kind, seed, tape=tape), {}
    for way in ("pair", "frame"):
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


def row(name: str, listed: list[Camera]) -> str:
    cells = [f"{share:.2f}" for way in ("pair", "frame") for share in recall(listed, way)]
    return f"| {name} | {len(listed)} | {' | '.join(cells)} |"


def alarm_row(name: str, told: list[dict[str, list[int]]]) -> str:
    cells = [f"{np.mean([one[way][n] for one in told]):.3g}" for way in ("pair", "frame") for n in range(len(RATES))]
    return f"| {len(told)}, {name} | {' | '.join(cells)} |"


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
    parser.add_argument("first", type=int, nargs="?", default=71000, help="seed of the first scene of each kind")
    parser.add_argument("count", type=int, nargs="?", default=20, help="scenes of each kind")
    options = parser.parse_args()
    first, count = options.first, options.count
    seeds = range(first, first + count)
    listed = [one for kind in KINDS for seed in seeds for one in cameras(kind, seed)]
    print("| cameras | count | pair 0.01 | 0.1 | 1 | frame 0.01 | 0.1 | 1 |\n|---|---|---|---|---|---|---|---|")
    for low, high in pairwise(HEIGHTS):
        print(row(f"{low:g} to {high:g} times the noise", [one for one in listed if low <= one.snr < high]))
    seen = [one for one in listed if one.snr >= 8]
    for low, high in pairwise(DIAMETERS):
        print(row(f"{low:g} to {high:g} px, 8 and more", [one for one in seen if low <= one.diameter < high]))
    for kind in KINDS:
        print(row(f"{kind}, 8 and more", [one for one in seen if one.kind == kind]))
    print(row("all, 8 and more", seen))
    for low, high in pairwise((8.0, 16.0, 32.0, math.inf)):
        chosen = [one for one in listed if low <= one.around < high]
        print(row(f"{low:g} to {high:g} times what surrounds it", chosen))
    print(row("all, 8 and more times what surrounds it", [one for one in listed if one.around >= 8]), flush=True)
    drawn(listed).savefig(PICTURE, dpi=150)
    print("\n| empty scenes | pair 0.01 | 0.1 | 1 | frame 0.01 | 0.1 | 1 |\n|---|---|---|---|---|---|---|")
    many = range(first + 1000, first + 1000 + EMPTY * count)
    for tape, chosen in ((False, many), (True, seeds)):
        told = {kind: [alarms(kind, seed, tape) for seed in chosen] for kind in KINDS}
        for kind in KINDS if not tape else ():
            print(alarm_row(kind, told[kind]))
        everything = [one for kind in KINDS for one in told[kind]]
        print(alarm_row("a strip of tape in every fifth" if tape else "no tape", everything), flush=True)


if __name__ == "__main__":
    main()
