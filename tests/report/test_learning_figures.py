"""Figures of learning: that they show the numbers they were given."""

from __future__ import annotations

import io
import sys
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from tapetum.errors import InputError
from tapetum.report.binned import error_by_distance
from tapetum.report.evaluation import Binned, ErrorMap, Group, Reliability
from tapetum.report.figures import figure_png
from tapetum.report.figures.by_image import fig_by_image
from tapetum.report.figures.classes import fig_confusion, fig_reliability
from tapetum.report.figures.errors import fig_coverage, fig_error_by, fig_error_by_distance
from tapetum.report.figures.maps import fig_error_map
from tapetum.report.figures.path import fig_path


def drawn(figure: Figure) -> np.ndarray:
    """The figure's pixels, small."""
    with Image.open(io.BytesIO(figure_png(figure, dpi=40))) as image:
        return np.asarray(image.convert("RGB"))


def words(figure: Figure) -> str:
    """All text in the figure, legends included."""
    drawn(figure)
    found = [item.get_text() for item in figure.findobj(matplotlib.text.Text)]  # type: ignore[attr-defined]
    return " | ".join(found)


def titled(figure: Figure, part: str) -> Axes:
    return next(ax for ax in figure.get_axes() if part in ax.get_title(loc="left"))


def columns(figure: Figure) -> list[Any]:
    return [[float(v) for v in np.ravel(np.asarray(line.get_ydata()))] for line in figure.get_axes()[0].get_lines()]


@pytest.fixture
def gaze() -> np.ndarray:
    turn = np.linspace(0, 4 * np.pi, 120)
    return np.stack([0.4 * np.sin(turn), 0.35 * np.cos(0.7 * turn)], axis=1)


def test_drawing_leaves_no_global_state(gaze: np.ndarray) -> None:
    before = dict(matplotlib.rcParams)
    drawn(fig_path(gaze, gaze))
    assert dict(matplotlib.rcParams) == before
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


def test_path_breaks_between_recordings_and_counts_what_lies_beyond(gaze: np.ndarray) -> None:
    said = gaze + 0.02
    said[70] = [2.0, -2.0]
    number = (np.arange(120) >= 60).astype(int)
    figure = fig_path(
        gaze, said, lower=said - 0.1, upper=said + 0.1, recording=number, section=(60, 80), rrs=[np.eye(5)], rrs_at=[65]
    )
    text = words(figure)
    assert "x (1 beyond the axes)" in text and "y (1 beyond the axes)" in text
    assert "1 of 20 estimates lie outside" in text and "90 % interval" in text
    path, x, y = (titled(figure, part) for part in ("Path", "x (", "y ("))
    # x to the right, y down, as in the picture; y against the frame runs the same way.
    assert path.get_xlim() == (-0.5, 0.5) and path.get_ylim() == (0.5, -0.5)
    assert y.get_ylim()[0] > y.get_ylim()[1] and x.get_ylim()[0] < x.get_ylim()[1]
    assert max(np.asarray(line.get_xdata(), dtype=float).size for line in x.get_lines()) == 60
    assert "90 % interval" not in words(fig_path(gaze, said, lower=said - np.inf, upper=said + np.inf))


@pytest.mark.parametrize(
    "wrong", [{"recording": np.zeros(3)}, {"section": (5, 6)}, {"section": (100, 130)}, {"rrs": [np.eye(3)]}]
)
def test_path_refuses_what_does_not_fit(gaze: np.ndarray, wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        fig_path(gaze, gaze, **wrong)


def test_errors_over_the_field_stand_beside_their_bound(gaze: np.ndarray) -> None:
    edges = [0.0, 0.2, 0.4, 0.6, 0.8]
    curves = {name: error_by_distance(gaze, gaze + k, edges=edges) for name, k in (("A", 0.1), ("mean", 0.3))}
    bound = (np.linspace(0, 0.6, 5), np.full(5, 0.002))
    figure = fig_error_by_distance(curves, baseline="mean", bounds={"bound": bound}, log=True)
    assert {"A", "mean", "bound"} <= set(words(figure).split(" | "))
    upper, lower = figure.get_axes()[:2]
    assert upper.get_yscale() == "log" and upper.get_ylim()[0] < 0.002
    assert [0.002] * 5 in columns(figure)
    assert sum(bar.get_height() for bar in lower.patches) == 120  # type: ignore[attr-defined]
    assert fig_error_by_distance(curves).get_axes()[0].get_ylim()[0] == 0
    with pytest.raises(InputError, match="rings differ"):
        fig_error_by_distance({"A": curves["A"], "B": error_by_distance(gaze, gaze, edges=[0, 1])})
    with pytest.raises(InputError, match="bound: expected two columns"):
        fig_error_by_distance(curves, bounds={"bound": ([0.1, 0.2], [1.0])})


def test_errors_by_anything_are_drawn_where_they_are() -> None:
    one = Binned(np.array([3.0, 5.0, 8.0]), np.array([4, 4, 4]), np.array([0.1, 0.2, 0.3]), *(np.full(3, 0.1),) * 2)
    figure = fig_error_by({"A": one}, x="distance, m", log_x=True, log_y=True)
    assert [0.1, 0.2, 0.3] in columns(figure) and "distance, m" in words(figure)
    assert figure.get_axes()[0].get_xscale() == "log"
    with pytest.raises(InputError, match="no error"):
        fig_error_by({}, x="SNR")


def maps(factor: float = 1.0) -> dict[str, ErrorMap]:
    x, y = np.array([3.0, 5.5]), np.array([0.05, 0.135])
    values = factor * np.array([[0.4, 0.8], [0.1, np.nan]])
    count = np.array([[5, 5], [5, 0]])
    return {"object_distance": ErrorMap(x, y, values, count), "focal_length": ErrorMap(x, y, values / 100, count)}


def test_map_writes_each_cell_in_its_unit() -> None:
    text = words(fig_error_map({"A": maps()})).split(" | ")
    assert {"0.40", "0.80", "0.10"} <= set(text)  # metres
    assert {"4.0", "8.0", "1.0"} <= set(text)  # millimetres
    assert text.count("–") == 2 and {"50", "135", "3", "5.5"} <= set(text)


def test_map_beside_its_bound_shows_the_ratio() -> None:
    bounds = {name: np.full((2, 2), 0.04 if name == "object_distance" else 0.0004) for name in maps()}
    figure = fig_error_map({"A": maps(), "B": maps(2)}, bounds=bounds)
    text = words(figure).split(" | ")
    assert text.count("A over the bound") == 2
    assert text.count("10.0") == 2 and text.count("20.0") >= 2
    shown = [ax for ax in figure.get_axes() if ax.get_visible() and ax.get_title(loc="left")]
    assert len(shown) == 8
    assert "A over the bound" not in words(fig_error_map({"A": maps()}, bounds=bounds, ratio=False))
    with pytest.raises(InputError, match="expected bounds"):
        fig_error_map({"A": maps()}, bounds={"object_distance": np.ones((3, 3))})
    with pytest.raises(InputError, match="no map"):
        fig_error_map({})


def test_images_are_sorted_so_that_the_truth_makes_steps() -> None:
    d, f = np.tile([5.0, 3.0, 4.0], 20), np.repeat([0.135, 0.05], 30)
    said = {"object_distance": d.copy(), "focal_length": f.copy()}
    said["object_distance"][7] = 99.0
    ends = {"object_distance": (d - 0.1, d + 0.1)}
    figure = fig_by_image({"object_distance": d, "focal_length": f}, {"A": said, "B": said}, interval=ends)
    assert words(figure).count("(1 beyond the axes)") == 2
    lines = [ax.get_lines()[-1] for ax in figure.get_axes()]
    steps = [np.asarray(line.get_ydata(), dtype=float) for line in lines]
    assert steps[0].tolist() == sorted(d.tolist())
    # In millimetres; for each distance the focal lengths rise again.
    assert steps[2].tolist() == ([50.0] * 10 + [135.0] * 10) * 3
    with pytest.raises(InputError, match="one length"):
        fig_by_image({}, {"A": said})
    with pytest.raises(InputError, match="B: focal_length"):
        fig_by_image({"focal_length": f}, {"B": {"focal_length": f[:3]}})


def test_confusion_counts_every_frame() -> None:
    counts = np.array([[5, 1], [0, 7]])
    text = words(fig_confusion(counts, ["A", "B"])).split(" | ")
    assert {"5", "1", "7", "A  (6)", "B  (7)"} <= set(text) and "0" not in text
    with pytest.raises(InputError, match="expected counts"):
        fig_confusion(counts, ["A"])


def test_reliability_tells_its_error_and_shows_the_part_that_matters() -> None:
    one = Reliability(np.array([0.96, 0.99]), np.array([0.97, 0.99]), np.array([1000, 1000]))
    figure = fig_reliability({"A": one, "B": one})
    assert "A: expected calibration error 0.005" in words(figure)
    low, high = figure.get_axes()[0].get_xlim()
    assert 0.9 < low < 0.96 and high > 1
    assert "model: expected" in words(fig_reliability(one))


def test_coverage_shows_every_group_where_it_is() -> None:
    groups = {
        "": [Group("all", 30, (0.0,) * 2, (0.0,) * 2, (0.9, 0.8))],
        "by recording": [Group(f"r{k}", 10, (0.0,) * 2, (0.0,) * 2, (0.5 + k / 10, 1.0)) for k in range(3)],
    }
    figure = fig_coverage(groups, ["gaze_x", "gaze_y"])
    assert {"all  (30)", "r2  (10)", "by recording", "gaze x"} <= set(words(figure).split(" | "))
    ax = figure.get_axes()[0]
    held = [[float(v) for v in np.asarray(line.get_xdata())] for line in ax.get_lines() if len(line.get_xdata()) == 4]  # type: ignore[arg-type]
    assert held == [[0.9, 0.5, 0.6, pytest.approx(0.7)], [0.8, 1.0, 1.0, 1.0]]
    low, high = ax.get_xlim()
    assert low < 0.5 and high > 1.0
    with pytest.raises(InputError, match="no interval"):
        fig_coverage({}, ["gaze_x"])
