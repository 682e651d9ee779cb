"""Pages of results in Markdown, from templates and measured numbers."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from tapetum.experiments.measure import PowerLaw
from tapetum.report.verdicts import MEAN, against_mean, intervals

__all__ = ["filled", "render", "render_text", "table_of"]


def table_of(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a table in Markdown."""
    lines = [names, ["---"] * len(names), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def filled(page: str) -> str:
    """Wrap a page's paragraphs and list items at one width; headings, pictures, tables and code stay unchanged."""
    done: list[str] = []
    for block in re.split(r"\n{2,}", page.strip()):
        if block[0] in "#!|" or block.startswith("    "):
            done.append(block)
            continue
        points = [" ".join(point.split()) for point in re.split(r"\n(?=- )", block)]
        indent = "  " if block.startswith("- ") else ""
        fill = textwrap.TextWrapper(120, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False).fill
        done.append("\n".join(fill(point) for point in points))
    return "\n\n".join(done) + "\n"


def _number(value: float | None, digits: int = 3) -> str:
    """Write a number to some digits; a dash for None."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def _percent(value: float | None, digits: int = 0) -> str:
    return "–" if value is None else f"{100 * value:.{digits}f} %"


def _listed(words: Sequence[str]) -> str:
    """Join words as a sentence does."""
    some = [str(word) for word in words]
    return some[0] if len(some) == 1 else f"{', '.join(some[:-1])} and {some[-1]}"


def _over(values: Sequence[float], others: Sequence[float]) -> list[float]:
    return [a / b for a, b in zip(values, others, strict=True)]


_FILTERS: dict[str, Callable[..., object]] = {
    "num": _number,
    "percent": _percent,
    "listed": _listed,
    "exponent": lambda law: PowerLaw(**law).words,
    "fmt": format,
    "over": _over,
    "fold": lambda values: max(values) / min(values),
    "span": lambda values: max(values) - min(values),
    "apart": lambda values, others: max(abs(a - b) for a, b in zip(values, others, strict=True)),
    "falls": lambda values: all(b < a for a, b in pairwise(values)),
}


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("tapetum.experiments", "templates"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        # Markdown needs no HTML escaping; no value is user input.
        autoescape=False,
    )
    made.filters |= _FILTERS
    made.globals |= {"MEAN": MEAN, "against_mean": against_mean, "intervals_are": intervals, "table": table_of}
    return made


def render(name: str, numbers: Mapping[str, Any]) -> str:
    """Return the page NAME.md from the numbers of NAME.json."""
    return filled(_environment().get_template(f"{name}.md").render(numbers=numbers, **numbers))


def render_text(template: str, numbers: Mapping[str, Any]) -> str:
    """Render a template's text with numbers."""
    return filled(_environment().from_string(template).render(numbers=numbers, **numbers))
