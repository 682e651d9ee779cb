"""Settings of all dataclasses of the bench: no unknown keys, no infinite values."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, ConfigDict, Field

from tapetum.bench.quantity import Length

__all__ = ["STRICT", "Positive", "Share"]

_SMALLEST = 1e-9


def _above_smallest(length: float) -> float:
    if length < _SMALLEST:
        raise ValueError(f"{length:g} m is smaller than a nanometre; give at least 1e-9")
    return length


STRICT = ConfigDict(extra="forbid", allow_inf_nan=False, ser_json_inf_nan="strings")
# No distance here exceeds a million kilometres; smaller numbers than the lower bound overflow when inverted.
Positive = Annotated[Length, Field(gt=0, le=1e9), AfterValidator(_above_smallest)]
Share = Annotated[float, Field(ge=0, le=1)]
