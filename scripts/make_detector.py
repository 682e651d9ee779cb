"""Fits the weights of the detector (src/tapetum/detection/weights.json) to labelled lit and dark frames.

    python scripts/make_detector.py FOLDER

The folder holds pictures and `labels.json`: `pairs`, each with `scene`, `lit`, `dark` (file names), `points` and
`unsure` (x, y in the lit frame; what is unsure counts neither way) and `tolerance` (pixels). Frames of one scene are
near copies: scenes weigh the same, and what is printed is cross-validated by scene. Each dark frame is also shaken, as
by a hand: turned, shifted and bent at random.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from sklearn.linear_model import LogisticRegression

from tapetum.detection.find import candidates_with_looks
from tapetum.detection.looks import OF_A_FRAME, OF_A_PAIR
from tapetum.files import atomic_file

OUT = Path(__file__).parents[1] / "src" / "tapetum" / "detection" / "weights.json"
RATES = (0.1, 0.5, 1.0, 10.0)
SHAKES = 2
STRENGTH = 0.3
# One frame alone: six scenes are too few to fit weights (chosen on five, they fail on the sixth), so each of these
# looks counts the same, by the sign that optics gives it; only the scale and the offset of their sum are fitted.
OF_ONE_FRAME = {"isolation": 1.0, "alone": 1.0, "elongation": -1.0}


@dataclass(frozen=True)
class Case:
    """A labelled frame: its candidates [N, 2], their looks [N, features], and which are cameras or neither."""

    scene: str
    places: np.ndarray
    looks: np.ndarray
    camera: np.ndarray
    counted: np.ndarray
    glints: int
    shaken: bool = False


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        sys.exit(f"error: {path}: is no picture")
    return image if image.ndim == 2 else image.mean(2).round().astype(np.uint8)


def shake(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The frame as from a hand that moved: up to 30 px of shift, a degree, a percent, 3 px of parallax."""
    h, w = image.shape
    turn = cv2.getRotationMatrix2D((w / 2, h / 2), rng.normal(0, 1.0), 1 + rng.normal(0, 0.01))
    turn[:, 2] += rng.uniform(-30, 30, 2)
    bend = cv2.resize(rng.normal(0, 3, (5, 5, 2)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
    y, x = np.mgrid[:h, :w].astype(np.float32)
    from_x, from_y = (turn[n, 0] * x + turn[n, 1] * y + turn[n, 2] + bend[..., n] for n in (0, 1))
    return cv2.remap(image, np.float32(from_x), np.float32(from_y), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def case(pair: dict, lit: np.ndarray, dark: np.ndarray | None, shaken: bool = False) -> Case:
    table, looks = candidates_with_looks(lit, dark)
    places = np.stack([table["x"], table["y"]], 1)
    camera, counted = np.zeros(len(places), bool), np.ones(len(places), bool)
    for kind, reach in (("points", pair["tolerance"]), ("unsure", 14)):
        for point in pair[kind]:
            near = np.flatnonzero(np.hypot(*(places - point).T) <= reach)
            counted[near] = False
            if kind == "points" and len(near):
                camera[near[np.argmax(table["snr"][near])]] = True
    return Case(pair["scene"], places, looks, camera, counted | camera, len(pair["points"]), shaken)


def fit(cases: list[Case]) -> LogisticRegression:
    per_scene = defaultdict(int)
    for one in cases:
        per_scene[one.scene] += 1
    weights = np.concatenate([np.full(one.counted.sum(), 1 / per_scene[one.scene]) for one in cases])
    looks = np.vstack([one.looks[one.counted] for one in cases])
    camera = np.concatenate([one.camera[one.counted] for one in cases])
    return LogisticRegression(C=STRENGTH, max_iter=5000).fit(looks, camera, weights)


def fixed(cases: list[Case]) -> tuple[np.ndarray, float]:
    """Weights and offset for one frame alone: signs and ratios are given, the scale is fitted."""
    signs = np.array([OF_ONE_FRAME.get(name, 0.0) for name in OF_A_FRAME])
    model = fit([replace(one, looks=(one.looks @ signs)[:, None]) for one in cases])
    return signs * model.coef_[0, 0], float(model.intercept_[0])


def crossed(cases: list[Case]) -> list[np.ndarray]:
    """Log odds of every case's candidates by weights fitted to the other scenes."""
    odds: dict[str, LogisticRegression] = {}
    for scene in sorted({one.scene for one in cases}):
        odds[scene] = fit([one for one in cases if one.scene != scene])
    return [odds[one.scene].decision_function(one.looks) for one in cases]


def judged(cases: list[Case], scores: list[np.ndarray]) -> tuple[dict[float, float], tuple[float, float]]:
    """Recall averaged over scenes at rates of false alarms, and a, b of alarms = exp(a - b score)."""
    scenes = sorted({one.scene for one in cases})
    hits, false, glints, frames = defaultdict(list), defaultdict(list), defaultdict(int), defaultdict(int)
    for one, score in zip(cases, scores, strict=True):
        hits[one.scene] += score[one.camera].tolist()
        false[one.scene] += score[one.counted & ~one.camera].tolist()
        glints[one.scene] += one.glints
        frames[one.scene] += 1
    levels = np.unique(np.concatenate([false[scene] for scene in scenes]))[::-1]
    rates = np.mean([[(np.array(false[s]) >= level).sum() / frames[s] for level in levels] for s in scenes], 0)
    recall = {}
    for rate in RATES:
        over = np.flatnonzero(rates > rate)
        least = levels[over[0]] if len(over) else -np.inf
        recall[rate] = float(np.mean([(np.array(hits[s]) > least).sum() / glints[s] for s in scenes]))
    tail = (rates >= 0.03) & (rates <= 3)
    slope, at = np.polyfit(levels[tail], np.log(rates[tail]), 1)
    return recall, (float(at), float(-slope))


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: python scripts/make_detector.py FOLDER")
    folder = Path(sys.argv[1])
    pairs = json.loads((folder / "labels.json").read_text())["pairs"]
    rng, known = np.random.default_rng(1), {}
    for kind in ("pair", "frame"):
        cases: list[Case] = []
        seen: set[str] = set()
        for pair in pairs:
            if kind == "frame" and pair["lit"] in seen:
                continue
            seen.add(pair["lit"])
            lit, dark = read(folder / pair["lit"]), read(folder / pair["dark"])
            cases.append(case(pair, lit, dark if kind == "pair" else None))
            for _ in range(SHAKES if kind == "pair" else 0):
                try:
                    cases.append(case(pair, lit, shake(dark, rng), shaken=True))
                except ValueError as error:
                    print(f"{pair['lit']}: {error}", file=sys.stderr)
        if kind == "frame":
            weights, offset = fixed(cases)
            scores = [one.looks @ weights + offset for one in cases]
        else:
            model, scores = fit(cases), crossed(cases)
            weights, offset = model.coef_[0], float(model.intercept_[0])
        still = [n for n, one in enumerate(cases) if not one.shaken]
        recall, _ = judged([cases[n] for n in still], [scores[n] for n in still])
        print(kind, "standing", recall)
        everything, (a, b) = judged(cases, scores)
        print(kind, "all", everything, (a, b))
        names = OF_A_FRAME + (OF_A_PAIR if kind == "pair" else ())
        known[kind] = {
            "weights": dict(zip(names, np.round(weights, 4).tolist(), strict=True)),
            "offset": round(offset, 4),
            "alarms": [round(a, 4), round(b, 4)],
            "scenes": sorted({one.scene for one in cases}),
            "frames": len(cases),
            # The looks of a frame alone were chosen with these scenes in view.
            "recall_by_other_scenes" if kind == "pair" else "recall_in_view": {
                str(rate): round(value, 3) for rate, value in recall.items()
            },
        }
    with atomic_file(OUT) as part:
        part.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
