"""Figures of tracking: paths of the RRs in the probe's frames, and their SNR."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from numpy.typing import ArrayLike

from tapetum.errors import InputError
from tapetum.report.figures._style import INK, NOTE, QUIET, TICK, colour, dress, new_figure
from tapetum.report.figures.retro import CMAP, stretched

__all__ = ["fig_tracks"]


def fig_tracks(
    frame: ArrayLike,
    track: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    time: ArrayLike,
    snr: ArrayLike,
    *,
    longest: int = 4,
) -> Figure:
    """Draw the longest tracks over a whole probe frame, and their signal-to-noise ratio over time.

    Parameters
    ----------
    frame
        [H, W] one probe frame.
    track, x, y, time, snr
        [N] a row each: track, place (pixels), seconds, signal-to-noise ratio (NaN while coasting).
    longest
        Number of tracks drawn; the others are counted.

    Raises
    ------
    InputError
        When the lengths differ or there is no row.
    """
    ids = np.asarray(track)
    columns = [np.asarray(values, dtype=np.float64) for values in (x, y, time, snr)]
    if ids.ndim != 1 or not len(ids) or any(column.shape != ids.shape for column in columns):
        raise InputError(f"expected columns of one length, got {[c.shape for c in (ids, *columns)]}", where="tracks")
    px, py, seconds, clear = columns
    # Take the square root above the background, whose level would turn the whole picture grey.
    values = np.asarray(frame, dtype=np.float64)
    image = stretched(np.clip(values - np.median(values), 0, None))
    figure = new_figure(10.0, 3.7)
    left, right = figure.subplots(1, 2, width_ratios=(1.28, 1.0))
    left.imshow(image, cmap=CMAP, vmin=0, vmax=1, interpolation="nearest")
    names, counts = np.unique(ids, return_counts=True)
    chosen = names[np.argsort(-counts, kind="stable")][:longest]
    tints = ("#56b4e9", *(colour(k) for k in range(1, 6)))
    for order, name in enumerate(chosen):
        rows = np.flatnonzero(ids == name)
        tint = tints[order % len(tints)]
        left.plot(px[rows], py[rows], color=tint, linewidth=1.4)
        left.plot(px[rows[0]], py[rows[0]], "o", color=tint, markersize=5, markeredgecolor="white")
        left.plot(px[rows[-1]], py[rows[-1]], ">", color=tint, markersize=6, markeredgecolor="white")
        share = float(np.isfinite(clear[rows]).mean())
        right.plot(
            seconds[rows],
            clear[rows],
            ".",
            color=tint,
            markersize=4,
            label=f"track {name}: {len(rows)} frames, seen in {100 * share:.0f} %",
        )
    dress(left, letter="a", title="Path in the probe's picture", x="x, px", y="y, px", grid=None)
    left.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    dress(right, letter="b", title="How clearly it stands out", x="time, s", y="signal-to-noise ratio")
    right.set_yscale("log")
    right.yaxis.set_major_formatter(LogFormatter())
    right.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.5)))
    right.tick_params(which="both", labelsize=TICK)
    figure.legend(
        loc="outside lower right",
        ncols=2,
        frameon=False,
        fontsize=NOTE,
        labelcolor=INK,
        markerscale=1.6,
        handletextpad=0.1,
    )
    others = len(names) - len(chosen)
    left.text(
        0.015,
        0.02,
        "● first   ▶ last" + (f"   {others} shorter tracks not drawn" if others else ""),
        transform=left.transAxes,
        fontsize=NOTE,
        color="white",
    )
    right.spines["left"].set_color(QUIET)
    right.tick_params(labelcolor=INK)
    return figure
