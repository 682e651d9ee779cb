"""Activity of phones on the virtual bench: how often each class of asymmetry occurs, and how often an answer is right.

    python scripts/measure_activity.py learn      the classes' shares, of which tapetum/track/activity.py is made
    python scripts/measure_activity.py judge      the answers of `track`, activity=True, for phones not learned from

Each phone's main camera begins and stops to image at random, held by hand 5.5 m away, at 640 and 785 nm.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tapetum.bench import load_scene, with_values
from tapetum.data.crop import crop
from tapetum.record.imaging import Imaging
from tapetum.record.motion import HandMotion
from tapetum.record.session import Session
from tapetum.record.shot import Shot
from tapetum.record.source import Frame
from tapetum.simulate.phone import phone_scenes
from tapetum.track import track
from tapetum.track.activity import EDGES, asymmetry
from tapetum.track.rows import TrackRow

LEARNED = ("phone-01", "phone-02", "phone-03", "phone-05", "phone-08", "phone-11")
JUDGED = ("phone-04", "phone-06", "phone-07", "phone-09", "phone-10")
WAVELENGTHS = (640, 785)
SIDE, RATE = 300, 15.0
# A change of the state must be noticed so soon, in seconds.
SOON = 0.5


@dataclass(frozen=True)
class Film:
    """Frames of one camera, its true places [T, 2] in them, times [T] in s, and whether it images [T] (0 to 1)."""

    name: str
    wavelength: int
    frames: list[Frame]
    places: npt.NDArray[np.float64]
    times: npt.NDArray[np.float64]
    imaging: npt.NDArray[np.float64]


def films(names: tuple[str, ...], seconds: float, seed: int) -> Iterator[Film]:
    """Film the main camera of each phone at each wavelength."""
    for number, name in enumerate(names):
        for wavelength in WAVELENGTHS:
            values = {"target.name": name, "illumination.wavelength": f"{wavelength} nm"}
            phone = with_values(load_scene("phones"), values)
            own = next(unit for unit in phone_scenes(phone) if unit.place == (0.0, 0.0))
            drawn = seed + 10 * number + wavelength
            imaging = Imaging.draw(seconds, np.random.default_rng(drawn), least=0.8, most=2.5)
            session = Session(seconds, RATE, drawn, imaging=imaging, motion=HandMotion(extent=0.2))
            shot = Shot(own.scene, session)
            truth = shot.truth().to_pydict()
            rows = [k for k, stream in enumerate(truth["stream"]) if stream == "probe"]
            x, y, images = (np.array([truth[key][k] for k in rows]) for key in ("x", "y", "imaging"))
            frames = list(shot.cameras["probe"])
            places = np.stack([x, y], 1)
            yield Film(name, wavelength, frames, places, shot.beats["probe"].times, images)


def learn(seconds: float, seed: int) -> None:
    """Print the share of each class of asymmetry, for each camera and state."""
    for film in films(LEARNED, seconds, seed):
        crops = (crop(frame.image, (x, y), SIDE) for frame, (x, y) in zip(film.frames, film.places, strict=True))
        found = [asymmetry(one, 255) for one in crops]
        for state, chosen in (("imaging", film.imaging > 0.99), ("idle", film.imaging < 0.01)):
            values = np.array([one.value for one, yes in zip(found, chosen, strict=True) if yes and one is not None])
            count = np.bincount(np.searchsorted(EDGES, values), minlength=len(EDGES) + 1)
            shares = ", ".join(f"{share:.3f}" for share in count / max(1, len(values)))
            print(
                f"{film.name} {film.wavelength} nm {state:8s} {len(values):3d} of {chosen.sum():3d} seen: {shares}",
                flush=True,
            )


def judge(seconds: float, seed: int) -> None:
    """Print how many answers were given and right, and how soon a camera that began to image was noticed."""
    total: dict[int, list[int]] = defaultdict(lambda: [0, 0, 0, 0, 0])
    for film in films(JUDGED, seconds, seed):
        told = [answer(rows) for rows in (one.rows for one in track(film.frames, activity=True))]
        images = film.imaging > 0.5
        changes = np.flatnonzero(np.diff(images.astype(int))) + 1
        settled = np.ones(len(images), bool)
        for change in changes:
            settled &= (film.times < film.times[change]) | (film.times >= film.times[change] + SOON)
        given = np.array([said is not None for said in told]) & settled
        right = np.array([said == state for said, state in zip(told, images, strict=True)]) & given
        began = [k for k in changes if images[k] and film.times[-1] > film.times[k] + SOON]
        soon = [
            any(told[j] for j in np.flatnonzero((film.times >= film.times[k]) & (film.times < film.times[k] + SOON)))
            for k in began
        ]
        row = [int(settled.sum()), int(given.sum()), int(right.sum()), len(began), sum(soon)]
        total[film.wavelength] = [a + b for a, b in zip(total[film.wavelength], row, strict=True)]
        print(f"{film.name} {film.wavelength} nm: {report(row)}", flush=True)
    for wavelength, row in total.items():
        print(f"all, {wavelength} nm: {report(row)}")


def answer(rows: Sequence[TrackRow]) -> bool | None:
    """What the brightest track of a frame says."""
    seen = [row for row in rows if row.seen]
    return max(seen, key=lambda row: row.snr or 0.0).active if seen else None


def report(row: list[int]) -> str:
    frames, given, right, began, soon = row
    noticed = f"{soon} of {began} beginnings noticed within {SOON} s"
    return f"{given} answers in {frames} frames, {right} of them right; {noticed}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("learn", "judge"))
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    (learn if given.what == "learn" else judge)(given.seconds, given.seed)
