"""The paper's figures and diagnostic ones: arrays in, a Matplotlib Figure out."""

from tapetum.report.figures._style import figure_png, save_figure, stamp
from tapetum.report.figures.errors import fig_coverage, fig_error_by, fig_error_by_distance
from tapetum.report.figures.gaze import fig_gaze_over_time, fig_label_error
from tapetum.report.figures.path import fig_gaze_path
from tapetum.report.figures.retro import draw_rr, fig_grid, fig_samples
from tapetum.report.figures.sign import SignRate, fig_sign_map, fig_sign_rates
from tapetum.report.figures.tracks import fig_tracks

__all__ = [
    "SignRate",
    "draw_rr",
    "fig_coverage",
    "fig_error_by",
    "fig_error_by_distance",
    "fig_gaze_over_time",
    "fig_gaze_path",
    "fig_grid",
    "fig_label_error",
    "fig_samples",
    "fig_sign_map",
    "fig_sign_rates",
    "fig_tracks",
    "figure_png",
    "save_figure",
    "stamp",
]
