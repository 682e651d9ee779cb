"""What one frame can tell at best: the bounds of gaze and focus against the laser's power (Cramér-Rao).

    .venv/bin/python examples/limits.py

The thin lens is turned by 0.5° and focused on the probe. Gaze, focus and the place of its retro-reflection are all
unknown. With little light the readout's noise decides, and the limits fall nearly as 1/power; with more the light's own
noise does, and they fall as 1/√power: half as large for four times the power.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import tapetum as tp
from tapetum.simulate.information import expected_electrons, fisher

UNKNOWN = ("gaze_x", "gaze_y", "object_distance", "place_x", "place_y")


def main(arguments: Sequence[str] | None = None) -> list[tuple[float, float, float, float]]:
    """Print the table; return its powers in watts, and the limits of both gazes and of the object distance."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--powers", type=float, nargs="+", default=[0.004, 0.016, 0.064, 0.25, 1, 4], help="milliwatts")
    parser.add_argument("--rotation", type=float, default=0.5, help="about x, degrees")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="any field of the scene")
    options = parser.parse_args(arguments)

    rows: list[tuple[float, float, float, float]] = []
    print(f"{'power':>9} {'peak':>10} {'gaze x':>9} {'gaze y':>9} {'focus':>10}")
    print(f"{'mW':>9} {'electrons':>10} {'field':>9} {'field':>9} {'mm':>10}")
    for power in options.powers:
        sensor = ["probe.sensor.bits=12", f"target.rotation=[0 deg, {options.rotation} deg]"]
        scene = tp.load_scene("thin-lens", [*sensor, *options.set, f"illumination.power={power} mW"])
        limit = fisher(scene, UNKNOWN).bounds
        peak = float(expected_electrons(scene, {}).max())
        rows.append((power * 1e-3, limit["gaze_x"], limit["gaze_y"], limit["object_distance"]))
        print(
            f"{power:>9g} {peak:>10.0f} {limit['gaze_x']:>9.1e} {limit['gaze_y']:>9.1e} "
            f"{limit['object_distance'] * 1e3:>10.3g}"
        )
    return rows


if __name__ == "__main__":
    main()
