"""Table 1 at several sizes in one table: what a smaller set and a shorter training cost."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from tapetum.experiments.page import table_of

__all__ = ["between", "side_by_side"]


def side_by_side(tables: Sequence[Mapping[str, Any]]) -> str:
    """Write the errors of several table1.json as one table in Markdown.

    Parameters
    ----------
    tables
        Each with `size`, `version`, `date`, `rows` as `table1.json` has them, and `classes` with `top_1` and
        `frames`. A row that one of them lacks becomes a dash there.

    Returns
    -------
    str
        A row for each task and model: MAE, and in brackets that of predicting the training part's mean. An error that
        is not below the mean's is marked as worse.
    """
    rows = [{(row["task"], row["model"]): row for row in one["rows"]} for one in tables]
    keys = list(dict.fromkeys(key for one in rows for key in one))
    lines = [(*key, *(_cell(one.get(key)) for one in rows)) for key in keys]
    classes = [one.get("classes") for one in tables]
    told = ["–" if one is None else f"{100 * one['top_1']:.1f} % of {one['frames']}" for one in classes]
    if any(classes):
        lines.append(("phones identified, top-1", "ResNet-18", *told))
    heads = [f"`{one['size']}`: MAE (the mean's)" for one in tables]
    made = "; ".join(f"`{one['size']}`: Tapetum {one['version']}, {one['date']}" for one in tables)
    return f"{table_of(('task', 'model', *heads), lines)}\n\n*{made}.*"


def between(text: str, name: str, block: str) -> str:
    """Return a document with what stands between `<!-- NAME -->` and `<!-- end NAME -->` replaced.

    Raises
    ------
    ValueError
        When it does not hold exactly one such pair.
    """
    begin, end = f"<!-- {name} -->", f"<!-- end {name} -->"
    pattern = re.compile(rf"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise ValueError(f"expected one pair of markers {begin} … {end}")
    return pattern.sub(lambda _: f"{begin}\n{block}\n{end}", text)


def _cell(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "–"
    verdict = "" if row["mae"] < row["guess_mae"] else ", no better than the mean"
    return f"{row['mae']:.3g} ({row['guess_mae']:.3g}{verdict}) {_UNITS.get(row['unit'], row['unit'])}".rstrip()


_UNITS = {"fraction of the field": ""}
