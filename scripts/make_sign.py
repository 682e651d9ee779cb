"""Remake the tables and the pictures of docs/sign.md.

    .venv/bin/python scripts/make_sign.py [thin] [phone] [slope] [picture] [flash]

Writes tables to build/sign-thin.md, build/sign-phone.md, build/sign-slope.md and build/flash.md, pictures to
docs/images/sign.png and docs/images/flash.png. Some minutes on two cores.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from flash import fig_flash, flash, flash_table
from sign_causes import (
    by_direction,
    direction_table,
    fig_sign_causes,
    markdown,
    phone_target,
    sign_causes,
    sloped_scene,
    thin_target,
)
from tapetum.bench import load_scene
from tapetum.files import atomic_file
from tapetum.report.figures import save_figure

ROOT = Path(__file__).parents[1]
PARTS = ("thin", "phone", "slope", "picture", "flash")
SHOWN = ("nothing", "second beam", "array and microlenses", "sensor tilt")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all by default")
    wanted = parser.parse_args().parts or list(PARTS)
    if unknown := set(wanted) - set(PARTS):
        parser.error(f"{', '.join(sorted(unknown))}: no part of the page; choose of {', '.join(PARTS)}")
    (ROOT / "build").mkdir(exist_ok=True)
    for name, made in (("thin", thin_target), ("phone", phone_target)):
        if name in wanted:
            rows = []
            for row in sign_causes(made()):
                rows.append(row)
                print(f"{row.cause.name}: {', '.join(f'{value:.3g}' for value in row.dprime.tolist())}", flush=True)
            with atomic_file(ROOT / "build" / f"sign-{name}.md") as path:
                path.write_text(markdown(rows), encoding="utf-8")
    if "slope" in wanted:
        scene = sloped_scene()
        slope = scene.target.sensor.tilt
        straight = sloped_scene({"target.sensor.tilt": [0, 0]})
        # At 1e-2 the simulation's own error shows the sign of a sensor that is not tilted: 30 in place of 14.
        columns = {"tilted": by_direction(scene, slope, 2e-3), "not tilted": by_direction(straight, slope, 2e-3)}
        with atomic_file(ROOT / "build" / "sign-slope.md") as path:
            path.write_text(direction_table(columns), encoding="utf-8")
    if "picture" in wanted:
        save_figure(fig_sign_causes(phone_target(), SHOWN), ROOT / "docs" / "images" / "sign.png")
    if "flash" in wanted:
        seen = flash(load_scene("phones"))
        with atomic_file(ROOT / "build" / "flash.md") as path:
            path.write_text(flash_table(seen), encoding="utf-8")
        save_figure(fig_flash(seen), ROOT / "docs" / "images" / "flash.png")


if __name__ == "__main__":
    main()
