"""Where does this camera look? Fitted by the simulator itself, with no training at all.

    .venv/bin/python examples/fit_by_simulation.py

A thin lens is turned before the probe, and a few frames are taken with the sensor's noise. The fit knows the scene, but
neither the gaze, nor the laser's power, nor where the retro-reflection lies. Its 90 % intervals follow from
each fit's own covariance; the Cramér-Rao bound says that no unbiased estimate could be much better.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

import tapetum as tp
from tapetum.models.simulation.fit import SimulationFit
from tapetum.simulate.information import fisher, true_values

UNKNOWN = ("gaze_x", "gaze_y", "power", "place_x", "place_y")


def main(arguments: Sequence[str] | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Print the table; return true gazes [N, 2], estimates, half-widths of their intervals, and bounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rotations", nargs="+", default=["0.3,0.2", "-0.5,0.1", "0.1,-0.4"], help="degrees: X,Y")
    parser.add_argument("--seed", type=int, default=1, help="of the sensor's noise")
    options = parser.parse_args(arguments)

    model = SimulationFit(tp.load_scene("hand-held"), starts=2)
    rows: list[tuple[list[float], ...]] = []
    print(f"{'rotation':>12} {'axis':>5} {'gaze':>9} {'fitted':>9} {'90 %':>9} {'bound':>9}")
    for number, rotation in enumerate(options.rotations):
        x, y = (float(one) for one in rotation.split(","))
        scene = tp.load_scene("hand-held", [f"target.rotation=[{x} deg, {y} deg]"])
        frame = tp.expose(tp.retroreflect(scene), scene.probe, seed=options.seed + number)
        found = model.predict(frame)
        true, limit = true_values(scene, UNKNOWN[:2]), fisher(scene, UNKNOWN).bounds
        half = (found.upper - found.lower)[0] / 2
        rows.append((list(true.values()), found.value[0].tolist(), half.tolist(), [limit[n] for n in UNKNOWN[:2]]))
        for k, name in enumerate(UNKNOWN[:2]):
            where = rotation if k == 0 else ""
            print(f"{where:>12} {name[-1]:>5} {rows[-1][0][k]:>9.5f} {rows[-1][1][k]:>9.5f}", end="")
            print(f" {'±':>3}{half[k]:.5f} {rows[-1][3][k]:>9.1e}")
    true, value, half, bound = (np.array(one) for one in zip(*rows, strict=True))
    return true, value, half, bound


if __name__ == "__main__":
    main()
