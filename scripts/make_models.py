"""Make the bundled ResNet-18 (about half an hour on 2 cores; an interrupted run goes on where it stopped).

make models
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tapetum.cli.memory import keep_big_blocks
from tapetum.experiments.pretrain import EPOCHS, NAME, make_pretrained
from tapetum.progress import bar


def main() -> None:
    """Film, train, score, save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, default=Path("models-work"), help="keeps what a later run goes on from")
    parser.add_argument("--out", type=Path, default=Path("src/tapetum/models/pretrained") / NAME)
    parser.add_argument("--epochs", type=int, default=EPOCHS)
    options = parser.parse_args()
    keep_big_blocks()
    make_pretrained(options.work, options.out, epochs=options.epochs, progress=bar, on_epoch=print)


if __name__ == "__main__":
    main()
