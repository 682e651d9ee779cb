"""What all dataclasses of the bench share: nothing unknown, nothing infinite."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from tapetum.bench.quantity import Length

__all__ = ["STRICT", "Positive", "Share"]

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False, ser_json_inf_nan="strings")
Positive = Annotated[Length, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]
