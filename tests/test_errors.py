"""Errors say where, what and what to do, in one line."""

from __future__ import annotations

import numpy as np
import pytest

import tapetum as tp
from tapetum.errors import InputError, MissingExtraError, TapetumError, need, one_of
from tapetum.models import ResNet18, ZernikeRidge


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


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: tp.retroreflect("thin-lens", rotation="abc"), "rotation: is no number"),
        (lambda: tp.film("hand-held", "x.rec", {"seconds": 1}), "session: is of type dict; give a tapetum.Session"),
        (lambda: tp.film("hand-held", 5), "out: is of type int"),
        (lambda: tp.expose(np.zeros((3, 3)), "thin-lens"), "image: is of type ndarray; give what tapetum.retroreflect"),
        (lambda: tp.track(None), "source: is None; give a path"),
        (lambda: tp.track(np.zeros((3, 64, 64))), "source: is an array; give a path, a camera, or Frames"),
        (lambda: tp.track([], model=5), "model: is no model: 5"),
        (lambda: tp.load_scene("thin-lens", 5), "changes: is no list: 5"),
        (lambda: tp.load_scene("thin-lens", "distance=3"), "changes: is no list: 'distance=3'"),
        (lambda: ZernikeRidge(3), "target: is of type int"),
        (lambda: ZernikeRidge().fit(np.zeros((4, 8, 8))), "dataset: is of type ndarray; open it by"),
        (lambda: ResNet18().fit(None), "dataset: is None"),
    ],
)
def test_python_says_what_it_wants(call, words: str) -> None:
    with pytest.raises(InputError) as raised:
        call()
    assert str(raised.value).startswith(words)


def test_a_seed_that_is_none() -> None:
    image = tp.retroreflect("thin-lens", accuracy=0.05)
    for seed in (-1, "a"):
        with pytest.raises(InputError, match=r"seed: must be a whole number from 0, is "):
            tp.expose(image, "thin-lens", seed=seed)
