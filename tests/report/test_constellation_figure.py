from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from tapetum.bench import ProbeSensor, Target, ThinLens
from tapetum.errors import InputError
from tapetum.report.figures import figure_png
from tapetum.report.figures.constellation import fig_constellation
from tapetum.simulate.constellation import ProbeKit, Volume, single_probe

VOLUME = Volume((-3, 1, 6), (3, 1.5, 12), rake=0.2)
PHONE = Target(ThinLens(4e-3, 1e-3), object_distance=10.0)


def test_a_row_a_case_with_units_and_ratios():
    one = single_probe(VOLUME, ProbeKit(ProbeSensor()), (0, 5, 0), cap=1e-4)
    figure = fig_constellation({"one": one, "half": one.scaled(0.5)}, VOLUME, PHONE, pixels=60, points=300)
    text = [ax.get_title(loc="left") for ax in figure.get_axes()] + [ax.get_xlabel() for ax in figure.get_axes()]
    assert any("one: illumination, max/min" in item for item in text)
    assert any("µW/m²" in item for item in text)
    maps = [ax.get_images()[0].get_array() for ax in figure.get_axes() if ax.get_images()]
    assert len(maps) == 4
    np.testing.assert_allclose(maps[2].compressed(), maps[0].compressed() / 2)
    with Image.open(io.BytesIO(figure_png(figure, dpi=40))) as picture:
        assert np.asarray(picture.convert("L")).std() > 20


def test_refuses_no_case():
    with pytest.raises(InputError, match="cases"):
        fig_constellation({}, VOLUME, PHONE)
