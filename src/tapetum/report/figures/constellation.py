"""Section through a room lit by several probes: their cones, the illumination, and the signal-to-noise ratio."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from tapetum.bench import Target
from tapetum.errors import InputError
from tapetum.report.figures._style import INK, NOTE, QUIET, dress, dress_bar, new_figure, part_of
from tapetum.simulate.constellation import Constellation, Volume, evenness, irradiance, signal

__all__ = ["fig_constellation"]


def fig_constellation(
    cases: Mapping[str, Constellation],
    volume: Volume,
    target: Target,
    *,
    across: float = 0.0,
    pixels: int = 320,
    points: int = 6000,
) -> Figure:
    """Draw the room from the side, a row for each of 1 to 4 cases: illumination on the left, combined SNR on the right.

    The section lies at x = `across` (metres), with `pixels` along its longer side. The ratios in the titles are over
    `points` of the whole `volume`, not over the section.
    """
    if not 1 <= len(cases) <= 4:
        raise InputError(f"has {len(cases)} entries", where="cases", remedy="give one to four")
    probes = [probe for case in cases.values() for probe in case.probes]
    left = min(probe.position[2] for probe in probes)
    right = volume.high[2] + 1.0
    rise = volume.rake * (volume.high[2] - volume.low[2])
    top = max(max(probe.position[1] for probe in probes), volume.high[1] + max(rise, 0.0)) + 0.5
    bottom = min(0.0, rise)
    step = (right - left) / pixels
    z = np.arange(left + 2.0, right, step) + step / 2
    y = np.arange(bottom, top, step) + step / 2
    Z, Y = np.meshgrid(z, y)
    room = np.stack([np.full(Z.size, across), Y.ravel(), Z.ravel()], axis=1)
    floor = volume.rake * np.clip(Z - volume.low[2], 0.0, volume.high[2] - volume.low[2])
    under = floor > Y
    inside = volume.sample(points, 17)

    maps: list[list[np.ndarray]] = []
    titles: list[list[str]] = []
    for name, case in cases.items():
        light = irradiance(case, room).sum(axis=1).reshape(Z.shape) * 1e6
        snr = signal(case, target, room, volume.facing(room)).combined.reshape(Z.shape)
        here = evenness(irradiance(case, inside).sum(axis=1))
        there = evenness(signal(case, target, inside, volume.facing(inside)).combined)
        maps.append([light, snr])
        titles.append([f"{name}: illumination, max/min {here.ratio:.3g}", f"SNR, max/min {there.ratio:.3g}"])

    # A colour bar below each column takes no width from the maps.
    figure = new_figure(11.0, 1.5 + (5.0 * (top - bottom) / (right - left + 0.8) + 0.5) * len(cases))
    axes = figure.subplots(len(cases), 2, sharex=True, sharey=True, squeeze=False)
    labels = ("illumination (µW/m²)", "SNR of all probes")
    for column, map_name in enumerate(("viridis", "magma")):
        # One scale for all cases, set by what the volume's section holds.
        along = (volume.low[2] <= Z) & (volume.high[2] >= Z)
        seats = along & (floor + volume.low[1] <= Y) & (floor + volume.high[1] >= Y)
        held = np.concatenate([row[column][seats & (row[column] > 0)] for row in maps])
        low, high = (float(held.min()), float(held.max())) if held.size else (0.1, 1.0)
        scale = LogNorm(low / 1.2, max(high * 1.2, low * 1.5))
        shown = None
        for row in range(len(cases)):
            ax = axes[row, column]
            picture = np.ma.masked_where(under | (maps[row][column] <= 0), maps[row][column])
            extent = (z[0] - step / 2, z[-1] + step / 2, y[0] - step / 2, y[-1] + step / 2)
            shown = ax.imshow(
                picture, origin="lower", extent=extent, cmap=part_of(map_name, 0.08, 1.0), norm=scale, aspect="equal"
            )
            letter = "abcdefgh"[2 * row + column]
            dress(
                ax,
                title=titles[row][column],
                x="distance from the screen (m)" if row == len(cases) - 1 else "",
                y="height (m)" if column == 0 else "",
                grid=None,
                letter=letter,
            )
            _room(ax, volume, list(cases.values())[row], right)
            ax.set_xlim(left - 0.8, right)
            ax.set_ylim(bottom, top)
        below = {"orientation": "horizontal", "extend": "both", "fraction": 0.05, "aspect": 40, "pad": 0.02}
        assert shown is not None
        bar = figure.colorbar(shown, ax=axes[:, column].tolist(), **below)
        # Plain numbers: the scale is logarithmic, but spans little more than a decade.
        bar.ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        bar.ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        bar.ax.xaxis.set_minor_formatter(NullFormatter())
        dress_bar(bar, labels[column])
    return figure


def _room(ax: object, volume: Volume, case: Constellation, right: float) -> None:
    """Floor, the volume's outline, and each probe's cone where its axis stays near the section's plane."""
    near, far = volume.low[2], volume.high[2]
    rise = volume.rake * (far - near)
    draw = ax.plot  # type: ignore[attr-defined]
    draw([0, near, far, right], [0, 0, rise, rise], color=QUIET, linewidth=1.2)
    corners = [(near, volume.low[1]), (far, volume.low[1] + rise), (far, volume.high[1] + rise), (near, volume.high[1])]
    ax.add_patch(Polygon(corners, fill=False, edgecolor="white", linewidth=1.4))  # type: ignore[attr-defined]
    ax.annotate(  # type: ignore[attr-defined]
        "seats", (far, volume.low[1] + rise), (far - 0.2, rise - 0.6), ha="right", va="top", fontsize=NOTE, color=INK
    )
    for probe in case.probes:
        _, up, ahead = probe.direction
        middle = np.arctan2(up, ahead)
        for angle in (middle - probe.divergence / 2, middle + probe.divergence / 2):
            end = (right - probe.position[2]) * np.tan(angle)
            draw([probe.position[2], right], [probe.position[1], probe.position[1] + end], "w-", lw=0.4, alpha=0.45)
        draw(probe.position[2], probe.position[1], "o", color=INK, markersize=4, clip_on=False)
