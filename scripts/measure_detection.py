"""What `tapetum detect` finds of drawn cameras and what it takes for one: by their height, size and surroundings.

    python scripts/measure_detection.py [FIRST [COUNT]]

Prints two tables, and writes docs/images/detection-limits.png. Scenes are those of drawn_scenes.py, COUNT seeds of each
of the twelve kinds from FIRST on, once with four cameras and once with none; a seed that anything was chosen or
fitted on is no measurement. Cameras on what is overexposed, which cannot be seen, are left out.
"""

from __future__ import annotations

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

RATES = (0.01, 0.1, 1.0)
PLAIN = ("noise", "shade", "hot pixels", "room")
"""Kinds of little clutter; the others move, repeat or shine."""
HEIGHTS, DIAMETERS = (4.0, 8.0, 16.0, 32.0, 64.0), (2.4, 4.0, 8.0, 16.0)
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "detection-limits.png"


@dataclass(frozen=True)
class Camera:
    """A drawn camera, and the false alarms a frame that it costs to find it, by a pair and by the lit frame alone."""

    kind: str
    snr: float
    diameter: float
    cost: dict[str, float]


def found_in(scene: Drawn, way: str) -> Found:
    return find_cameras(scene.lit, scene.dark if way == "pair" else None, false_alarms=math.inf, swaps=False)


def cameras(kind: str, seed: int) -> list[Camera]:
    scene = draw(kind, seed, cameras=4, snr=(HEIGHTS[0], HEIGHTS[-1]), tape=False)
    empty = cv2.medianBlur(draw(kind, seed, tape=False).lit, 5)  # the same scene: what comes later is drawn later
    found = {way: found_in(scene, way) for way in ("pair", "frame")}
    listed = []
    for (x, y), sigma, snr in zip(scene.places, scene.sigma, scene.snr, strict=True):
        if empty[round(y), round(x)] > 245:
            continue
        cost = {}
        for way, one in found.items():
            near = np.hypot(one.x - x, one.y - y) <= max(2.5, 1.6 * sigma)
            cost[way] = float(one.false_alarms[near].min(initial=math.inf))
        listed.append(Camera(kind, float(snr), 4 * float(sigma), cost))
    return listed


def alarms(kind: str, seed: int, tape: bool) -> dict[str, list[int]]:
    scene = draw(kind, seed, tape=tape)
    return {
        way: [int((found_in(scene, way).false_alarms <= rate).sum()) for rate in RATES] for way in ("pair", "frame")
    }


def recall(listed: list[Camera], way: str) -> list[float]:
    return [float(np.mean([one.cost[way] <= rate for one in listed])) if listed else math.nan for rate in RATES]


def row(name: str, listed: list[Camera]) -> str:
    cells = [f"{share:.2f}" for way in ("pair", "frame") for share in recall(listed, way)]
    return f"| {name} | {len(listed)} | {' | '.join(cells)} |"


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
        ax.legend(fontsize=7, frameon=False)
        ax.set_ylim(0, 1.03)
    axes[0].set_ylabel("found at 0.1 false alarms a frame")
    return figure


def main() -> None:
    first, count = (int(one) for one in (sys.argv[1:] + ["71000", "20"][len(sys.argv) - 1 :])[:2])
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
    print(row("all, 8 and more", seen), flush=True)
    drawn(listed).savefig(PICTURE, dpi=150)
    print("\n| empty scenes | pair 0.01 | 0.1 | 1 | frame 0.01 | 0.1 | 1 |\n|---|---|---|---|---|---|---|")
    for tape in (False, True):
        told = [alarms(kind, seed, tape) for kind in KINDS for seed in seeds]
        cells = [
            f"{np.mean([one[way][n] for one in told]):.3g}" for way in ("pair", "frame") for n in range(len(RATES))
        ]
        name = "a strip of tape in every fifth" if tape else "no tape"
        print(f"| {len(told)}, {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
