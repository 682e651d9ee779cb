"""Errors say where, what and what to do, in one line."""

from __future__ import annotations

import pytest

from tapetum.errors import InputError, MissingExtraError, TapetumError, need, one_of


def test_one_line_whatever_went_in() -> None:
    error = InputError("is no YAML (line 1\n  line 2)", where="a.yaml", remedy="mend\tit")
    assert str(error) == "a.yaml: is no YAML (line 1 line 2); mend it"
    assert (error.what, error.where, error.remedy) == ("is no YAML (line 1\n  line 2)", "a.yaml", "mend\tit")
    assert isinstance(error, TapetumError) and isinstance(error, ValueError)


def test_parts_may_be_left_out() -> None:
    assert str(InputError("is wrong")) == "is wrong"
    assert str(InputError("is wrong", where="x")) == "x: is wrong"
    assert str(InputError("is wrong", remedy="mend it")) == "is wrong; mend it"


def test_an_absent_extra_names_what_to_install() -> None:
    import json

    assert need("json", "none") is json
    with pytest.raises(MissingExtraError, match=r"no_such_module is not installed; pip install 'tapetum\[live\]'"):
        need("no_such_module", "live")


def test_one_of() -> None:
    assert one_of("a", ("a", "b"), "--x") == "a"
    with pytest.raises(InputError, match="--x: unknown value 'c'; use one of a, b"):
        one_of("c", ("a", "b"), "--x")
