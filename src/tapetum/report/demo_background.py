"""What stands behind the results in the demo's report: recording, labels, sign, tracking, bookkeeping."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tapetum.report import figures, html
from tapetum.report.demo_sections import seconds, share
from tapetum.report.html import Html
from tapetum.report.metrics import score_gaze, score_labels

if TYPE_CHECKING:
    from tapetum.report.demo_report import DemoReport, DemoScores


def recording(content: DemoReport) -> Html:
    """Return how the recording was made."""
    return html.join(
        [
            html.paragraph(
                "The virtual bench films what two real cameras would: the probe's video holds the "
                "retro-reflection, the target's video shows the laser as a small bright spot. Nothing "
                "else passes from the bench to the "
                "models."
            ),
            html.facts(content.recording),
        ]
    )


def labels(content: DemoReport, scores: DemoScores) -> Html:
    """Return the label error."""
    one = scores.labels
    blame = []
    if content.spots_joined is not None:
        # Two parts of the error: what the finder missed, and what moved between the two cameras' frames.
        known = np.isfinite(content.spots_joined).all(axis=1)
        finder = score_labels(content.spots_found[known], content.spots_joined[known])
        clock = score_labels(content.spots_joined, content.spots_true)
        blame.append(
            html.paragraph(
                f"Of that, finding the spot takes {finder.rms:.3f} px RMS. The rest, {clock.rms:.3f} px, is time: the "
                "two cameras run free, and the hand's tremor between two of the target's frames is faster than any "
                "interpolation between them. Cameras with a common trigger would not have it."
            )
        )
    return html.join(
        [
            html.paragraph(
                "Labels come from the target's video, as in the paper: the laser spot is found in each "
                f"frame and joined to the probe's frames by the clocks. {one.count} of {one.total} frames "
                "got one. Against the bench's own truth, kept only for this comparison, they err by "
                f"{one.median:.3f} px in the median, {one.rms:.3f} px RMS, {one.p95:.3f} px at the 95th "
                f"percentile and {one.largest:.2f} px at most; mean error ({one.bias[0]:+.3f}, "
                f"{one.bias[1]:+.3f}) px."
            ),
            *blame,
            html.figure(
                figures.fig_label_error(content.spots_found, content.spots_true),
                alt=f"Histogram and scatter of the label error: median {one.median:.3f} pixels.",
                caption="Label minus truth, in pixels of the target's video.",
            ),
        ]
    )


def retro_reflections(content: DemoReport) -> Html:
    """Return sample RRs."""
    return html.figure(
        figures.fig_samples(content.samples, content.sample_gaze),
        alt=f"{len(content.samples)} retro-reflections, each with the gaze it belongs to.",
        caption="Crops from the probe's video, square root of the counts, each on its own peak. Above "
        "each: its gaze x, y; the small frame is the target's field with the laser in it.",
    )


def sign(content: DemoReport, scores: DemoScores) -> Html | None:
    """Return what the sign of the gaze rests on."""
    one = content.sign
    if one is None:
        return None
    medians = float(np.median(one.with_beam)), float(np.median(one.without_beam))
    beam = f" ({one.beam})" if one.beam else ""
    pieces = [
        html.paragraph(
            "A gaze and its opposite give retro-reflections that are each other turned by 180°. An RR that is itself "
            "point-symmetric, as it nearly is in focus, hides the sign. Two things here show it. "
            "Out of focus the symmetry is broken: light returns over a range of angles, and each angle sees the "
            "aperture shifted a little farther (exactly, I(q; s) = I(−q; s − q/f_p)). And the beam splitter's second "
            f"beam{beam} adds a dimmer RR that sees another gaze; the paper suspects the same of its own probe (§5). "
            f"Over the field the median d′ of one frame is {medians[1]:.3g} without the second beam and "
            f"{medians[0]:.3g} with it."
        ),
        html.figure(
            figures.fig_sign_map(one.x, one.y, one.with_beam, one.without_beam),
            alt=f"Maps of d prime over the field: median {medians[0]:.2g} with the second beam, "
            f"{medians[1]:.2g} without.",
            caption="How well an ideal observer of one noisy frame, who knows all but the sign, tells a "
            "gaze from its opposite, wherever the camera stands. With equal odds the sign is right with "
            "probability Φ(d′/2): d′ = 1 means 69 %, d′ = 3 means 93 %.",
        ),
    ]
    if one.rates:
        said = "; ".join(
            f"{rate.model} {'with' if rate.second_beam else 'without'} the second beam: "
            + ", ".join(
                f"{axis} {share(right / n if n else None)}"
                for axis, right, n in zip("xy", rate.right, rate.counted, strict=True)
            )
            for rate in one.rates
        )
        pieces.append(
            html.figure(
                figures.fig_sign_rates(one.rates),
                alt=f"Share of frames whose sign was predicted correctly. {said}.",
                caption="What the models here make of it: both learned with the second beam and were then shown frames "
                "without it. "
                f"Measured over frames with |gaze| > {scores.baseline.sign_threshold:g} of the field. "
                "Bars: 95 % Wilson intervals that take frames "
                "for independent; neighbours in a video are not, so they are too short.",
            )
        )
    return html.join(pieces)


def tracking(content: DemoReport) -> Html | None:
    """Return how the whole frames were tracked."""
    one = content.tracking
    if one is None:
        return None
    names, counts = np.unique(one.track, return_counts=True)
    found = len(np.unique(one.time[np.isfinite(one.snr)]))
    said = (
        f"From {one.frames} whole probe frames: the RR was seen in {found} "
        f"({share(found / max(one.frames, 1))}), in {len(names)} "
        f"{'track' if len(names) == 1 else 'tracks'}, the longest of {int(counts.max())} frames. Each row "
        f"of `{one.file}` has its place, signal-to-noise ratio and estimates."
    )
    pieces = [html.paragraph(said)]
    if one.truth is not None and one.predicted is not None:
        gaze = score_gaze(one.truth, one.predicted)
        pieces.append(
            html.paragraph(
                f"Gaze along the tracks, found and cropped without help: MAE {gaze.mae[0]:.3f} in x and "
                f"{gaze.mae[1]:.3f} in y over {gaze.count} rows that have a label."
            )
        )
    drawn = figures.fig_tracks(one.frame, one.track, one.x, one.y, one.time, one.snr)
    pieces.append(
        html.figure(
            drawn,
            alt=f"The probe's picture with {len(names)} tracks, and their signal-to-noise ratio over time.",
            caption="(a) One probe frame, square root of what stands above its background, with the "
            "tracks over it. (b) Signal-to-noise ratio of the detections; gaps are frames the tracker "
            "coasted through.",
        )
    )
    return html.join(pieces)


def limits(content: DemoReport) -> Html:
    """Return what the numbers do not say."""
    fixed = [
        "Simulation only: one thin lens, a mirror for a sensor, scalar monochromatic light. No real camera was filmed.",
        "The training and the held-out frames come from the same simulated camera and probe; another "
        "camera, focus or alignment needs a model of its own.",
        "Frames of a video resemble their neighbours: the numbers vary more from recording to recording "
        "than the number of frames suggests.",
    ]
    if content.sign is not None:
        fixed.append(
            "What shows the sign of the gaze here, defocus and the probe's second beam, another camera or probe may "
            "not have."
        )
    return html.bullets([*fixed, *content.limits])


def paper(scores: DemoScores) -> Html:
    """Return the little the paper prints in its text beside what was measured here."""
    first_name, first = scores.models[0]
    edge = first.thirds[2].mae
    rows = [
        [
            "Gaze of phones, ResNet-18",
            "MAE 0.095 of the field (§5.1.2)",
            "not part of the demo: `tapetum paper table2`",
        ],
        [
            "Near the edge of the field",
            "error of both models close to half the field, “equivalent to random guessing” (§5.1.1)",
            "no such frame" if edge is None else f"{first_name}, outer third: MAE {edge:.3f}",
        ],
        [
            "Away from the centre",
            "the error grows; ResNet-18 is most ahead of the Zernike model at moderate angles (§5.1.1)",
            "see “Where the errors are”",
        ],
        [
            "The sign of the gaze",
            "the beam splitter's dim second component “may” be what ResNet-18 uses (§5)",
            "see “What the sign rests on”",
        ],
    ]
    return html.join(
        [
            html.table(["", "the paper", "here"], rows),
            html.paragraph(
                "The paper filmed real lenses, ours is a simulated thin one over a narrower field: the "
                "two columns stand beside each other to be read, not to be compared. Paper: T. Seets, A. "
                "Epstein, A. Velten, “Watching the watchers: camera identification and characterization "
                "using retro-reflections”, Optics Express (2024)."
            ),
        ]
    )


def bookkeeping(content: DemoReport) -> Html:
    """Return every seed, size, time and version, and what else the demo wrote."""
    pieces: list[Html] = []
    if content.timings:
        total = sum(value for _, value in content.timings)
        rows = [*((what, seconds(value)) for what, value in content.timings), ("all of it", seconds(total))]
        pieces.append(
            html.section("Times", html.table(["step", "time"], rows, numeric=[1], best=len(rows) - 1), level=3)
        )
    if content.seeds:
        rows = [(what, str(value)) for what, value in content.seeds]
        pieces.append(html.section("Seeds", html.table(["what", "seed"], rows, numeric=[1]), level=3))
    if content.sizes:
        pieces.append(html.section("Sizes", html.facts(content.sizes), level=3))
    if content.versions:
        pieces.append(html.details("Software", html.facts(content.versions)))
    if content.files:
        named = ((f"`{name}`", what) for name, what in content.files)
        pieces.append(html.section("Files beside this page", html.facts(named), level=3))
    if content.next_steps:
        steps = ((f"`{command}`", what) for command, what in content.next_steps)
        pieces.append(html.section("What to try next", html.facts(steps), level=3))
    return html.join(pieces)
