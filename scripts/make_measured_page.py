"""Write docs/measured.md, and the measured parts of docs/rooms.md, of the numbers in docs/numbers.

    .venv/bin/python scripts/make_measured_page.py

The texts are templates beside this script, NAME.md.j2. Which command measured what stands in the pages.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tapetum.experiments.templating import render_text
from tapetum.files import atomic_file

ROOT = Path(__file__).parents[1]
NUMBERS = ROOT / "docs" / "numbers"
ELSEWHERE = 20.0  # stated deviations, farther off a reading is at another maximum than the right one
# Each template, and what is made of it.
PAGES = {
    name: ROOT / "docs" / place
    for name, place in {
        "measured": "measured.md",
        "detection": "includes/detection.md",
        "room-films": "includes/room-films.md",
    }.items()
}
# Files of which the templates take their own; the others are gathered first.
WHOLE = (
    "copies-rotation",
    "copies-focusing",
    "phones-copies",
    "phones-copies-by-number",
    "other-units",
    "domain",
    "rotation-rates",
    "copy-prior",
    "detection",
    "room-films",
)
# What copies of the Rotation camera differ by, in words.
CAUSES = {
    "sensor_tilt": "tilt of the sensor",
    "decentre": "decentre of the lens",
    "aperture": "aperture",
    "focus": "focus",
    "beam_ratio": "second beam, ratio",
    "beam_angle": "second beam, angle",
    "reflectance": "reflectance of the sensor",
    "focal_length": "focal length",
}


def made() -> dict[str, str]:
    """Return every page or part of one, by its template's name."""
    told = context()
    return {
        name: render_text(Path(__file__).with_name(f"{name}.md.j2").read_text(encoding="utf-8"), told) for name in PAGES
    }


def context() -> dict[str, Any]:
    """Return all that the template names."""
    found: dict[str, Any] = {name.replace("-", "_"): _numbers(name) for name in WHOLE}
    found |= {"causes": CAUSES, "adapted": Adapted, "groups": groups, "twins": twins(_numbers("twin")["units"])}
    for name in ("known", "coarse"):
        found[f"{name}_scenes"] = readings(_numbers(f"{name}-scenes")["units"])
    for name in ("adapt", "adapt-changed", "adapt-lenses", "adapt-rotation"):
        found[name.replace("-", "_")] = _numbers(name)["rows"]
    return found | {"pair": pair, "pairs": percents, "guess": guess, "mean": mean, "recalled": recalled}


def mean(rows: Iterable[Sequence[float]]) -> list[float]:
    """Return the mean of rows [K]."""
    return np.mean(list(rows), axis=0).tolist()


def pair(values: Sequence[float], digits: int | None = None) -> str:
    """Write two errors, x / y, to two significant digits or so many decimal places."""
    if digits is None:
        if max(values) < 1e-3:
            return " / ".join(f"{value:.1e}".replace("e-0", "e-") for value in values)
        digits = max(1, 1 - int(np.floor(np.log10(min(values)))))
    return " / ".join(f"{value:.{digits}f}" for value in values)


def percents(values: Sequence[float]) -> str:
    """Write two shares, x / y."""
    return " / ".join(f"{100 * value:.0f}" for value in values) + " %"


def guess(errors: Sequence[float], guesses: Sequence[float]) -> str:
    """Say how errors compare with a guess's, along both axes."""
    ratios = [error / one for error, one in zip(errors, guesses, strict=True)]
    if min(ratios) >= 0.9:
        return "no better than a guess"
    low, high = (f"{100 * ratio:.0f}" for ratio in (min(ratios), max(ratios)))
    return f"{low} to {high} % of a guess's" if low != high else f"{low} % of a guess's"


class Adapted:
    """Rows of `measure_adapt.py` for one kind of camera and one way of learning, a row a copy.

    `mae` and `held` are means over the copies and `median` the median of their errors, of x and y each; `worst` is the
    row of the largest error.
    """

    def __init__(self, rows: Sequence[Mapping[str, Any]], **which: Any) -> None:
        """Keep the rows that are as `which` says; of words their beginning is enough, None stands for
        a missing entry."""
        self.rows = [row for row in rows if all(_like(row.get(name), value) for name, value in which.items())]
        if not self.rows:
            raise KeyError(f"no rows with {which}")
        units = [row["unit"] for row in self.rows]
        if len(set(units)) < len(units):
            raise KeyError(f"rows of {which} name a copy twice")
        self.units = units
        self.mae, self.held = (np.mean([row[name] for row in self.rows], axis=0).tolist() for name in ("mae", "held"))
        self.median = np.median([row["mae"] for row in self.rows], axis=0).tolist()
        self.held_both = float(np.mean(self.held))
        answered = [float(row["answered"]) for row in self.rows if "answered" in row]
        self.answered = float(np.mean(answered)) if len(answered) == len(self.rows) else None
        self.worst = max(self.rows, key=lambda row: sum(row["mae"]))
        self.processor = _range([row["processor_seconds"] for row in self.rows if row.get("processor_seconds")])

    def of(self, units: Sequence[int]) -> Adapted:
        """Return the same for some of the copies."""
        return Adapted([row for row in self.rows if row["unit"] in units])

    def shared(self, other: Adapted) -> list[tuple[Sequence[float], Sequence[float]]]:
        """Return the errors of both, copy by copy, of the copies that both have."""
        theirs = {row["unit"]: row["mae"] for row in other.rows}
        return [(row["mae"], theirs[row["unit"]]) for row in self.rows if row["unit"] in theirs]

    def better(self, other: Adapted) -> int:
        """Count the copies of both on which this one errs less along both axes."""
        return sum(a[0] < b[0] and a[1] < b[1] for a, b in self.shared(other))


def _range(seconds: Sequence[float]) -> str:
    """Write the least and the largest of some times."""
    digits = 1 if max(seconds, default=0) < 10 else 0
    return " to ".join(f"{pick(seconds):.{digits}f}" for pick in (min, max)) if seconds else "–"


def _like(value: Any, wanted: Any) -> bool:
    return value.startswith(wanted) if isinstance(value, str) and wanted else value == wanted


def recalled(found: Mapping[str, Any], but: Sequence[str]) -> float:
    """Return the share of frames of known phones that are recognised, some phones left out."""
    known = {name: found["frames_by_phone"][name] for name in found["recall"] if name not in but}
    return sum(found["recall"][name] * frames for name, frames in known.items()) / sum(known.values())


def groups(rows: Sequence[Mapping[str, Any]], name: str) -> list[Any]:
    """Return the values that an entry has, in the order in which they come."""
    return list(dict.fromkeys(row[name] for row in rows))


def twins(units: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Gather the twins of each kind: of how many parameters how far off, misfits, readings over the limit."""
    told: dict[str, Any] = {}
    for kind in ("thin", "traced"):
        own = sorted((unit for unit in units if unit["kind"] == kind), key=lambda unit: unit["seed"])
        off = {(unit["seed"], name): abs(value) for unit in own for name, value in unit["off"].items()}
        read = [unit for unit in own if "held" in unit]
        errors = np.concatenate([unit["errors"] for unit in read])
        (seed, name), worst = max(off.items(), key=lambda one: one[1])
        told[kind] = {
            "units": own,
            "parameters": len(off),
            "within": [sum(value <= most for value in off.values()) for most in (2, 3)],
            "worst": {"seed": seed, "name": name, "off": worst},
            "untold": sorted({one for unit in own for one in unit["untold"]}),
            "converged": sum(unit["converged"] for unit in own),
            "misfit": max(unit["misfit_lit"] for unit in own),
            "before": [pick(unit["before"] for unit in own) for pick in (min, max)],
            "over": [unit["read_over_limit"] for unit in own],
            "over_median": float(np.median([unit["read_over_limit"] for unit in own])),
            "seconds": [unit["seconds"] for unit in own],
            "mae": np.abs(errors).mean(axis=0).tolist(),
            "read": len(errors),
            "read_units": len(read),
            "elsewhere": {unit["seed"]: count for unit in read if (count := _elsewhere(unit))},
            "held": float(np.mean(np.concatenate([unit["held"] for unit in read]))),
            "networks": [unit for unit in own if "networks" in unit],
        }
    return told


def readings(units: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Gather readings through known scenes: how many, how many of them elsewhere, and errors over the limit."""
    over = [unit["read_over_limit"] for unit in units]
    return {
        "seeds": [unit["seed"] for unit in units],
        "read": sum(len(unit["errors"]) for unit in units),
        "elsewhere": sum(map(_elsewhere, units)),
        "farthest": float(np.abs(np.concatenate([unit["errors"] for unit in units])).max()),
        "misfit": max(max(unit["misfits"]) for unit in units),
        "held": float(np.mean(np.concatenate([unit["held"] for unit in units]))),
        "over": over,
        "over_median": float(np.median(over)),
    }


def _elsewhere(unit: Mapping[str, Any]) -> int:
    """Return how many readings of a unit are at another maximum than the right one."""
    return int((np.abs(unit["errors"]) > ELSEWHERE * np.array(unit["stated"])).any(axis=1).sum())


def _numbers(name: str) -> Any:
    return json.loads((NUMBERS / f"{name}.json").read_text(encoding="utf-8"))


def main() -> None:
    """Write them all."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for name, text in made().items():
        with atomic_file(PAGES[name]) as part:
            part.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
