"""Limits of a traced lens's frame: a slow singlet's are a thin lens's, and what has none is refused."""

from __future__ import annotations

import pytest

from tapetum.bench import load_scene
from tapetum.errors import InputError
from tapetum.simulate import fisher

BASE = ("object_distance=2.5", "sampling.accuracy=0.01", "probe.sensor.pixels=[64, 64]", "rotation=[0.3, 0.5]")
SINGLET = "target.lens={kind: prescription, name: la1509, f_number: 17, design_wavelength: 640 nm}"


@pytest.mark.slow
def test_a_slow_singlet_tells_what_a_thin_lens_does() -> None:
    real = load_scene("thin-lens", [*BASE, SINGLET])
    lens = real.target.lens
    same = f"target.lens={{focal_length: {lens.focal_length}, aperture_radius: {lens.aperture_radius}}}"
    found = fisher(real, ["gaze_x", "gaze_y", "power"])
    thin = fisher(load_scene("thin-lens", [*BASE, same]), ["gaze_x", "gaze_y", "power"])
    # Its spherical aberration changes the picture by some per cent.
    assert found.alone["power"] == pytest.approx(thin.alone["power"], rel=2e-3)
    for name in ("gaze_x", "gaze_y"):
        assert found.alone[name] == pytest.approx(thin.alone[name], rel=0.15)


@pytest.mark.parametrize("name", ["distance"])
def test_what_a_traced_lens_is_not_differentiated_by(name: str) -> None:
    with pytest.raises(InputError, match=f"{name}: not differentiated through a traced lens; leave {name} out"):
        fisher(load_scene("thin-lens", [*BASE, SINGLET]), ["gaze_x", name])


def test_a_phone_has_no_limits() -> None:
    with pytest.raises(InputError, match=r"gaze_x: not computed for a phone.*take one of its cameras"):
        fisher(load_scene("phones"), ["gaze_x"])
