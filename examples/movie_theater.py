"""Probes above the screen of a movie theater: illumination and SNR as even as they get over the audience.

.venv/bin/python examples/movie_theater.py -o constellation.png
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from tapetum.bench import ProbeSensor, Target, TargetSensor, ThinLens
from tapetum.report.figures import save_figure
from tapetum.report.figures.constellation import fig_constellation
from tapetum.simulate.constellation import (
    Evenness,
    ProbeKit,
    Rail,
    Volume,
    design,
    evenness,
    irradiance,
    signal,
    single_probe,
)

# Phones held 0.9 to 1.4 m above a floor that rises by a quarter, in rows 6 to 24 m from the screen.
SEATS = Volume((-7, 0.9, 6), (7, 1.4, 24), rake=0.25)
PHONE = Target(ThinLens(4e-3, 1e-3), object_distance=15.0, sensor=TargetSensor(reflectance=0.1))
KIT = ProbeKit(ProbeSensor(pixels=(2592, 1944), bits=12, exposure=1e-3, background=4))
RAIL = Rail((-6, 7, 0), (6, 7, 0))


def main(arguments: Sequence[str] | None = None) -> dict[str, tuple[Evenness, Evenness]]:
    """Draw the figure; return the evenness of illumination and SNR of each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("constellation.png"))
    parser.add_argument("--cap", type=float, default=1e-4, help="largest illumination, W/m²")
    parser.add_argument("--probes", type=int, default=48, help="at most so many")
    parser.add_argument("--samples", type=int, default=700, help="points that stand for the seats in the design")
    parser.add_argument("--margin", type=float, default=0.25, help="metres by which cones may be off in the design")
    options = parser.parse_args(arguments)

    found = design(
        SEATS,
        PHONE,
        KIT,
        RAIL,
        cap=options.cap,
        probes=options.probes,
        samples=options.samples,
        margin=options.margin,
        snr_weight=0.5,
    )
    count = len(found.constellation.probes)
    cases = {
        "One probe": single_probe(SEATS, KIT, (0, 7, 0), cap=options.cap),
        f"{count} probes": found.constellation,
    }
    points = SEATS.sample(6000, 17)
    results: dict[str, tuple[Evenness, Evenness]] = {}
    for name, case in cases.items():
        light = evenness(irradiance(case, points).sum(axis=1))
        snr = evenness(signal(case, PHONE, points).combined)
        results[name] = light, snr
        power = sum(probe.power for probe in case.probes)
        print(
            f"{name}: {power * 1e3:.3g} mW in all; illumination {light.low * 1e6:.3g} to {light.high * 1e6:.3g} µW/m²,"
            f" mean {light.mean * 1e6:.3g}, ratio {light.ratio:.3g};"
            f" SNR {snr.low:.3g} to {snr.high:.3g}, mean {snr.mean:.3g}, ratio {snr.ratio:.3g}"
        )
    save_figure(fig_constellation(cases, SEATS, PHONE), options.out)
    print(f"open {options.out}")
    return results


if __name__ == "__main__":
    main()
