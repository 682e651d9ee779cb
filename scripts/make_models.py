"""Make the bundled ResNet-18 (about half an hour on 2 cores; an interrupted run goes on where it stopped).

make models

`--describe` keeps the weights and learns from the same films only where the model applies and how copies differ (some
minutes); `--units` keeps them and calibrates the intervals for copies of the camera (ten minutes).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tapetum.cli.memory import keep_big_blocks
from tapetum.experiments.pretrain import EPOCHS, NAME, calibrate_pretrained, describe_pretrained, make_pretrained
from tapetum.progress import bar


def main() -> None:
    """Film, train, score, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("models-work"), help="keeps what a later run goes on from")
    parser.add_argument("--out", type=Path, default=Path("src/tapetum/models/pretrained") / NAME)
    parser.add_argument("--epochs", type=int, default=EPOCHS)
    parser.add_argument(
        "--describe", action="store_true", help="learn only where the model applies and how copies differ"
    )
    parser.add_argument("--units", action="store_true", help="calibrate only the intervals for copies of the camera")
    options = parser.parse_args()
    keep_big_blocks()
    if options.describe:
        describe_pretrained(options.work, options.out, progress=bar)
        return
    if options.units:
        calibrate_pretrained(options.work, options.out, progress=bar)
        return
    make_pretrained(options.work, options.out, epochs=options.epochs, progress=bar, on_epoch=print)


if __name__ == "__main__":
    main()
