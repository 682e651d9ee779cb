"""Measure what a last layer gains where its correction may begin from what copies of the camera differ by.

    .venv/bin/python scripts/measure_copy_prior.py WORK UNIT …

WORK is the folder of scripts/measure_adapt.py with its films of copies of `hand-held`; what is lacking is filmed. The
bundled network's last layer is corrected by 2, 5 and 10 s of each copy, as `tapetum.models.adapt` corrects it before it
trains all layers: once by ridge regression alone, once with corrections that begin from copies beside it. The errors on
the test part go to docs/numbers/copy-prior.json.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from measure_adapt import NAMES, filmed, shared
from tapetum.files import atomic_file
from tapetum.memory import keep_big_blocks
from tapetum.models import pretrained
from tapetum.models.base import training_part
from tapetum.models.copy_prior import CopyPrior
from tapetum.models.fine_tuning import Adaptation
from tapetum.models.network import NetworkEstimator
from tapetum.progress import quiet

KIND, FILM, SECONDS = "another unit", 130.0, (2.0, 5.0, 10.0)


def corrected_by(base: NetworkEstimator, film: xr.Dataset, seconds: float) -> dict[str, Any]:
    """Return the error of a corrected last layer on the test part, by axis, and which correction was chosen."""
    part = training_part(shared(film, seconds, True), base.target_names, 0.0)
    work = Adaptation.begin(base, part, True, None, 0, "float32", "cpu", quiet, None, False)
    asides = [work.folds == fold for fold in np.unique(work.folds)]
    _, how = work.last_layer(asides, [work.apart(aside) for aside in asides])
    test = film.tp.test
    features = base.run(base.network_.features, base.read(test)[0], torch.device("cpu"))
    found = work.head(np.arange(len(work.targets)), how)(features) * work.spread_of + part.targets.mean(axis=0)
    return {"mae": np.abs(found - test.tp.values(NAMES)).mean(axis=0).tolist(), "chosen": str(how)}


def main(work: Path, units: list[int]) -> None:
    base = pretrained("thin-lens-gaze")
    assert isinstance(base, NetworkEstimator) and isinstance(base.prior_, CopyPrior)
    base.device, known, rows = "cpu", base.prior_, list[dict[str, Any]]()
    for unit in units:
        film = filmed(work, KIND, unit, FILM)
        for seconds in SECONDS:
            for name, prior in (("ridge alone", None), ("copies too", known)):
                base.prior_ = prior
                rows.append({"unit": unit, "seconds": seconds, "from": name, **corrected_by(base, film, seconds)})
                print(rows[-1], flush=True)
    for seconds in SECONDS:
        for name in ("ridge alone", "copies too"):
            errors = [row["mae"] for row in rows if (row["seconds"], row["from"]) == (seconds, name)]
            print(f"{seconds:g} s, {name}: {np.round(np.mean(errors, axis=0), 4)}")
    with atomic_file(Path("docs/numbers/copy-prior.json")) as part:
        part.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("units", type=int, nargs="+")
    options = parser.parse_args()
    keep_big_blocks()
    main(options.work, options.units)
