"""A twin of a camera: fitted to its labelled recording, then used to read its frames and to film a training set.

    .venv/bin/python examples/twin.py

The camera is a unit that the bench draws from tolerances, and that the fit does not know. Its recording is short, its
probe small, so that this takes a minute or two: `tapetum twin` does the same for a recording of your own.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import tapetum as tp
from tapetum.bench import draw_unit
from tapetum.calibrate.twin import Twin, fit_twin
from tapetum.calibrate.twin.page import shown
from tapetum.data import open_dataset
from tapetum.data.synth import make_plan, synthesise
from tapetum.models import SimulationFit
from tapetum.record import Session, film, label_recording
from tapetum.simulate.information import true_values

SMALL = (
    "probe.sensor.pixels=[128, 128]",
    "probe.sensor.pitch=4.4 um",
    "illumination.power=12 uW",
    "sampling.accuracy=0.05",
    "second_beam=null",
)
FREE = ("focus", "aperture", "tilt", "light", "background")


def main(arguments: Sequence[str] | None = None) -> tuple[Twin, np.ndarray, int]:
    """Print all; return the twin, the error [2] of a reading in deviations, and the number of frames filmed of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--unit", type=int, default=5, help="number of the unit")
    parser.add_argument("--page", help="write the twin's page to this HTML file")
    options = parser.parse_args(arguments)

    nominal = tp.load_scene("hand-held", SMALL)
    unit = draw_unit(nominal, None, options.unit)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        recording = film(unit, place / "unit.rec", Session(3.0, 15.0, seed=2, target_rate=60.0))
        label_recording(recording)
        # Focal length and decentre of the unit are left at the scene's values here, and the rest makes up for them.
        found = fit_twin(recording.path, nominal, free=FREE, frames=20, starts=1)
        print(f"misfit {found.misfit_lit:.2f}, {found.before.misfit_lit:.2f} as the scene was")
        for one in found.parameters:
            values = f"{shown(one, one.before):>16} -> {shown(one, one.value):>16} ± {shown(one, one.deviation)}"
            print(f"  {one.name:<18} {values}")
        if options.page:
            found.write_page(options.page)

        # The twin reads a new frame of the unit directly ...
        turned = tp.load_scene("hand-held", [*SMALL, "target.rotation=[0.3 deg, 0.2 deg]"]).target.rotation
        before = dataclasses.replace(unit, target=dataclasses.replace(unit.target, rotation=turned))
        frame = tp.expose(tp.retroreflect(before), before.probe, seed=9)
        read = SimulationFit(found.scene, starts=2, nodes=9, systematic=found.systematic).predict(frame)
        truth = np.array(list(true_values(before, ("gaze_x", "gaze_y")).values()))
        deviation = (read.upper - read.lower)[0] / 2 / 1.645
        off = (read.value[0] - truth) / deviation
        print(f"a frame of the unit: gaze {np.round(read.value[0], 4)}, truth {np.round(truth, 4)}")

        # ... and films a training set, without one further frame of it.
        plan = make_plan("rotation", "small", scene=found.scene)
        synthesise(dataclasses.replace(plan, videos=plan.videos[:2]), place / "twin.zarr")
        dataset = open_dataset(place / "twin.zarr")
        count = dataset.tp.train.sizes["frame"]
        print(
            f"{count} frames of the twin to train on; `tapetum dataset synth --size laptop` films enough to learn from"
        )
    return found, off, count


if __name__ == "__main__":
    main()
