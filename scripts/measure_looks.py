"""How often a camera of ours is known by its look, and how often another is taken for it: `measure_looks.py SEED...`.

On the virtual bench: copies of one thin lens, other thin lenses, and phones, two copies each; each filmed three times
in a hand 5.5 m away: as it was when it was named as ours; elsewhere, in another motion; and turned farther, a little
nearer. Every camera is named once, and every other plays the stranger.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tapetum.bench import Scene, draw_unit, load_scene, with_values
from tapetum.files import atomic_file
from tapetum.live.look import look, resembles
from tapetum.record.motion import HandMotion
from tapetum.record.session import Session
from tapetum.record.shot import Shot
from tapetum.simulate.phone import phone_scenes
from tapetum.track import track

COPIES = 4
LENSES = ((75, 4, 5.5), (100, 3, 5.5), (100, 4, 3.0), (150, 6, 5.5))  # mm, mm, m
PHONES = ("phone-01", "phone-05")
TAKES = {"named": (0.2, 5.5), "moved": (0.2, 5.5), "turned": (0.4, 5.2)}
SECONDS, RATE, AT_ONCE = 5.0, 4.0, 5


@dataclass(frozen=True)
class Looks:
    """The looks [N, numbers] of a camera in each take, by its kind and name."""

    kind: str
    name: str
    takes: dict[str, npt.NDArray[np.float64]]


def cameras(seed: int) -> Iterator[tuple[str, str, Scene]]:
    """Yield the kind, the name and the scene of each camera."""
    base = load_scene("hand-held")
    for k in range(COPIES):
        yield "copy", f"copy {k}", draw_unit(base, None, 100 * seed + k)
    for focal, radius, focus in LENSES:
        values = {
            "target.lens.focal_length": f"{focal} mm",
            "target.lens.aperture_radius": f"{radius} mm",
            "target.object_distance": f"{focus} m",
        }
        yield "lens", f"{focal} mm r {radius} at {focus}", draw_unit(with_values(base, values), None, 100 * seed + 50)
    for name in PHONES:
        values = {"target.name": name, "illumination.wavelength": "640 nm"}
        for copy in range(2):
            scene = draw_unit(with_values(load_scene("phones"), values), None, 100 * seed + 60 + copy)
            yield "phone", f"{name} copy {copy}", next(one.scene for one in phone_scenes(scene) if one.place == (0, 0))


def filmed(scene: Scene, seed: int, extent: float, metres: float) -> npt.NDArray[np.float64]:
    """Return the looks of the brightest track of a film."""
    scene = with_values(scene, {"distance": f"{metres} m"})
    shot = Shot(scene, Session(SECONDS, RATE, seed, motion=HandMotion(extent=extent)))
    frames = list(shot.cameras["probe"])
    found = []
    for frame, tracked in zip(frames, track(frames), strict=True):
        rows = [row for row in tracked.rows if row.seen and row.diameter]
        if rows:
            best = max(rows, key=lambda row: row.snr or 0.0)
            one = look(frame.image, best.x, best.y, best.diameter or 0.0, float(frame.full_scale or 255))
            found += [] if one is None else [one]
    return np.array(found).reshape(len(found), -1)


def looks_of(number: int, kind: str, name: str, scene: Scene, seed: int, keep: Path) -> Looks:
    """Film a camera, or read what was kept of it."""
    place = keep / f"{seed}-{number}.npz"
    if not place.exists():
        takes = {
            take: filmed(scene, 1000 * seed + 10 * number + k, extent, metres)
            for k, (take, (extent, metres)) in enumerate(TAKES.items())
        }
        keep.mkdir(parents=True, exist_ok=True)
        with atomic_file(place) as part:
            np.savez(part, **takes)  # pyright: ignore[reportArgumentType]
        print(f"{name}: {', '.join(f'{len(one)} looks {take}' for take, one in takes.items())}", flush=True)
    with np.load(place) as kept:
        return Looks(kind, name, {take: kept[take] for take in TAKES})


def rate(ours: Looks, other: Looks, take: str, tolerance: float) -> tuple[int, int]:
    """Return in how many of the windows of a take the other passes for ours, and how many there are."""
    known, seen = ours.takes["named"], other.takes[take]
    if len(known) < AT_ONCE or len(seen) < AT_ONCE:
        return 0, 0
    windows = [seen[k : k + AT_ONCE] for k in range(len(seen) - AT_ONCE + 1)]
    return sum(resembles(one.tolist(), known, tolerance) for one in windows), len(windows)


def table(seeds: list[list[Looks]], tolerances: list[float]) -> None:
    """Print how often ours is known, and how often strangers are, by kind, in all seeds."""
    print("| tolerance | ours, moved | ours, turned | another copy | another lens | another kind |")
    print("|---|---|---|---|---|---|")
    for tolerance in tolerances:
        cells: dict[str, list[int]] = {name: [0, 0] for name in ("moved", "turned", "copy", "lens", "kind")}
        for ours, other in itertools.chain.from_iterable(itertools.product(looks, looks) for looks in seeds):
            if ours is other:
                names = {"moved": "moved", "turned": "turned"}
            else:
                same = ours.name.partition(" copy")[0] == other.name.partition(" copy")[0]
                alike = ours.kind == other.kind == "copy" or (ours.kind == other.kind == "phone" and same)
                named = "copy" if alike else "kind" if "phone" in (ours.kind, other.kind) else "lens"
                names = {"moved": named, "turned": named}
            for take, cell in names.items():
                told = rate(ours, other, take, tolerance)
                cells[cell] = [cells[cell][0] + told[0], cells[cell][1] + told[1]]
        print(f"| {tolerance:g} | " + " | ".join(f"{a / max(b, 1):.3f} of {b}" for a, b in cells.values()) + " |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", nargs="*", type=int, default=[1])
    parser.add_argument(
        "--keep", type=Path, required=True, help="folder of looks, a file a camera: a later run goes on"
    )
    parser.add_argument("--tolerances", nargs="+", type=float, default=[0.5, 0.75, 1.0, 1.25, 1.5, 2.0])
    parser.add_argument("--only", nargs="+", type=int, help="numbers of the cameras, from 0; default: all")
    given = parser.parse_args()
    whole: list[list[Looks]] = []
    for seed in given.seeds:
        chosen = [(k, *one) for k, one in enumerate(cameras(seed)) if given.only is None or k in given.only]
        whole.append([looks_of(*one, seed, given.keep) for one in chosen])
    table(whole, given.tolerances)
