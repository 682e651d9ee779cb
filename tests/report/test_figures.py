from __future__ import annotations

import io
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from tapetum.errors import InputError
from tapetum.report import (
    SignRate,
    error_by_distance,
    fig_error_by_distance,
    fig_gaze_over_time,
    fig_gaze_path,
    fig_grid,
    fig_label_error,
    fig_samples,
    fig_sign_map,
    fig_sign_rates,
    fig_tracks,
    figure_png,
    save_figure,
)
from tapetum.report.figures._style import runs
from tapetum.report.figures.classes import fig_confusion
from tapetum.report.figures.retro import stretched

Gaze = tuple[np.ndarray, np.ndarray]


def drawn(figure: Figure) -> np.ndarray:
    """The figure's pixels, small."""
    with Image.open(io.BytesIO(figure_png(figure, dpi=40))) as image:
        return np.asarray(image.convert("RGB"))


def words(figure: Figure) -> str:
    """All text in the figure, legends included."""
    drawn(figure)
    found = [item.get_text() for item in figure.findobj(matplotlib.text.Text)]  # type: ignore[attr-defined]
    return " | ".join(found)


def test_drawing_leaves_no_global_state(gaze: Gaze) -> None:
    before = dict(matplotlib.rcParams)
    drawn(fig_gaze_path(np.ones((4, 6)), gaze[1], gaze[1], gaze[0]))
    assert dict(matplotlib.rcParams) == before
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


def test_same_figure_same_bytes(gaze: Gaze) -> None:
    one, two = (figure_png(fig_gaze_over_time(gaze[0], gaze[1], {"a": gaze[1]}), dpi=40) for _ in range(2))
    assert one == two


def test_path_lies_where_the_gaze_is(gaze: Gaze) -> None:
    time, truth = gaze
    figure = fig_gaze_path(np.ones((30, 40)), truth, truth + 0.3, time, name="M", rrs=[np.eye(5)], rrs_at=[3])
    main = next(ax for ax in figure.get_axes() if "width" in ax.get_xlabel())
    # x to the right, y down, as in the picture.
    assert main.get_xlim() == (-0.5, 0.5)
    assert main.get_ylim() == (0.5, -0.5)
    outside = int((np.abs(truth + 0.3) > 0.5).any(axis=1).sum())
    assert outside > 0
    assert f"M, from the RR alone ({outside} outside)" in words(figure)


@pytest.mark.parametrize(
    "wrong",
    [
        {"picture": np.ones(5)},
        {"predicted": np.zeros((3, 2))},
        {"truth": np.full((120, 2), np.nan)},
        {"time": np.zeros(3)},
    ],
)
def test_path_refuses_what_does_not_fit(gaze: Gaze, wrong: dict[str, np.ndarray]) -> None:
    given = {"picture": np.ones((4, 6)), "truth": gaze[1], "predicted": gaze[1], "time": gaze[0]} | wrong
    with pytest.raises(InputError):
        fig_gaze_path(given["picture"], given["truth"], given["predicted"], given["time"])


def test_runs_break_at_holes_and_at_new_videos() -> None:
    time = np.array([0, 1, 2, 30, 31, 0, 1, 2.0])
    assert [(s.start, s.stop) for s in runs(time)] == [(0, 3), (3, 5), (5, 8)]


def test_over_time_counts_what_lies_beyond_the_axes(gaze: Gaze) -> None:
    time, truth = gaze
    wild = truth.copy()
    wild[4] = [3.0, -3.0]
    figure = fig_gaze_over_time(time, truth, {"A": truth, "B": wild}, interval=(truth - 0.1, truth + 0.1))
    assert "B (2 beyond the axes)" in words(figure)
    # A step between the two videos, never a line back in time.
    line = figure.get_axes()[0].get_lines()
    longest = max(np.asarray(one.get_xdata(), dtype=float).size for one in line)
    assert longest == 60
    with pytest.raises(InputError, match="no model"):
        fig_gaze_over_time(time, truth, {})


def test_error_figure_shows_every_curve_and_all_frames(gaze: Gaze) -> None:
    truth = gaze[1]
    edges = [0.0, 0.2, 0.4, 0.6, 0.8]  # the last ring is empty
    curves = {n: error_by_distance(truth, truth + k, edges=edges) for n, k in (("A", 0.1), ("mean", 0.3))}
    figure = fig_error_by_distance(curves, baseline="mean")
    assert {"A", "mean"} <= set(words(figure).split(" | "))
    bars = figure.get_axes()[1].patches
    assert sum(bar.get_height() for bar in bars) == 120  # type: ignore[attr-defined]
    with pytest.raises(InputError, match="rings differ"):
        fig_error_by_distance({"A": curves["A"], "B": error_by_distance(truth, truth, edges=[0, 1])})


def test_label_figure_drops_nothing() -> None:
    true = np.zeros((100, 2))
    found = true + np.random.default_rng(0).normal(size=(100, 2)) * 0.05
    found[0] = [9.0, 9.0]
    found[1] = np.nan
    figure = fig_label_error(found, true)
    bars = figure.get_axes()[0].patches
    assert sum(bar.get_height() for bar in bars) == 99  # type: ignore[attr-defined]
    assert "(1 beyond, in the last bin)" in words(figure)


def test_stretches() -> None:
    image = np.array([[0.0, 1.0], [4.0, 16.0]])
    assert stretched(image).tolist() == [[0.0, 0.25], [0.5, 1.0]]
    assert stretched(image, 64.0)[1, 1] == 0.5
    assert stretched(image / 16, stretch="log")[1, 1] == 1.0
    assert stretched(np.zeros((2, 2))).max() == 0.0
    with pytest.raises(InputError, match="sqrt"):
        stretched(image, stretch="cubic")


@pytest.mark.parametrize("shared", [True, False])
def test_grid_is_rows_by_columns_in_order(shared: bool) -> None:
    images = np.ones((2, 3, 8, 10)) * np.arange(1, 7).reshape(2, 3, 1, 1)
    figure = fig_grid(images, ["1 m", "5 m"], ["0°", "0.5°", "1°"], extent=440.0, shared_peak=shared, title="T")
    cells = [ax for ax in figure.get_axes() if ax.images]
    shown = [float(np.max(np.asarray(ax.images[0].get_array()))) for ax in cells]
    assert shown == pytest.approx(np.sqrt(np.arange(1, 7) / 6) if shared else np.ones(6))
    assert [ax.get_title() for ax in cells[:3]] == ["0°", "0.5°", "1°"]
    assert [cells[0].get_ylabel(), cells[3].get_ylabel()] == ["1 m", "5 m"]
    assert "100 µm" in words(figure)
    with pytest.raises(InputError, match="expected images"):
        fig_grid(images, ["1 m"], ["0°"])


def test_samples_name_their_gaze() -> None:
    figure = fig_samples(np.ones((7, 6, 6)), np.array([[0.1, -0.2]] * 7), columns=4)
    assert words(figure).count("+0.10, −0.20") == 7
    with pytest.raises(InputError, match="gaze"):
        fig_samples(np.ones((7, 6, 6)), np.zeros((2, 2)))


def test_sign_map_and_rates() -> None:
    x, y = np.linspace(-0.5, 0.5, 6), np.linspace(-0.4, 0.4, 5)
    slope = np.hypot(*np.meshgrid(x, y)) * 8
    figure = fig_sign_map(x, y, slope, np.zeros((5, 6)))
    assert "median d′ = 0" in words(figure)
    with pytest.raises(InputError, match="without_beam"):
        fig_sign_map(x, y, slope, slope.T)
    rates = [SignRate("A", True, (90, 9), (100, 10)), SignRate("A", False, (50, 0), (100, 0))]
    assert "with the second beam" in words(fig_sign_rates(rates))
    with pytest.raises(InputError, match="no rate"):
        fig_sign_rates([])


def test_tracks_say_how_many_are_left_out() -> None:
    track = np.repeat(np.arange(6), [9, 8, 7, 6, 2, 1])
    n = len(track)
    snr = np.where(np.arange(n) == 0, np.nan, 9.0)
    figure = fig_tracks(np.ones((20, 30)), track, np.arange(n), np.arange(n), np.arange(n), snr)
    said = words(figure)
    assert "2 shorter tracks not drawn" in said
    assert "track 0: 9 frames, seen in 89 %" in said
    with pytest.raises(InputError, match="one length"):
        fig_tracks(np.ones((20, 30)), track, [1.0], [1.0], [1.0], [1.0])


def test_saving(tmp_path: Path) -> None:
    figure = fig_samples(np.ones((1, 4, 4)), np.zeros((1, 2)))
    assert save_figure(figure, tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert save_figure(figure, tmp_path / "a.svg").read_text().lstrip().startswith("<?xml")
    with pytest.raises(InputError, match="cannot draw"):
        save_figure(figure, tmp_path / "a.doc")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "a.svg"]


def test_a_dollar_in_a_device_s_name_is_a_dollar(tmp_path: Path):
    figure = fig_confusion(np.eye(2, dtype=int), ["cam$1", "pro $ 2 $"])
    save_figure(figure, tmp_path / "a.png")
    assert [text.get_text() for text in figure.axes[0].get_xticklabels()] == [r"cam\$1", r"pro \$ 2 \$"]
