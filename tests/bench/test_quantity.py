"""Quantities as people write them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapetum.bench import quantity
from tapetum.bench.quantity import to_si


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("640 nm", "m", 640e-9),
        ("2.2um", "m", 2.2e-6),
        ("3 µm", "m", 3e-6),
        ("5 m", "m", 5.0),
        ("-3 mm", "m", -3e-3),
        ("1e-1 mm", "m", 1e-4),
        ("0.25", "m", 0.25),
        ("180 deg", "rad", math.pi),
        ("1 mrad", "rad", 1e-3),
        ("50 uW", "W", 5e-5),
        ("200 us", "s", 2e-4),
        ("5/s", "1/s", 5.0),
        ("30 Hz", "1/s", 30.0),
        (4, "m", 4.0),
        (0.5, "rad", 0.5),
        (np.float32(0.5), "rad", 0.5),
        (np.int64(4), "m", 4.0),
    ],
)
def test_reads(text: object, unit: str, value: float) -> None:
    assert to_si(text, unit) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "unit", "words"),
    [
        ("3 kg", "m", "'3 kg' has the wrong dimension; give it in m, for example '5 mm'"),
        ("5 mm", "rad", "'5 mm' has the wrong dimension; give it in rad, for example '0.5 deg'"),
        ("1 V", "W", "give it in W, for example '1 mW'"),
        ("10 Hz", "s", "give it in s, for example '10 us'"),
        ("3 bananas", "m", "'3 bananas' is no quantity; write, for example, '5 mm'"),
        ("", "m", "'' is no quantity"),
        (None, "m", "None is no quantity; write a number in m"),
        (True, "m", "True is no quantity"),
        (np.bool_(True), "m", "is no quantity"),
        (4j, "m", "4j is no quantity"),
        ([1], "m", "is no quantity"),
        ("nan", "m", "'nan' is not a finite number"),
        (math.inf, "W", "inf is not a finite number"),
    ],
)
def test_refuses(text: object, unit: str, words: str) -> None:
    with pytest.raises(ValueError) as raised:
        to_si(text, unit)
    assert words in str(raised.value)


@given(st.floats(1e-12, 1e12))
def test_usual_units_are_pints_to_the_last_digit(number: float) -> None:
    for unit, usual in quantity._USUAL.items():
        for name in usual:
            assert to_si(f"{number!r} {name}", unit) == quantity._registry().Quantity(number, name).to(unit).magnitude


@given(st.floats(1e-12, 1e12))
def test_units_scale(value: float) -> None:
    assert to_si(f"{value!r} mm", "m") == pytest.approx(value * 1e-3, rel=1e-9)


@given(st.text(max_size=12))
def test_any_text_is_a_finite_number_or_refused(text: str) -> None:
    try:
        assert not math.isnan(to_si(text, "m"))
    except ValueError as error:
        assert "; " in str(error)
