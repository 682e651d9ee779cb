"""Fits the weights of the detector (src/tapetum/detection/weights.json).

    python scripts/make_detector.py FOLDER pair
    python scripts/make_detector.py FOLDER frame PHOTOGRAPHS

The first folder holds pictures and `labels.json`: `pairs`, each with `scene`, `lit`, `dark` (file names), `points` and
`unsure` (x, y in the lit frame; what is unsure counts neither way) and `tolerance` (pixels). Frames of one scene are
near copies: scenes weigh the same, and what is printed is cross-validated by scene. Each dark frame is also shaken, as
by a hand: turned, shifted and bent at random. To the weighted looks of a pair comes what the networks say, which
learned from drawn scenes alone (train_second.py, train_third.py).

The weights for one frame alone are fitted to photographs with cameras drawn in (photographs.py), to no labelled frame:
six scenes are too few (chosen on five, they fail on the sixth). The stored ones are of the 500 photographs of the
Berkeley segmentation data set (BSDS500), four of five of which were learned from.

How many false alarms a score costs, and how this rises with a frame's clutter, is counted on the labelled frames, each
scene left out once, for one frame on the photographs that were left out, without cameras, and on drawn scenes without
cameras; the geometric mean of real and drawn ones where both are known.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.stats import binomtest
from sklearn.linear_model import LogisticRegression, PoissonRegressor

from drawn_scenes import KINDS, draw
from photographs import Posed, paths_in, posed
from photographs import read as read_photograph
from tapetum.detection.features import OF_A_FRAME, OF_A_PAIR
from tapetum.detection.find import (
    DECOYS_LOOKED_AGAIN,
    LOOKED_AGAIN,
    clutter_of_frame,
    joined,
    second_look,
)
from tapetum.detection.measured import Candidates, candidates_with_looks
from tapetum.detection.score import Score
from tapetum.detection.third import SUREST, Told
from tapetum.files import atomic_file

OUT = Path(__file__).parents[1] / "src" / "tapetum" / "detection" / "weights.json"
RATES = (0.1, 0.5, 1.0, 10.0)
UNSURE = 14.0
"""Within so many pixels of a place that may be a camera nothing counts."""
SHAKES = 2
STRENGTH = 0.3
NETWORKS = 0.7
"""Share of the networks' log odds, chosen on drawn scenes of seeds 90000 to 91059, the real ones in view."""
LIMITS = -5.0, -1.0
"""Least and most log odds that the looks alone may give, chosen in the same way."""
LEFT_OUT = {
    "pair": ("clear", "level", "above", "apart", "twin"),
    "frame": ("outlier",),
}
"""Looks that no weight is fitted to. In a pair only the networks use them: with them the weights fitted to some
scenes hold less well on others. Of a frame alone: where many cameras stand in one, none of them is an outlier."""
LEVELS = np.arange(-12, 8, 0.25)
"""Log odds whose cost is counted."""
EMPTY = {"pair": range(64000, 64060), "frame": range(51000, 51060)}
"""Seeds of the drawn scenes of each kind that say what a score costs."""
MANY, TAIL = 10, 3.0
"""False alarms of real and of drawn frames that say how many there are; beyond, for so much of the log odds the rates
are stored that their tail gives."""
EVEN = 0.01
"""Weight of the squares of a regression's coefficients."""
REFLECTORS = {"courtyard": (391, 422)}
"""Scene, and x and y of a reflector that the laser lights there as it lights cameras, and that has no label."""
PICKED, EVERY, DRAWN_IN = (6, 4), 5, 3
"""How often a photograph is taken to learn from and to count alarms in; of how many one is left for that; cameras."""
LIKELY = {"isolation": 1.0, "alone": 1.0, "elongation": -1.0}
"""What puts candidates of a photograph first."""
BEST, OTHERS = 16, 6
"""Of each photograph: how many candidates that are no camera, of the likeliest and of the others."""


@dataclass(frozen=True)
class Case:
    """A labelled frame: its candidates [N, 2], their looks [N, features], and which are cameras or neither.

    `worth` [N] is by what they were chosen. Of a pair, `found` and `decoys` are what the third stage is told of the
    candidates and the decoys; the second stage has looked at all of them.
    """

    scene: str
    places: np.ndarray
    looks: np.ndarray
    camera: np.ndarray
    counted: np.ndarray
    glints: int
    worth: np.ndarray
    shaken: bool = False
    found: Told | None = None
    decoys: Told | None = None


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


def matched(scene: str, found: Candidates, known: Iterable[tuple[ArrayLike, float, float]]) -> Case:
    """A frame's candidates beside what is known of it: places, each with two reaches in pixels.

    Within the first no candidate counts but a camera: the highest within the second. A second one of 0 is no camera.
    """
    columns, looks = found.columns, found.looks
    places = np.stack([columns["x"], columns["y"]], 1)
    camera, counted, glints = np.zeros(len(places), bool), np.ones(len(places), bool), 0
    for place, apart, reach in known:
        away = np.hypot(*(places - place).T)
        counted[away <= apart] = False
        near = np.flatnonzero(away <= reach)
        if reach and len(near):
            camera[near[np.argmax(columns["snr"][near])]] = True
        glints += reach > 0
    return Case(scene, places, looks, camera, counted | camera, glints, columns["worth"])


def case(pair: dict, lit: np.ndarray, dark: np.ndarray | None, shaken: bool = False) -> Case:
    found, others = candidates_with_looks(lit, dark)
    known = [(point, pair["tolerance"], pair["tolerance"]) for point in pair["points"]]
    one = matched(pair["scene"], found, known + [(point, UNSURE, 0) for point in pair["unsure"]])
    if others is None:
        return one
    return replace(one, shaken=shaken, found=_seen(found), decoys=_seen(others))


def _seen(some: Candidates) -> Told:
    """What the third stage is told, with a second look at all."""
    return Told(some.looks, some.columns["clear"], second_look(some, some.looks[:, 0], len(some.looks)))


def fit(cases: list[Case], strength: float = STRENGTH) -> LogisticRegression:
    per_scene = defaultdict(int)
    for one in cases:
        per_scene[one.scene] += 1
    weights = np.concatenate([np.full(one.counted.sum(), 1 / per_scene[one.scene]) for one in cases])
    looks = np.vstack([_fitted(one.looks)[one.counted] for one in cases])
    camera = np.concatenate([one.camera[one.counted] for one in cases])
    return LogisticRegression(C=strength, max_iter=5000).fit(looks, camera, weights)


def _fitted(looks: np.ndarray) -> np.ndarray:
    """Looks without those that no weight is fitted to."""
    return looks[:, _chosen(looks.shape[1])] if looks.shape[1] >= len(OF_A_FRAME) else looks


def _chosen(count: int) -> np.ndarray:
    """Which of so many looks a weight is fitted to."""
    pair = count > len(OF_A_FRAME)
    return np.array([name not in LEFT_OUT["pair" if pair else "frame"] for name in OF_A_FRAME + OF_A_PAIR * pair])


def of_photographs(folder: Path) -> tuple[list[Case], list[Case]]:
    """Photographs to learn from, and those to count alarms in, which have no cameras."""
    learned, empty, paths = [], [], paths_in(folder)
    for number, path in enumerate(paths):
        image, left_out = read_photograph(path), number % EVERY == EVERY - 1
        for n in range(PICKED[left_out]):
            rng = np.random.default_rng([n, number, left_out])
            scene = posed(image, rng, 0 if left_out else DRAWN_IN)
            found, _ = candidates_with_looks(scene.frame, None)
            if left_out:
                empty.append(matched("photographs", found, ()))
            else:
                learned.append(_learned(f"{path.stem} {n}", scene, found, rng))
    if not empty:
        sys.exit(f"error: {folder}: holds {len(paths)} photographs; {EVERY} are the fewest")
    return learned, empty


def _learned(name: str, scene: Posed, found: Candidates, rng: np.random.Generator) -> Case:
    """The cameras of a photograph, the likeliest candidates that are none, and some others."""
    reaches = np.maximum((8.0, 2.5), scene.sigma[:, None] * (4.0, 1.2)).tolist()
    one = matched(name, found, [(place, *both) for place, both in zip(scene.places, reaches, strict=True)])
    order = np.argsort(-sum(k * found.looks[:, OF_A_FRAME.index(name)] for name, k in LIKELY.items()), kind="stable")
    wrong = order[(one.counted & ~one.camera)[order]]
    kept = one.camera.copy()
    kept[wrong[:BEST]] = True
    kept[rng.permutation(wrong[BEST:])[:OTHERS]] = True
    return replace(one, counted=kept)


def by(model: LogisticRegression, one: Case) -> tuple[np.ndarray, float]:
    """Log odds of a pair's candidates by fitted weights and the networks, and how cluttered the pair is."""
    assert one.found is not None and one.decoys is not None
    odds, of_decoys = (
        model.decision_function(_fitted(some.looks)) if len(some.looks) else np.empty(0)
        for some in (one.found, one.decoys)
    )
    found, decoys = _limited(one.found, odds, LOOKED_AGAIN), _limited(one.decoys, of_decoys, DECOYS_LOOKED_AGAIN)
    return joined(odds, of_decoys, found, decoys, Score((), 0.0, ((), ()), NETWORKS, LIMITS))


def _limited(some: Told, odds: np.ndarray, most: int) -> Told:
    """The second stage's log odds of the likeliest only, as in a search."""
    again = np.full(len(odds), -SUREST)
    best = np.argsort(-odds, kind="stable")[:most]
    again[best] = some.again[best]
    return replace(some, again=again)


def crossed(cases: list[Case]) -> tuple[list[np.ndarray], list[float]]:
    """Log odds of every case's candidates, and its clutter, by weights fitted to the other scenes."""
    models = {}
    for scene in sorted({one.scene for one in cases}):
        models[scene] = fit([one for one in cases if one.scene != scene])
    told = [by(models[one.scene], one) for one in cases]
    return [odds for odds, _ in told], [clutter for _, clutter in told]


def recalled(cases: list[Case], scores: list[np.ndarray]) -> dict[float, float]:
    """Recall averaged over scenes at rates of false alarms."""
    scenes = sorted({one.scene for one in cases})
    false = np.unique(np.concatenate([s[one.counted & ~one.camera] for one, s in zip(cases, scores, strict=True)]))
    levels = false[::-1]
    rates = alarm_rates(cases, scores, levels)
    recall = {}
    for rate in RATES:
        over = np.flatnonzero(rates > rate)
        least = levels[over[0]] if len(over) else -np.inf
        shares = []
        for scene in scenes:
            own = [(one, s) for one, s in zip(cases, scores, strict=True) if one.scene == scene]
            shares.append(sum((s[one.camera] > least).sum() for one, s in own) / sum(one.glints for one, _ in own))
        recall[rate] = float(np.mean(shares))
    return recall


def without_reflector(one: Case) -> Case:
    """The case with the reflector that has no label counted neither way."""
    if one.scene not in REFLECTORS or not len(one.places):
        return one
    near = np.hypot(*(one.places - REFLECTORS[one.scene]).T) < 6
    return replace(one, counted=one.counted & (~near | one.camera))


def alarm_rates(cases: list[Case], scores: list[np.ndarray], levels: np.ndarray) -> np.ndarray:
    """False alarms a frame of at least so high a score, averaged over scenes, [levels]."""
    rates = []
    for scene in sorted({one.scene for one in cases}):
        own = [s[one.counted & ~one.camera] for one, s in zip(cases, scores, strict=True) if one.scene == scene]
        false = np.sort(np.concatenate(own))
        rates.append((len(false) - np.searchsorted(false, levels)) / len(own))
    return np.mean(rates, 0)


def scaled(cases: list[Case], scores: list[np.ndarray], rises: list[np.ndarray]) -> tuple[float, float]:
    """Scale k and offset c: k s + c, less the logarithm by which false alarms rise, are log odds of a camera of score s
    (Platt 1999). Scenes weigh the same."""
    frames = Counter(one.scene for one in cases)
    weight = np.concatenate([np.full(one.counted.sum(), 1 / frames[one.scene]) for one in cases])
    odds, less = (
        np.concatenate([s[one.counted] for one, s in zip(cases, some, strict=True)]) for some in (scores, rises)
    )
    camera = np.concatenate([one.camera[one.counted] for one in cases])

    def missed(at: np.ndarray) -> float:
        told = at[0] * odds + at[1] - less
        return float(weight @ (np.logaddexp(0, told) - camera * told))

    scale, offset = minimize(missed, [1.0, 0.0]).x
    return float(scale), float(offset)


@dataclass(frozen=True)
class Alarms:
    """What passes for a camera in a frame of a scene: log odds [N], and how cluttered the frame is."""

    scene: str
    odds: np.ndarray
    clutter: float


def alarms_of(cases: list[Case], scores: list[np.ndarray], clutter: list[float]) -> list[Alarms]:
    return [
        Alarms(one.scene, odds[one.counted & ~one.camera], level)
        for one, odds, level in zip(cases, scores, clutter, strict=True)
    ]


def costs(real: list[Alarms], drawn: list[Alarms]) -> tuple[list[float], list[float], float, list[float]]:
    """Log odds, how many false alarms a frame has above each, the usual clutter, and how they rise with it.

    Poisson regressions, one a level: on clutter, and on whether frames are real or drawn, half-way between which the
    rates are. Real scenes weigh the same as each other, so do kinds of drawn ones, and so do both groups. Where either
    group has few false alarms left, rates fall exponentially, as much with the log odds as those that are left do, and
    rise with clutter as at the last level that has enough (peaks over a threshold: Davison and Smith 1990).
    """
    weights, is_real = [], np.repeat([1.0, 0.0], [len(real), len(drawn)])
    for part in (real, drawn):
        scenes = [one.scene for one in part]
        weights += [1 / scenes.count(one) / len(set(scenes)) for one in scenes]
    both, weight = real + drawn, np.array(weights) * (len(real) + len(drawn)) / 2
    clutter = np.array([one.clutter for one in both])
    usual = float(np.average(clutter, weights=weight))
    spread = float(np.sqrt(np.average(np.square(clutter - usual), weights=weight))) or 1.0
    levels, rates, rises = [], [], []
    for level in LEVELS:
        count = np.array([(one.odds >= level).sum() for one in both])
        if min(count[is_real == 1].sum(), count[is_real == 0].sum()) < MANY:
            break
        known = np.stack([(clutter - usual) / spread, is_real - 0.5], 1)
        model = PoissonRegressor(alpha=EVEN, max_iter=2000).fit(known, count, weight)
        levels.append(float(level))
        rates.append(float(np.exp(model.intercept_)))
        rises.append(float(model.coef_[0] / spread))
    if not levels:
        sys.exit(f"error: real and drawn frames have fewer than {MANY} false alarms each; give more labelled frames")
    # Two groups whose rates fall exponentially: so does their geometric mean, with the mean of both slopes.
    falls = np.mean([_fall(both, weight * (is_real == group), levels[-1]) for group in (0, 1)])
    levels.append(levels[-1] + TAIL)
    rates.append(rates[-1] * math.exp(-falls * TAIL))
    rises.append(rises[-1])
    kept = np.array(rates) < 30
    rates = np.minimum.accumulate(np.array(rates)[kept] * 0.999 ** np.arange(kept.sum()))
    rounded = [float(f"{one:.3g}") for one in rates]
    return np.array(levels)[kept].tolist(), rounded, round(usual, 2), np.round(np.array(rises)[kept], 3).tolist()


def _fall(frames: list[Alarms], weight: np.ndarray, level: float) -> float:
    """By how much the logarithm of the rate falls a unit of the log odds above a level: one over the mean excess."""
    excess = [one.odds[one.odds >= level] - level for one in frames]
    shares = np.repeat(weight, [len(one) for one in excess])
    return float(shares.sum() / (shares @ np.concatenate(excess)))


def costs_by_others(
    cases: list[Case], alarms: list[Alarms], scores: list[np.ndarray], others: list[Alarms], drawn: list[Alarms]
) -> list[np.ndarray]:
    """False alarms a frame that each candidate of the cases costs: what the other cases, further real frames and drawn
    ones say."""
    found: list[np.ndarray] = [np.empty(0)] * len(cases)
    for scene in sorted({one.scene for one in cases}):
        levels, rates, usual, rises = costs([*(one for one in alarms if one.scene != scene), *others], drawn)
        score = Score((), 0.0, (tuple(levels), tuple(rates)), clutter=(usual, tuple(rises)))
        for n, one in enumerate(alarms):
            if one.scene == scene:
                found[n] = score.false_alarms(scores[n], one.clutter)
    return found


def told(kind: str, cases: list[Case], costs: list[np.ndarray]) -> None:
    """Print, for each real scene, what is found and what alarms at the false alarms that candidates cost, [N] each."""
    print(f"| {kind}: scene | frames | cameras | found at 0.1, 0.5, 1 asked | alarms a frame |\n|---|---|---|---|---|")
    rows = []
    for scene in sorted({one.scene for one in cases}):
        own = [(one, cost) for one, cost in zip(cases, costs, strict=True) if one.scene == scene]
        cameras = sum(one.glints for one, _ in own)
        hits = [sum(int((cost <= rate)[one.camera].sum()) for one, cost in own) for rate in RATES[:3]]
        alarms = [sum(int((cost <= r)[one.counted & ~one.camera].sum()) for one, cost in own) for r in RATES[:3]]
        rows.append([*(hit / cameras for hit in hits), *(one / len(own) for one in alarms)])
        found = ", ".join(f"{hit / cameras:.2f} ({_interval(hit, cameras)})" for hit in hits)
        false = ", ".join(f"{one / len(own):.2f}" for one in alarms)
        print(f"| {scene} | {len(own)} | {cameras} | {found} | {false} |")
    mean = [f"{one:.2f}" for one in np.mean(rows, 0)]
    print(f"| mean of the scenes | | | {', '.join(mean[:3])} | {', '.join(mean[3:])} |", flush=True)


def _interval(hits: int, count: int) -> str:
    """Wilson's interval of 95 %, as if frames of one scene were independent, which they are not."""
    low, high = binomtest(hits, count).proportion_ci(method="wilson")
    return f"{low:.2f} to {high:.2f}"


def drawn_empty(pair: bool) -> list[Case]:
    """Drawn scenes of every kind without cameras and tape; scenes are kinds."""
    found = []
    for kind in KINDS:
        for seed in EMPTY["pair" if pair else "frame"]:
            scene = draw(kind, seed, tape=False)
            nothing = {"scene": kind, "points": [], "unsure": [], "tolerance": 0}
            try:
                found.append(case(nothing, scene.lit, scene.dark if pair else None))
            except ValueError as error:
                print(f"{kind} {seed}: {error}", file=sys.stderr)
    return found


@dataclass(frozen=True)
class Fitted:
    """Weights, and what they say: log odds of each case's candidates and of empty drawn scenes, and how cluttered each
    frame is."""

    weights: np.ndarray
    offset: float
    scores: list[np.ndarray]
    clutter: list[float]
    of_empty: list[np.ndarray]
    empty_clutter: list[float]


def fitted_pair(cases: list[Case], empty: list[Case]) -> Fitted:
    """Fitted to the cases; what is said of each is by weights fitted to the other scenes."""
    model, (scores, clutter) = fit(cases), crossed(cases)
    told = [by(model, one) for one in empty]
    of_empty, empty_clutter = [odds for odds, _ in told], [level for _, level in told]
    return Fitted(*_weights_of(model, cases[0]), scores, clutter, of_empty, empty_clutter)


def fitted_frame(learned: list[Case], cases: list[Case], empty: list[Case]) -> Fitted:
    """Fitted to photographs alone."""
    model = fit(learned)
    scores, of_empty = ([model.decision_function(_fitted(one.looks)) for one in some] for some in (cases, empty))
    clutter = [clutter_of_frame(odds, one.worth) for odds, one in zip(scores, cases, strict=True)]
    empty_clutter = [clutter_of_frame(odds, one.worth) for odds, one in zip(of_empty, empty, strict=True)]
    return Fitted(*_weights_of(model, cases[0]), scores, clutter, of_empty, empty_clutter)


def _weights_of(model: LogisticRegression, one: Case) -> tuple[np.ndarray, float]:
    """Weights of all looks of a case, and the offset."""
    weights = np.zeros(one.looks.shape[1])
    weights[_chosen(len(weights))] = model.coef_[0]
    return weights, float(model.intercept_[0])


def labelled(folder: Path, pair: bool) -> list[Case]:
    """The labelled frames: pairs as they are and shaken, or each lit frame once."""
    cases: list[Case] = []
    seen: set[str] = set()
    rng = np.random.default_rng(1)
    for one in json.loads((folder / "labels.json").read_text())["pairs"]:
        if not pair and one["lit"] in seen:
            continue
        seen.add(one["lit"])
        lit, dark = read(folder / one["lit"]), read(folder / one["dark"])
        cases.append(case(one, lit, dark if pair else None))
        for _ in range(SHAKES if pair else 0):
            try:
                cases.append(case(one, lit, shake(dark, rng), shaken=True))
            except ValueError as error:
                print(f"{one['lit']}: {error}", file=sys.stderr)
    return cases


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("kind", choices=("pair", "frame"))
    parser.add_argument("photographs", type=Path, nargs="?", help="a folder of them, which `frame` needs")
    options = parser.parse_args()
    kind, pair = options.kind, options.kind == "pair"
    if pair != (options.photographs is None):
        parser.error("`pair` takes no photographs, `frame` needs a folder of them")
    cases, empty = labelled(options.folder, pair), drawn_empty(pair)
    without: list[Case] = []
    if pair:
        fitted = fitted_pair(cases, empty)
    else:
        learned, without = of_photographs(options.photographs)
        fitted = fitted_frame(learned, cases, [*empty, *without])
    scores, clutter = fitted.scores, fitted.clutter
    alarms = alarms_of([*empty, *without], fitted.of_empty, fitted.empty_clutter)
    drawn, photographed = alarms[: len(empty)], alarms[len(empty) :]
    real = alarms_of(cases, scores, clutter)
    levels, rates, usual, rises = costs([*real, *photographed], drawn)
    cost = Score((), 0.0, (tuple(levels), tuple(rates)), clutter=(usual, tuple(rises)))
    # Frames differ in clutter, so candidates of several frames are ranked by what they cost. One table ranks all: with
    # one of the others for each scene, a scene that alarms more would be ranked by a table that alarms less. Where the
    # table is level, log odds decide.
    ranks = [1e-3 * s - np.log(cost.false_alarms(s, level)) for s, level in zip(scores, clutter, strict=True)]
    still = [n for n, one in enumerate(cases) if not one.shaken]
    recall = recalled([cases[n] for n in still], [ranks[n] for n in still])
    print(kind, "standing", recall)
    if pair:
        print("all", recalled(cases, ranks))
        spared = [without_reflector(one) for one in cases]
        print("standing, no reflector", recalled([spared[n] for n in still], [ranks[n] for n in still]))
        print("all, no reflector", recalled(spared, ranks))
    told(kind, cases, costs_by_others(cases, real, scores, photographed, drawn))
    # Of pairs it is fitted as if all were of the usual clutter.
    risen = [
        np.interp(s, levels, rises) * (level - usual) * (not pair) for s, level in zip(scores, clutter, strict=True)
    ]
    known, names = json.loads(OUT.read_text()), OF_A_FRAME + (OF_A_PAIR if pair else ())
    known[kind] = {
        "weights": dict(zip(names, np.round(fitted.weights, 4).tolist(), strict=True)),
        "offset": round(fitted.offset, 4),
        "networks": NETWORKS if pair else 0.0,
        "limits": LIMITS if pair else None,
        "calibration": np.round(scaled(cases, scores, risen), 4).tolist(),
        "alarms": [levels, rates],
        "clutter": [usual, rises],
        "scenes": sorted({one.scene for one in cases}) if pair else ["photographs"],
        "frames": len(cases) if pair else len(learned),
        # Of a frame alone the looks and what clutter is were chosen with these scenes in view.
        "recall_by_other_scenes" if pair else "recall_in_view": {
            str(rate): round(value, 3) for rate, value in recall.items()
        },
    }
    with atomic_file(OUT) as part:
        part.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
