"""The page of a twin: verdict, parameters, those not determined, and pictures of frames, fits and residuals."""

from __future__ import annotations

import importlib.metadata
import math
import os

import numpy as np
from matplotlib.figure import Figure

from tapetum.calibrate.twin.result import Fitted, Twin
from tapetum.calibrate.twin.search import LIMIT
from tapetum.report.figures._style import LABEL, MODELS, QUIET, dress, new_figure
from tapetum.report.html import bullets, facts, figure, note, page, section, table, write_page

__all__ = ["frames_figure", "parameters_figure", "shown", "write_twin"]

_SCALES = {"m": (1e-3, "mm"), "rad": (1e-3, "mrad"), "W": (1e-6, "µW")}


def shown(one: Fitted, value: float | None) -> str:
    """Return a value of a parameter in a handy unit, with as many digits as its deviation supports."""
    if value is None:
        return "–"
    if not math.isfinite(value):
        return "infinity"
    size, unit = _SCALES.get(one.unit, (1.0, one.unit))
    if one.name == "object_distance":
        size, unit = 1.0, "m"
    width = one.deviation if one.deviation and math.isfinite(one.deviation) else one.spread
    digits = max(0, min(9, 1 - math.floor(math.log10(width / size)))) if 0 < width < math.inf else 3
    return f"{value / size:.{digits}f} {unit}"


def verdict(twin: Twin) -> str:
    """Return in a sentence whether the scene explains the recording."""
    if twin.explains:
        return f"the twin explains the recording: misfit {twin.misfit_lit:.3f} (1 is the noise)"
    what = f"the scene does not explain the recording: misfit {twin.misfit_lit:.3g}, more than {LIMIT:g}"
    return f"{what}; free more parameters, or give the scene what the camera has"


def frames_figure(twin: Twin) -> Figure:
    """Draw some frames, their fits, and the residuals in standard deviations, from the best to the worst explained."""
    frames = sorted((one for one in twin.frames if one.counts is not None), key=lambda one: one.misfit)
    drawn = new_figure(1.55 * len(frames) + 1.0, 4.9, pictures=True)
    axes = drawn.subplots(3, len(frames), squeeze=False)
    for column, one in enumerate(frames):
        assert one.counts is not None and one.expected is not None and one.deviation is not None
        top = float(max(one.counts.max(), one.expected.max()))
        low = float(np.median(one.counts))
        for row, picture in enumerate((one.counts, one.expected)):
            axes[row, column].imshow(
                np.sqrt(np.maximum(picture - low, 0)), cmap="gray", vmin=0, vmax=(top - low) ** 0.5
            )
        rest = (one.counts - one.expected) / one.deviation
        last = axes[2, column].imshow(rest, cmap="RdBu_r", vmin=-4, vmax=4)
        axes[0, column].set_title(f"frame {one.index}\nmisfit {one.misfit:.2f}", fontsize=LABEL)
        for row in range(3):
            axes[row, column].set_xticks([])
            axes[row, column].set_yticks([])
        if column == len(frames) - 1:
            drawn.colorbar(last, ax=axes[2, :].tolist(), shrink=0.9, label="deviations")
    for row, name in enumerate(("frame", "twin", "residual")):
        axes[row, 0].set_ylabel(name, fontsize=LABEL)
    return drawn


def parameters_figure(twin: Twin) -> Figure:
    """Draw by how many usual spreads each parameter differs from the scene's, and the frames' gazes and misfits."""
    drawn = new_figure(9.0, 3.8)
    left, right = drawn.subplots(1, 2, width_ratios=[1.25, 1])
    told = [one for one in twin.parameters if one.told and math.isfinite(one.spread) and one.spread > 0]
    places = np.arange(len(told))[::-1]
    off = [(one.value - one.before) / one.spread for one in told]
    wide = [3 * (one.deviation or 0.0) / one.spread for one in told]
    left.errorbar(off, places, xerr=wide, fmt="o", color=MODELS[0], markersize=4, capsize=2)
    left.axvline(0, color=QUIET, linewidth=1)
    left.set_yticks(places, [one.name for one in told])
    dress(left, title="Twin less scene", x="usual spreads between copies", letter="a")
    gazes = np.array([one.label for one in twin.frames])
    dots = right.scatter(*gazes.T, c=[one.misfit for one in twin.frames], s=16, cmap="viridis")
    right.invert_yaxis()
    drawn.colorbar(dots, ax=right, label="misfit")
    dress(right, title="Frames", x="gaze x", y="gaze y (down)", letter="b")
    return drawn


def write_twin(twin: Twin, path: str | os.PathLike[str]) -> None:
    """Write the page of a twin."""
    rows = [
        (
            one.name,
            shown(one, one.before),
            shown(one, one.value),
            shown(one, one.deviation) if one.told else "not determined by this recording",
        )
        for one in twin.parameters
    ]
    lost = [
        f"{one.name}: the frames know it no better than the usual spread of {shown(one, one.spread)}"
        + (f"; {', '.join(one.like)} would change them alike" if one.like else "")
        + ". It keeps the scene's value."
        for one in twin.untold
    ]
    numbers = [
        ("misfit of the lit pixels", f"{twin.misfit_lit:.3f} ({twin.before.misfit_lit:.3g} as the scene was)"),
        ("misfit of all pixels", f"{twin.misfit:.3f} ({twin.before.misfit:.3g})"),
        ("log-likelihood over the scene's as it was", f"{twin.gain:.4g}"),
        ("frames", str(len(twin.frames))),
        ("scatter of their brightness", f"{100 * twin.scatter:.2g} %"),
        ("a gaze read with the twin, deviation in common", "x {:.2g}, y {:.2g} of the field".format(*twin.systematic)),
        ("search", "converged" if twin.converged else "not converged: run it with more frames or another seed"),
    ]
    pieces = [
        note(verdict(twin)),
        section("Measured", facts(numbers)),
        section("Parameters", table(["", "scene", "twin", "standard deviation"], rows)),
        section(
            "Frames",
            figure(
                frames_figure(twin),
                alt=f"Frames, fits and residuals of {len(twin.frames)} frames; misfit {twin.misfit_lit:.3f}.",
                caption="Brightness as the root. Residuals in standard deviations of each pixel's noise.",
            ),
            figure(
                parameters_figure(twin),
                alt="Parameters of the twin less the scene's, and the frames' gazes with their misfits.",
                caption="(a) With three standard deviations. (b) The labels of the frames used.",
            ),
        ),
    ]
    if lost:
        pieces.insert(3, section("Not determined by this recording", bullets(lost)))
    foot = f"Tapetum {importlib.metadata.version('tapetum')}; recording {twin.recording['name']}"
    write_page(path, page("Twin of a camera", *pieces, footer=foot))
