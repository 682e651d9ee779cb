"""Files of JSON that others may have damaged: read strictly, refused in one line."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from tapetum.errors import InputError

__all__ = ["Checked", "check", "read_json"]


class Checked(BaseModel):
    """What a JSON file must hold: no text for a number, nothing infinite. Unknown keys pass, as of later versions."""

    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)


Schema = TypeVar("Schema", bound=BaseModel)


def _refused(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number")


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read a JSON file; NaN and infinities, which JSON does not know, are refused.

    Raises an OSError or a ValueError when it cannot be read, or is no JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"), parse_constant=_refused)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def check(schema: type[Schema], content: object, where: object, remedy: str) -> Schema:
    """Check plain values against a schema.

    Raises an InputError with the path of the first key that does not fit.
    """
    try:
        return schema.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(step) for step in first["loc"]) or "it"
        given = first.get("input")
        shown = "" if isinstance(given, dict | list) or first["type"] == "missing" else f", is {given!r:.40}"
        what = "is missing" if first["type"] == "missing" else first["msg"].replace("Input should", "must") + shown
        raise InputError(f"{key}: {what}", where=where, remedy=remedy) from error
