from __future__ import annotations

import io

import numpy as np
import pytest
import xarray as xr
from PIL import Image

from tapetum.data import dataset_from_arrays
from tapetum.data.quality import inspect_dataset
from tapetum.errors import InputError
from tapetum.report.figures import figure_png
from tapetum.report.figures.contact_sheet import fig_contact_sheet

SIDE, COUNT = 24, 36
RNG = np.random.default_rng(0)


def made(**labels) -> xr.Dataset:
    rows, columns = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    spot = 20 + 180 * np.exp(-(rows**2 + columns**2) / 9)
    images = np.clip(spot + RNG.normal(0, 2, (COUNT, SIDE, SIDE)), 0, 255).astype(np.uint8)
    return dataset_from_arrays(images, labels, split=(np.arange(COUNT) % 6 == 5).astype(int))


def gaze() -> dict[str, np.ndarray]:
    return {"gaze_x": RNG.uniform(-0.4, 0.4, COUNT), "gaze_y": RNG.uniform(-0.4, 0.4, COUNT)}


def drawn(dataset: xr.Dataset):
    figure = fig_contact_sheet(dataset, inspect_dataset(dataset), name="a.zarr", notes=["a note"])
    with Image.open(io.BytesIO(figure_png(figure, dpi=40))) as picture:
        assert np.asarray(picture.convert("L")).std() > 20
    return figure


def test_every_rr_stands_at_its_gaze():
    dataset = made(**gaze())
    field = drawn(dataset).get_axes()[0]
    columns, rows = field.get_xlim()[1], field.get_ylim()[0]
    at = dataset.tp.values(("gaze_x", "gaze_y")) + 0.5
    cells = set(map(tuple, np.floor(at * (columns, rows)).astype(int).tolist()))
    shown = {(int(i.get_extent()[0]), int(i.get_extent()[3])) for i in field.get_images()}
    assert shown == cells


def test_focal_length_and_object_distance_make_a_table():
    lengths, distances = (
        np.array([0.05, 0.085, 0.135])[np.arange(COUNT) % 3],
        np.array([3, 4, 5.5])[np.arange(COUNT) // 12],
    )
    table = drawn(made(focal_length=lengths, object_distance=distances)).get_axes()[0]
    assert [t.get_text() for t in table.get_yticklabels()] == ["f = 50 mm", "f = 85 mm", "f = 135 mm"]
    assert [t.get_text() for t in table.get_xticklabels()] == ["3", "4", "5.5"]
    assert len(table.get_images()) == 9


def test_a_class_has_a_row():
    names = np.array(["phone-01", "phone-02"])[np.arange(COUNT) % 2]
    table = drawn(made(device=names, **gaze())).get_axes()[0]
    assert [t.get_text() for t in table.get_yticklabels()] == ["phone-01", "phone-02"]


def test_one_gaze_alone_or_one_value_is_drawn_too():
    drawn(made(gaze_x=gaze()["gaze_x"]))
    drawn(made(object_distance=np.full(COUNT, 5.0)))
    drawn(made(gaze_x=np.zeros(COUNT), gaze_y=np.zeros(COUNT)))


def test_refuses_a_set_without_labels():
    dataset = made()
    with pytest.raises(InputError, match="no labels"):
        fig_contact_sheet(dataset, inspect_dataset(dataset))
