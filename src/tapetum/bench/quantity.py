"""Convert physical quantities such as `640 nm`, `1 mW`, `0.5 deg` to SI numbers."""

from __future__ import annotations

import math
import numbers
import re
from functools import cache
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, WithJsonSchema

__all__ = ["Angle", "Current", "FocusDistance", "Length", "Power", "Time", "Vergence", "to_si"]


# A number and a unit only: Pint would evaluate any formula, and `9**9**9 m` would never end.
_QUANTITY = re.compile(
    r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*(1?\s*/\s*)?([^\W\d]|[°%])[^\d+]{0,40}([\^*-]?\d)?\s*"
)
_LONGEST = 80
# A number and one of the usual units, which wait for no Pint; with the factors to SI that Pint has (tests).
_PLAIN = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([A-Za-zµ°]+)\s*")
_USUAL = {
    "m": {"nm": 1e-9, "um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3},
    "rad": {"urad": 1e-6, "mrad": 1e-3, "rad": 1.0, "deg": math.pi / 180, "°": math.pi / 180},
    "W": {"uW": 1e-6, "mW": 1e-3, "W": 1.0},
    "s": {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0},
}


@cache
def _registry() -> Any:
    # Pint takes 0.4 s to import and set up, so only quantities with a rare unit load it.
    import pint

    return pint.UnitRegistry()


def to_si(value: object, unit: str) -> float:
    """Read a quantity: a number is SI already, a text is a number with a unit of the dimension of the SI `unit`.

    Raises a ValueError for text that is no quantity, another dimension, and infinite or NaN values (`inf` is allowed
    for lengths).
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Real | str):
        raise ValueError(f"{value!r} is no quantity; write a number in {unit} or, for example, '{_example(unit)}'")
    try:
        number = float(value)
    except ValueError:
        number = _with_unit(str(value), unit)
    except OverflowError as error:
        raise ValueError(f"a number of {len(str(value))} digits is out of range; give it in {unit}") from error
    if math.isnan(number) or (math.isinf(number) and unit != "m"):
        raise ValueError(f"{value!r} is not a finite number; give one, for example '{_example(unit)}'")
    return number


def _with_unit(text: str, unit: str) -> float:
    if len(text) > _LONGEST or _QUANTITY.fullmatch(text) is None:
        short = text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
        raise ValueError(f"{short!r} is no quantity; write, for example, '{_example(unit)}'")
    plain = _PLAIN.fullmatch(text)
    if plain is not None and (factor := _USUAL.get(unit, {}).get(plain[2])) is not None:
        return float(plain[1]) * factor
    registry = _registry()
    import pint

    try:
        quantity = registry.Quantity(text)
    except Exception as error:
        raise ValueError(f"{text!r} is no quantity; write, for example, '{_example(unit)}'") from error
    try:
        return float(quantity.to(unit).magnitude)
    except (pint.PintError, AttributeError, TypeError, ValueError, ArithmeticError) as error:
        what = f"{text!r} has the wrong dimension"
        raise ValueError(f"{what}; give it in {unit}, for example '{_example(unit)}'") from error


def _example(unit: str) -> str:
    usual = {"m": "5 mm", "rad": "0.5 deg", "W": "1 mW", "s": "10 us", "1/s": "100 1/s", "1/m": "0.2 1/m"}
    return usual.get(unit, f"1 {unit}")


def _quantity(unit: str) -> Any:
    schema = {
        "anyOf": [{"type": "number"}, {"type": "string"}],
        "description": f"SI number in {unit}, or text such as '{_example(unit)}'",
    }
    return BeforeValidator(lambda value: to_si(value, unit)), WithJsonSchema(schema)


# The one length that may be infinite. The constraint precedes the reader because it applies to the number.
FocusDistance = Annotated[float, Field(gt=0, allow_inf_nan=True), *_quantity("m")]
Length = Annotated[float, *_quantity("m")]
Angle = Annotated[float, *_quantity("rad")]
# These bounds, far beyond any bench, keep all derived numbers finite in single precision.
Power = Annotated[float, *_quantity("W"), Field(gt=0, le=1e9)]
Time = Annotated[float, *_quantity("s"), Field(gt=0, le=1e6)]
Current = Annotated[float, *_quantity("1/s"), Field(ge=0, le=1e12)]
Vergence = Annotated[float, *_quantity("1/m"), Field(ge=-1e6, le=1e6)]
