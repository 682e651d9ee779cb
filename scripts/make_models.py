"""Make the bundled ResNet-18; an interrupted run goes on where it stopped.

make models

That takes a quarter of an hour on 16 cores and a GPU, hours on two cores. `--quick` makes a lesser one, from fewer
films of copies and in fewer epochs, in about half an hour of two cores.

`--describe` keeps the weights and learns from the same films only where the model applies and how copies differ (some
minutes); `--units` keeps them and calibrates the intervals for copies of the camera (ten minutes).
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from tapetum.experiments.pretrain import (
    BUNDLED,
    NAME,
    QUICK,
    calibrate_pretrained,
    describe_pretrained,
    make_pretrained,
)
from tapetum.memory import keep_big_blocks
from tapetum.progress import bar


def main() -> None:
    """Film, train, score, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("models-work"), help="keeps what a later run goes on from")
    parser.add_argument("--out", type=Path, help="by default the package's own folder, with --quick one in --work")
    parser.add_argument("--quick", action="store_true", help="make a lesser model")
    parser.add_argument(
        "--describe", action="store_true", help="learn only where the model applies and how copies differ"
    )
    parser.add_argument("--units", action="store_true", help="calibrate only the intervals for copies of the camera")
    parser.add_argument("--device", default="auto", help="that trains: auto, cpu or cuda")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="that film at the same time")
    options = parser.parse_args()
    keep_big_blocks()
    out = options.out or (options.work / "quick" if options.quick else Path("src/tapetum/models/pretrained") / NAME)
    ways = {"processes": options.processes, "progress": bar}
    if options.describe:
        describe_pretrained(options.work, out, **ways)
        return
    if options.units:
        calibrate_pretrained(options.work, out, **ways)
        return
    recipe = QUICK if options.quick else BUNDLED
    make_pretrained(options.work, out, recipe=recipe, device=options.device, on_epoch=print, **ways)


if __name__ == "__main__":
    main()
