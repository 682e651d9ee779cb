"""The paper's Fig. 4: how a retro-reflection changes with the target's rotation and with where it is focused.

.venv/bin/python examples/fig4.py -o fig4.png
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import tapetum as tp
from tapetum.report import fig_grid, save_figure


def main(arguments: Sequence[str] | None = None) -> Path:
    """Draw the grid; return where it is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("fig4.png"))
    parser.add_argument("--rotations", type=float, nargs="+", default=[0.0, 0.5, 1.0], help="degrees, about x")
    parser.add_argument("--distances", type=float, nargs="+", default=[1.0, 2.5, 5.0], help="focused at, metres")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="any field of the scene")
    options = parser.parse_args(arguments)

    rows, width = [], 0.0
    for distance in options.distances:
        scene = tp.load_scene("thin-lens", [*options.set, f"target.object_distance={distance}"])
        # All rotations in one call: the light's way to the target's sensor is computed once for them all.
        images = tp.retroreflect(scene, rotation=options.rotations)
        print(f"x_d = {distance:g} m: error within {images.metadata['expected_error']:.0e} of the peak")
        rows.append(images.numpy())
        width = images.irradiance.shape[-1] * images.pitch

    figure = fig_grid(
        np.stack(rows),
        row_labels=[f"{distance:g} m" for distance in options.distances],
        col_labels=[f"{rotation:g}°" for rotation in options.rotations],
        extent=width * 1e6,
    )
    save_figure(figure, options.out)
    print(f"open {options.out}")
    return options.out


if __name__ == "__main__":
    main()
