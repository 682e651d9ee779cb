"""Measure the gaze labels of simulated hands against the truth, at frame rates of the target's camera.

That camera has its own lag and rate, and a rolling shutter. By default spots are drawn at random about the laser's true
place (0.05 px of 968 wide); with --film the bench renders the frames and the finder measures them. Printed are, in
units of 1.5e-4 of the field, the RMS errors of a straight line, of the cubic, of the smoother whose spectrum is fitted
to the recording, and of a Gaussian process that knows the true spectrum, the least that any linear estimate reaches;
and the shares of labels that the stated 90 % intervals hold along x and y, with the 90 % interval of these shares by
drawing films anew: labels of one film err alike. Seeds below 200 tuned the smoother, and 720 to 839 what stands about a
spot; report others. With --motion random the tremor's band and size are drawn, between 2 and 14.5 Hz. --locked is a
case with equal rates, a lag of 21 ms and a global shutter.

--photographs draws spots that stand still onto places of real photographs instead, 24 frames each with the photograph
moved by parts of a pixel, and prints how far off what the frames have in common is, in pixels along x and y: of fits to
the spot alone, and with its surroundings taken off; and the shares of the stated 90 % intervals that hold it.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import gaussian_filter, map_coordinates

from tapetum.bench import load_scene
from tapetum.data.synth.clip import Clip
from tapetum.data.synth.plan import Video
from tapetum.errors import InputError
from tapetum.record import HandMotion, Session, label_recording
from tapetum.record.beats import CameraClock
from tapetum.record.frames import open_frames
from tapetum.record.labels import _look, _sharp
from tapetum.record.shot import Shot
from tapetum.record.smoother import Samples, smooth
from tapetum.record.source import Frame

Array = npt.NDArray[np.float64]
UNIT = 1.5e-4
NOISE = 0.05 / 968
Q90 = 1.6449
PROBE_RATE, EXPOSURE = 15.0, 0.01


def motion_of(kind: str, seed: int) -> HandMotion:
    """The bench's hand; one whose tremor has a random band and size; or one without."""
    hand = HandMotion()
    if kind == "bench":
        return hand
    if kind == "still":
        return replace(hand, tremor=0.0)
    rng = np.random.default_rng([seed, 5])
    centre, width = rng.uniform(4.5, 12), rng.uniform(1, 5)
    size = float(np.exp(rng.uniform(np.log(3e-4), np.log(5e-3))))
    return replace(hand, tremor_band=(max(2.0, centre - width / 2), centre + width / 2), tremor=size)


def covariance(hand: HandMotion, lag: Array) -> Array:
    """The true covariance of a gaze at two times: a normal sweep mapped to a uniform one, and the tremor."""

    def band(low: float, high: float) -> Array:
        return (high * np.sinc(2 * high * lag) - low * np.sinc(2 * low * lag)) / (high - low)

    swept = hand.extent**2 * 2 / np.pi * np.arcsin(np.clip(band(*hand.sweep_band), -1, 1) / 2)
    return 2 * swept + hand.tremor**2 * band(*hand.tremor_band)


@dataclass(frozen=True)
class Filmed:
    """True gazes [T, 2] of the probe's frames at `probe` [T] s, and measured places [N, 2] of the target's frames."""

    probe: Array
    gaze: Array
    frames: Array
    rows: Array
    places: Array
    rate: float


def spots(hand: HandMotion, seed: int, rate: float, seconds: float, clock: CameraClock, stamp: float) -> Filmed:
    """Draw a take of which only the spots are simulated."""
    moving, rng = hand.draw(seed, seconds=seconds), np.random.default_rng([seed, 77])
    probe = CameraClock().draw(int(seconds * PROBE_RATE), PROBE_RATE, np.random.default_rng([seed, 3]))[0]
    own = clock.drawn(rate, rng)
    frames = own.draw(int(seconds * rate), rate, rng)[0]
    rows = frames
    for _ in range(4):
        rows = frames + own.readout * moving.gaze(rows)[:, 1]
    steps = EXPOSURE * ((np.arange(24) + 0.5) / 24 - 0.5)
    places = np.mean([moving.gaze(rows + step) for step in steps], axis=0)
    places += NOISE * rng.standard_normal(places.shape)
    late = stamp * rng.standard_normal(len(frames))
    asked = probe + stamp * rng.standard_normal(len(probe))
    return Filmed(asked, moving.gaze(probe), frames + late, rows + late, places, rate)


def straight(take: Filmed) -> Array:
    """A straight line between frames."""
    return np.stack([np.interp(take.probe, take.frames, axis) for axis in take.places.T], axis=1)


def cubic(take: Filmed) -> Array:
    """The cubic through two frames on either side."""
    first = np.clip(np.searchsorted(take.frames, take.probe) - 2, 0, len(take.frames) - 4)
    used = first[:, None] + np.arange(4)
    times, found = take.frames[used], np.zeros((len(take.probe), 2))
    for k in range(4):
        others = np.delete(times, k, axis=1)
        share = ((take.probe[:, None] - others) / (times[:, k : k + 1] - others)).prod(axis=1)
        found += share[:, None] * take.places[used[:, k]]
    return found


def best(take: Filmed, hand: HandMotion) -> Array:
    """The mean of a Gaussian process that knows the spectrum."""
    among = covariance(hand, take.rows[:, None] - take.rows) + NOISE**2 * np.eye(len(take.rows))
    weights = cho_solve(cho_factor(among, lower=True), take.places)
    return covariance(hand, take.probe[:, None] - take.rows) @ weights


def labels_of_spots(take: Filmed) -> tuple[Array, Array]:
    """The smoother's places [T, 2] and deviations [T, 2]."""
    samples = Samples(take.rows, take.places, np.full(len(take.rows), NOISE), EXPOSURE)
    found = smooth(samples, take.probe, take.rate)
    return found.places, found.deviations


def labels_of_film(hand: HandMotion, seed: int, rate: float, seconds: float) -> tuple[Array, Array, Array]:
    """Film the target's frames, label them, and return true gazes, labels and deviations, [T, 2] each."""
    session = Session(seconds, PROBE_RATE, seed, motion=hand, target_rate=rate)
    scene = load_scene("hand-held")
    shot, video = Shot(scene, session), Video(f"{rate:g} fps", scene, session)
    clip = Clip.of(video, shot, 0, video.frames)
    label_recording(clip)
    table = clip.labels()
    assert table is not None

    def columns(names: str) -> Array:
        return np.stack([table[n].to_numpy(zero_copy_only=False).astype(float) for n in names.split()], axis=1)

    truth = shot.gaze(range(len(table)))
    return truth, columns("gaze_x gaze_y"), columns("gaze_x_std gaze_y_std")


def rms(errors: list[Array]) -> float:
    """RMS in units of 1.5e-4 of the field; frames without a label do not count."""
    return float(np.sqrt(np.nanmean(np.concatenate(errors) ** 2)) / UNIT)


def shares(scores: list[Array]) -> tuple[Array, Array]:
    """Share of labels within the 90 % intervals, [2], of films' errors in deviations, [T, 2] each; and the ends of its
    90 % interval, [4]: x, x, y, y."""
    inside = np.array([(np.abs(one) < Q90).sum(axis=0) for one in scores])
    count = np.array([len(one) for one in scores])
    drawn = np.random.default_rng(0).integers(len(scores), size=(2000, len(scores)))
    share = inside[drawn].sum(axis=1) / count[drawn].sum(axis=1)[:, None]
    return inside.sum(axis=0) / count.sum(), np.quantile(share, [0.05, 0.95], axis=0).T.ravel()


def measure(
    kind: str, rate: float, seeds: range, seconds: float, film: bool, stamp: float, locked: bool
) -> dict[str, float | list[float]]:
    """Label one take for every seed."""
    clock = CameraClock(offset=0.021, drift=-3e-5) if locked else Session().target_clock
    errors: dict[str, list[Array]] = {}
    scores: list[Array] = []
    widths: list[Array] = []
    spent = 0.0
    for seed in seeds:
        hand = motion_of(kind, seed)
        take = spots(hand, seed, rate, seconds, clock, stamp)
        # Ends are left out for all alike: the true spectrum's process would extrapolate.
        inner = (take.probe > take.frames[3]) & (take.probe < take.frames[-4])
        for name, found in (("straight line", straight(take)), ("cubic", cubic(take)), ("limit", best(take, hand))):
            errors.setdefault(name, []).append((found - take.gaze)[inner])
        start = time.process_time()
        truth, found, deviation = take.gaze, *labels_of_spots(take)
        if film:
            truth, found, deviation = labels_of_film(hand, seed, rate, seconds)
        spent += time.process_time() - start
        known = np.isfinite(found[:, 0])
        errors.setdefault("smoother", []).append((found - truth)[known])
        scores.append(((found - truth) / deviation)[known])
        widths.append(deviation[known])
    held, likely = shares(scores)
    said = float(np.sqrt((np.concatenate(widths) ** 2).mean()) / UNIT)
    labelled = float(np.mean([len(one) for one in scores]) / (seconds * PROBE_RATE))
    return {
        **{name: round(rms(one), 2) for name, one in errors.items()},
        "stated": round(said, 2),
        "intervals hold": [round(float(one), 3) for one in held],
        "likely": [round(float(one), 3) for one in likely],
        "labelled": round(labelled, 3),
        "CPU s a recording": round(spent / len(seeds), 2),
    }


def common_errors(photograph: Array, rng: np.random.Generator) -> Array | None:
    """Return what places of a spot on a photograph have in common and its stated deviation, of the spot alone and with
    its surroundings taken off, [2, 2, 2] px; None where nothing but even wall stands there."""
    side, reach = 24, 30
    top, left = (int(rng.integers(reach, size - reach)) for size in photograph.shape)
    # As sharp as the bench's room.
    wall = gaussian_filter(photograph[top - reach : top + reach + 1, left - reach : left + reach + 1], 0.8)
    if wall[18:43, 18:43].std() < 3 or wall.max() > 195:
        return None
    y, x = np.mgrid[-side : side + 1, -side : side + 1]
    places, frames = rng.uniform(-0.5, 0.5, (24, 2)), []
    for px, py in places:
        spot = 320 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 1.2**2))
        frames.append(map_coordinates(wall, [y - py + reach, x - px + reach], order=3) + spot)
    counts = np.clip(np.rint(frames + 2 * rng.standard_normal((24, *x.shape))), 0, 255).astype(np.uint8)
    sights = [_look(Frame(n, n / 60, one)) for n, one in enumerate(counts)]
    at = places + side
    if any(
        not len(one.found) or np.hypot(one.found.x[0] - p, one.found.y[0] - q) > 2
        for one, (p, q) in zip(sights, at, strict=True)
    ):
        return None
    every = np.ones(24, bool)
    fits = [_sharp(sights, one) for one in (~every, every)]
    return np.stack([[(one[0] - at).mean(axis=0), np.median(one[2], axis=0)] for one in fits])


def on_photographs(folder: Path, count: int = 200) -> None:
    """Print how far off spots on real photographs are."""
    grey = [frame.image * (255 / (frame.full_scale or 255)) for frame in open_frames(folder)]
    rng, found = np.random.default_rng(0), []
    while len(found) < count:
        one = common_errors(grey[int(rng.integers(len(grey)))], rng)
        if one is not None:
            found.append(one)
    noise = 2 / 320 / np.sqrt(24)
    for name, fits in zip(("alone", "surroundings taken off"), np.moveaxis(np.array(found), 1, 0), strict=True):
        errors, stated = np.moveaxis(fits, 1, 0)
        each = np.quantile(np.abs(errors), [0.5, 0.9], axis=0).round(4).tolist()
        held = (np.abs(errors) < Q90 * np.hypot(stated, noise)).mean(axis=0).round(3).tolist()
        told = f"RMS {np.sqrt((errors**2).mean(axis=0)).round(4).tolist()} px, half and nine of ten below {each}"
        print(f"{name}: {told}, 90 % intervals hold {held} of {count} spots")


def main() -> None:
    """Print one line for every motion and frame rate; keep them as JSON with --out."""
    options = argparse.ArgumentParser(description=__doc__.split("\n\n", 1)[0] if __doc__ else None)
    options.add_argument("--seeds", type=int, nargs=2, default=(300, 312), metavar=("FIRST", "END"))
    options.add_argument("--rates", type=float, nargs="+", default=[15.0, 30.0, 60.0])
    options.add_argument("--motion", nargs="+", default=["bench", "random", "still"])
    options.add_argument("--seconds", type=float, default=25.0)
    options.add_argument("--stamp", type=float, default=0.0, help="RMS error of every time stamp, in seconds")
    options.add_argument("--locked", action="store_true", help="equal rates, a lag of 21 ms and a global shutter")
    options.add_argument("--film", action="store_true", help="render the target's frames and find the laser in them")
    options.add_argument("--out", type=Path)
    options.add_argument("--photographs", type=Path, metavar="FOLDER")
    given = options.parse_args()
    if given.photographs is not None:
        try:
            on_photographs(given.photographs)
        except InputError as error:
            options.error(str(error))
        return
    found = {}
    for kind in given.motion:
        for rate in given.rates:
            told = measure(kind, rate, range(*given.seeds), given.seconds, given.film, given.stamp, given.locked)
            found[f"{kind}, {rate:g} fps"] = told
            print(f"{kind}, {rate:g} fps: {told}", flush=True)
    if given.out is not None:
        given.out.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
