"""Drawings of lenses and phones: rays end on the sensor, and cameras stand where their file says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from draw_catalogue import fig_lenses, fig_phones
from tapetum.bench import PrescriptionLens, load_phone
from tapetum.errors import InputError


def test_every_field_ends_in_one_point_of_the_sensor() -> None:
    lens = PrescriptionLens("phone-f")
    (ax,) = fig_lenses([lens]).axes
    image = 1e3 * lens.focused(lens.design_wavelength, math.inf).image
    rays = [line for line in ax.lines if len(line.get_xdata()) > 10]  # pyright: ignore[reportArgumentType]
    ends = np.array([[line.get_xdata()[-1], line.get_ydata()[-1]] for line in rays])  # pyright: ignore[reportIndexIssue]
    assert len(rays) == 15 and np.allclose(ends[:, 0], image)
    for field in ends[:, 1].reshape(3, 5):
        assert np.ptp(field) < 0.05
    assert len(ax.patches) == 6
    assert "phone-f" in ax.get_title(loc="left")


def test_a_zoom_shows_the_picture_of_one_size() -> None:
    figure = fig_lenses([PrescriptionLens("zoom-18-140mm", focal_length=f) for f in (25e-3, 100e-3)], columns=2)
    heights = [max(np.abs(line.get_ydata()[-1]) for line in ax.lines) for ax in figure.axes]  # pyright: ignore[reportIndexIssue]
    assert heights[0] == pytest.approx(heights[1], rel=0.15)


def test_cameras_stand_in_their_places() -> None:
    phone = load_phone("phone-06")
    (ax,) = fig_phones([phone]).axes
    centres = {tuple(np.round(patch.center, 6)) for patch in ax.patches}  # pyright: ignore[reportAttributeAccessIssue]
    assert centres == {tuple(np.round(1e3 * np.array(camera.position), 6)) for camera in phone.cameras}
    # y points down.
    assert ax.get_ylim()[0] > ax.get_ylim()[1]


def test_nothing_to_draw_is_refused() -> None:
    with pytest.raises(InputError, match="lenses: has 0 entries; give one to sixteen"):
        fig_lenses([])
    with pytest.raises(InputError, match="phones: has 0 entries; give one to twenty"):
        fig_phones([])
