"""What is written beside Figs. 9 to 12 and Tables 1 and 2."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tapetum.report.evaluation import Group
from tapetum.report.paper.learning import CENTRE, LIMIT, Fig10, Fig12, Row
from tapetum.report.paper.page import filled, table_of

__all__ = ["text_fig9", "text_fig10", "text_fig11", "text_fig12", "text_table1", "text_table2"]

_SIMULATION = """**Here**: simulation throughout. The virtual bench films stand-ins for the paper's lenses and phones.
The first 80 % of every video train, the last 20 % are scored."""


def text_table1(rows: Sequence[Row], classes: dict[str, Any]) -> str:
    """The page table1.md."""
    lines = [
        (
            row.task,
            row.model,
            f"{_number(row.mae)} / {_number(row.rmse)}",
            row.unit,
            _number(row.guess_mae),
            "–" if row.coverage is None else f"{100 * row.coverage:.0f}",
            row.printed or "",
        )
        for row in rows
    ]
    names = ("task", "model", "MAE / RMSE", "unit", "the mean's MAE", "in 90 % intervals (%)", "the paper")
    frames = ", ".join(f"{row.frames} ({row.task})" for row in _first_of_each(rows))
    return filled(f"""# Table 1: the errors of all models

**The paper** (section 5.1) prints its table as a picture, whose numbers we do not have: those cells stay empty. Its
text says: the phones' gaze has an MAE of 0.095 of the field, 11 phones are told apart with 99 % top-1, and ResNet-18 is
better than the Zernike model on both focus targets.

{_SIMULATION} Frames scored: {frames}.

{table_of(names, lines)}

**Phones told apart**: top-1 {100 * classes["top_1"]:.2f} % of {classes["frames"]} frames of {len(classes["per_class"])}
phones (always the commonest: {100 * (classes["baseline_top_1"] or 0):.0f} %; the paper: 99 % of 11), expected
calibration error {classes["expected_calibration_error"]:.4f}; {100 * classes["told_none_of_these"]:.1f} % of these
frames are taken for none of the phones.

*Zernike + ridge* is the paper's model: 1092 features, nothing standardised, α = 1e-6, every training frame fitted, and
so no intervals. Crops are centred by our reading of the paper's centring. *Tuned* standardises the
features, picks α by cross-validation and keeps a tenth of every video's training frames aside for its intervals.
*ResNet-18* keeps the same tenth aside; on the phones one network tells the gaze and the phone.

**What differs**: lenses, sensors and phones are stand-ins, the second beam's place and strength are assumed, and labels
have no error beyond that of finding the laser's spot in the target's video. A task that is easier here than in the
paper says that the bench lacks what makes it hard.
""")


def text_table2(groups: Sequence[Group], gaze: tuple[int, int] = (0, 1)) -> str:
    """The page table2.md."""
    x, y = gaze
    lines = [
        (
            one.name,
            f"{one.count}",
            *(f"{one.mae[k]:.4f} / {one.rmse[k]:.4f}" for k in (x, y)),
            f"{(one.mae[x] + one.mae[y]) / 2:.4f}",
        )
        for one in groups
    ]
    order = sorted(groups, key=lambda one: one.mae[x] + one.mae[y])
    names = ("phone", "frames", "x: MAE / RMSE", "y: MAE / RMSE", "mean MAE")
    return filled(f"""# Table 2: the error of the gaze for each phone

**The paper** (section 5.1.2) prints its table as a picture, whose numbers we do not have. Its text says: the error
depends on the phone; it is largest for one with faint RRs and least for one with two clear ones.

{_SIMULATION} Errors in fractions of the field of the phone's main camera. None of these phones is one of the paper's.

{table_of(names, lines)}

Least error: {order[0].name}; largest: {order[-1].name}, {_ratio(order[-1], order[0], x, y):.1f} times as large.
""")


def text_fig9(numbers: dict[str, Any]) -> str:
    """The page fig9.md."""
    x, y = numbers["mae"]
    return filled(f"""# Fig. 9: the gaze of the Rotation set's test frames

![The path of the gaze over the field, and x and y of all test frames, with ResNet-18's predictions](fig9.png)

**The paper** (section 5.1.1): predictions are in general close to the truth, with a few noticeable outliers, most
likely where frames have little signal.

{_SIMULATION} {numbers["frames"]} frames. MAE {x:.4f} in x and {y:.4f} in y of the field; RMSE {numbers["rmse"][0]:.4f}
and {numbers["rmse"][1]:.4f}; the worst estimate is {numbers["worst"]:.3f} off.

(a) A stretch of one video over the field of view, coloured by time. (b, c) x and y of all test frames; shaded: the 90 %
intervals.

**What differs**: behind the path the paper shows the target's picture of the room.
""")


def text_fig10(found: Fig10) -> str:
    """The page fig10.md."""
    titles = list(found.errors)
    first = found.errors[titles[0]]
    lines = []
    for ring in range(len(first.centre)):
        cells = [f"{first.edges[ring]:.2f} – {first.edges[ring + 1]:.2f}", f"{first.count[ring]}"]
        cells += [_number(float(found.errors[title].mae[ring])) for title in titles]
        lines.append(tuple(cells))
    limits = [
        (
            f"{at:.2f}",
            *(_number(1e4 * float(limit.rms[k])) for limit in found.limits.values()),
            f"{found.ratio[k]:.0f}" if np.isfinite(found.ratio[k]) else "–",
        )
        for k, at in enumerate(found.limits[LIMIT].distance)
    ]
    names = [f"{name} (1e-4)" for name in found.limits]
    return filled(f"""# Fig. 10: the error by distance from the centre of the field

![Mean absolute error of the gaze by distance from the centre, for all models and the Cramér-Rao limit](fig10.png)

**The paper** (section 5.1.1): the error grows as the target looks farther away from the probe. The two models differ
most at moderate distances. Near the edge of the field (0.5) both are close to guessing.

{_SIMULATION} MAE, mean over x and y, in fractions of the field:

{table_of(("distance", "frames", *titles), lines)}

**The limit**. No unbiased estimate from one frame has a standard deviation below the Cramér-Rao limit, of which the
figure draws the mean absolute value of a normal error. It is that of the scene's light and noise, with the brightness,
the place, the turn about the axis and the place among the photosites unknown. An estimate that knew which photosite the
spot falls on could do far better (second column): the pattern turns over from one photosite to the next, some 4e-4 of
the field. RMS limits, and ResNet-18's RMSE over the first:

{table_of(("distance", *names, "ResNet-18 over it"), limits)}

In the centre half of the field (below {CENTRE:g}) ResNet-18's RMSE is {found.centre_rmse:.2g} of the field,
{found.centre_ratio:.0f} times the limit. {_labels(found.label_rmse)}
""")


def text_fig11(numbers: dict[str, Any]) -> str:
    """The page fig11.md."""
    lines = []
    for title, targets in numbers.items():
        x_d, f_t = targets["object_distance"], targets["focal_length"]
        told = (x_d["mae"], x_d["rmse"], 1e3 * f_t["mae"], 1e3 * f_t["rmse"])
        lines.append((title, *(_number(one) for one in told)))
    names = ("model", "x_d: MAE (m)", "RMSE (m)", "f_t: MAE (mm)", "RMSE (mm)")
    return filled(f"""# Fig. 11: object distance and focal length by test image

![Predicted object distance and focal length of every test frame of the Focusing set, both models](fig11.png)

**The paper** (section 5.1.1): ResNet-18 predicts the combinations of x_d and f_t, and outperforms the Zernike model for
both.

{_SIMULATION}

{table_of(names, lines)}

Frames are sorted by the true object distance and, within it, by the true focal length. Shaded: ResNet-18's 90 %
intervals.
""")


def text_fig12(found: Fig12) -> str:
    """The page fig12.md."""
    parts: list[str] = []
    for k, (name, unit, scale) in enumerate((("object_distance", "mm", 1e3), ("focal_length", "mm", 1e3))):
        lines = []
        for row, length in enumerate(found.focal_lengths):
            pairs = zip(found.mae[name][row], found.limits.mae[:, row, k], strict=True)
            lines.append(
                (f"{1e3 * length:.0f} mm", *(f"{_number(scale * e)} ({_number(scale * b)})" for e, b in pairs))
            )
        title = {"object_distance": "Object distance", "focal_length": "Focal length"}[name]
        head = ("f_t", *(f"{x:g} m" for x in found.object_distances))
        parts.append(f"{title}: MAE in {unit}, in brackets that of the Cramér-Rao limit.\n\n{table_of(head, lines)}")
    tables = "\n\n".join(parts)
    return filled(f"""# Fig. 12: where the focus is told badly

![ResNet-18's mean absolute error over object distance and focal length, the limit, and their ratio](fig12.png)

**The paper** (section 5.1.1): ResNet-18 struggles most at the shortest focal length and at far object distances, for a
short lens has more depth of field.

{_SIMULATION}

{tables}

The limit is that of one frame near the middle of the field, with object distance, focal length, gaze, brightness and
place all unknown. It is far below what is reached, since the whole ring pattern tells the defocus to a small part of a
wavelength, and knows of eighteen pairs only what the picture says: a network that has learned that there are six
distances and three focal lengths could be below it.
""")


def _labels(rmse: float | None) -> str:
    if rmse is None:
        return "Counted from the labels, whose own error is in it."
    return f"Counted from where the target really looked; the labels it learned from are off by {rmse:.2g}."


def _first_of_each(rows: Sequence[Row]) -> list[Row]:
    seen: dict[str, Row] = {}
    for row in rows:
        seen.setdefault(row.task.split(",")[0], row)
    return list(seen.values())


def _ratio(large: Group, small: Group, x: int, y: int) -> float:
    return (large.mae[x] + large.mae[y]) / max(small.mae[x] + small.mae[y], 1e-12)


def _number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "–"
