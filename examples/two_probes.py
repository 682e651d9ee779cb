"""Two probes side by side watch one camera: what smoothing and fusing their readings gains. Simulation only.

    .venv/bin/python examples/two_probes.py

The scene `hand-held` is filmed twice with the same motion, as each of two probes 0.24 m apart would film it. Where the
laser of one falls beside the target's sensor, it gets no answer; the other one still does. The bundled model reads
both, each is smoothed over time, and the two are fused by their intervals.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

import tapetum as tp
from tapetum.bench import Scene
from tapetum.models import pretrained
from tapetum.record import Frame, HandMotion, Session
from tapetum.record.motion import Hand
from tapetum.record.shot import Shot
from tapetum.track import track_schema
from tapetum.track.fuse import fuse_tracks
from tapetum.track.places import Places
from tapetum.track.smooth import smooth_tracks

Array = NDArray[np.float64]
GAZE = ("gaze_x", "gaze_y")


@dataclass(frozen=True)
class Seen(Hand):
    """A motion as a probe sees it that stands elsewhere."""

    probe: int = 0
    places: Places | None = None

    def gaze(self, times: Array) -> Array:
        held = super().gaze(times)
        return held if self.places is None else self.places.from_first(self.probe, held)


@dataclass(frozen=True)
class SeenBy:
    """Draws the same motion for every probe, whatever the seed of its noise."""

    held: HandMotion
    places: Places
    probe: int
    seed: int

    def draw(self, seed: int, distance: float = 1.0, seconds: float = 60.0) -> Hand:
        del seed
        return Seen(**vars(self.held.draw(self.seed, distance, seconds)), probe=self.probe, places=self.places)

    def as_dict(self) -> dict[str, object]:
        return self.held.as_dict()


def film(scene: Scene, motion: SeenBy, seconds: float) -> tuple[pa.Table, Array, Array]:
    """Return the tracks of one probe's frames, the times of all of them, and the gaze that it sees in them."""
    session = Session(seconds=seconds, seed=motion.seed + motion.probe, motion=cast(HandMotion, motion))
    shot = Shot(scene, session)
    times = shot.beats["probe"].times
    gaze = motion.draw(0).gaze(times)

    def frames() -> Iterator[Frame]:
        for n, time in enumerate(times):
            # The bench's sensors have no end; a real one returns nothing of light that falls beside it.
            if np.abs(gaze[n]).max() < 0.5:
                yield Frame(n, float(time), shot.probe(n, n + 1)[0])

    schema, model = track_schema(), pretrained()
    # The scene is the one that it was trained on; frames alone do not say so.
    model.whose = "own"
    rows = [row.record() for one in tp.track(frames(), model=model) for row in one.rows]
    table = pa.Table.from_pylist([{name: row.get(name) for name in schema.names} for row in rows], schema=schema)
    return table, times, gaze


def errors(table: pa.Table, times: Array, truth: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return times [N], errors [N, 2], and which intervals [N, 2] hold the truth, of rows that have an estimate."""
    columns = {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names if "gaze" in name}
    at = table["time"].to_numpy()
    right = np.stack([np.interp(at, times, truth[:, k]) for k in (0, 1)], axis=1)
    value, low, high = (np.stack([columns[name + end] for name in GAZE], axis=1) for end in ("", "_low", "_high"))
    told = np.isfinite(value).all(axis=1)
    return at[told], (value - right)[told], ((low <= right) & (right <= high))[told]


def main(arguments: Sequence[str] | None = None) -> dict[str, tuple[float, int, float]]:
    """Print the table; return of each row its RMSE, the frames answered, and the share of intervals that hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--apart", type=float, default=0.24, help="metres between the probes")
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--seed", type=int, default=401)
    options = parser.parse_args(arguments)

    scene = tp.load_scene("hand-held")
    sensor, f = scene.target.sensor, scene.target.lens.focal_length
    field = (
        2 * math.atan(sensor.pixels[0] * sensor.pitch / 2 / f),
        2 * math.atan(sensor.pixels[1] * sensor.pitch / 2 / f),
    )
    # The hand holds the target towards the middle between the probes.
    half = options.apart / 2
    around = Places(((0.0, 0.0), (-half, 0.0), (half, 0.0)), scene.distance, field)
    filmed = [film(scene, SeenBy(HandMotion(), around, n, options.seed), options.seconds) for n in (1, 2)]
    places = Places(((0.0, 0.0), (options.apart, 0.0)), scene.distance, field)

    raw = [table for table, _, _ in filmed]
    smooth = [smooth_tracks(table) for table in raw]
    cases = {"left probe": (raw[0], 0), "right probe": (raw[1], 1), "both fused": (fuse_tracks(raw, places).table, 0)}
    cases |= {"left, smoothed": (smooth[0], 0), "right, smoothed": (smooth[1], 1)}
    cases |= {"smoothed, fused": (fuse_tracks(smooth, places).table, 0)}

    times = filmed[0][1]
    aside = np.abs(HandMotion().draw(options.seed).gaze(times)[:, 0])
    print(f"RMSE of gaze in fractions of the field (frames answered), {len(times)} frames, by where the target looks")
    print(f"{'':<16}{'inner third':>16}{'middle third':>16}{'outer third':>16}{'all':>16}{'in interval':>12}")
    results: dict[str, tuple[float, int, float]] = {}
    for name, (table, probe) in cases.items():
        at, error, held = errors(table, filmed[probe][1], filmed[probe][2])
        third = np.minimum(np.interp(at, times, aside) * 6, 2.999).astype(int)
        cells = [error[third == n] for n in range(3)] + [error]
        told = [f"{np.sqrt(np.mean(one**2)):.4f} ({len(one)})" if len(one) else "(0)" for one in cells]
        print(f"{name:<16}" + "".join(f"{one:>16}" for one in told) + f"{held.mean():>12.2f}")
        results[name] = float(np.sqrt(np.mean(error**2))), len(error), float(held.mean())
    return results


if __name__ == "__main__":
    main()
