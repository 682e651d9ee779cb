"""Pages of results: a template and the numbers that were measured, and nothing else, make the text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from tapetum.experiments.page import filled, table_of
from tapetum.report.verdicts import MEAN, against_mean, intervals

__all__ = ["render", "render_text"]


def _number(value: float | None, digits: int = 3) -> str:
    """Write a number to some digits; a dash where there is none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def _percent(value: float | None, digits: int = 0) -> str:
    return "–" if value is None else f"{100 * value:.{digits}f} %"


def _listed(words: Sequence[str]) -> str:
    """Join words as a sentence does."""
    some = [str(word) for word in words]
    return some[0] if len(some) == 1 else f"{', '.join(some[:-1])} and {some[-1]}"


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("tapetum.experiments", "templates"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        # Markdown, not HTML; every value is ours.
        autoescape=False,
    )
    made.filters |= {"num": _number, "percent": _percent, "listed": _listed}
    made.globals |= {"MEAN": MEAN, "against_mean": against_mean, "intervals_are": intervals, "table": table_of}
    return made


def render(name: str, numbers: Mapping[str, Any]) -> str:
    """Return the page NAME.md of what NAME.json holds.

    Parameters
    ----------
    name
        Of the figure or table.
    numbers
        As the JSON file holds them.
    """
    return filled(_environment().get_template(f"{name}.md").render(numbers=numbers, **numbers))


def render_text(template: str, numbers: Mapping[str, Any]) -> str:
    """Return the page that a template's text makes of some numbers."""
    return filled(_environment().from_string(template).render(numbers=numbers, **numbers))
