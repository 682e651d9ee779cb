"""A target that images for a while: the share of exposures, and what the probe sees of either state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tapetum.bench import load_scene, with_values
from tapetum.errors import InputError
from tapetum.record.imaging import Imaging, idle_scene
from tapetum.record.session import Session
from tapetum.record.shot import Shot


def test_the_share_of_an_exposure() -> None:
    times = np.array([0.0, 0.99, 1.0, 1.5, 2.04, 9.0])
    on = Imaging((1.0, 2.0), at_first=False)
    assert on.share(times, 0.1) == pytest.approx([0, 0.4, 0.5, 1, 0.1, 0], abs=1e-6)
    assert Imaging((1.0, 2.0)).share(times, 0.1) == pytest.approx([1, 0.6, 0.5, 0, 0.9, 1], abs=1e-6)
    assert Imaging().share(times, 0.1) == pytest.approx(np.ones(6))
    assert Imaging((20.0,), at_first=False).share(times) == pytest.approx(np.zeros(6))


def test_drawn_states_last_as_long_as_asked() -> None:
    drawn = Imaging.draw(60.0, np.random.default_rng(3), least=2.0, most=6.0)
    lengths = np.diff(np.r_[0.0, drawn.switches])
    assert ((lengths >= 2) & (lengths <= 6)).all()
    assert 10 <= len(drawn.switches) <= 30


def test_switches_that_do_not_rise_are_refused() -> None:
    with pytest.raises(InputError, match="must rise"):
        Imaging((2.0, 1.0))


def test_frames_are_those_of_either_state() -> None:
    layer = {"depth": 0.5e-3, "reflectance": 0.5}
    scene = with_values(
        load_scene("hand-held"),
        {"target.sensor.layers": [layer], "probe.sensor.pixels": [200, 160], "illumination.second_beam": None},
    )
    session = Session(1.0, 15.0, 5, imaging=Imaging((0.5,)))
    switching, open_, idle = (
        Shot(scene, session),
        Shot(scene, replace(session, imaging=None)),
        Shot(idle_scene(scene), replace(session, imaging=None)),
    )
    truth = switching.truth().to_pydict()
    share = np.array(truth["imaging"])[np.array(truth["stream"]) == "probe"]
    first, last = int(np.flatnonzero(share == 1)[0]), int(np.flatnonzero(share == 0)[-1])
    assert np.array_equal(switching.probe(first, first + 1), open_.probe(first, first + 1))
    assert np.array_equal(switching.probe(last, last + 1), idle.probe(last, last + 1))
    assert not np.array_equal(open_.probe(last, last + 1), idle.probe(last, last + 1))


def test_an_idle_camera_without_a_filter_returns_nothing() -> None:
    scene = with_values(load_scene("hand-held"), {"probe.sensor.pixels": [200, 160]})
    shot = Shot(scene, Session(1.0, 15.0, 5, imaging=Imaging((0.5,))))
    dark, lit = shot.probe(12, 13)[0], shot.probe(2, 3)[0]
    assert lit.max() > 3 * dark.max()
