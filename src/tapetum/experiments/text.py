"""What is written beside each figure: what the paper reports, what was measured here, and what differs."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tapetum.experiments.fig4 import DISTANCES, ROTATIONS, Fig4
from tapetum.experiments.fig5 import LENS, Fig5
from tapetum.experiments.fig6 import Fig6
from tapetum.experiments.fig7 import AT, GAZE, Fig7, Sample
from tapetum.experiments.fig8 import GAZE as PHONE_GAZE
from tapetum.experiments.fig8 import Fig8
from tapetum.experiments.measure import PowerLaw
from tapetum.experiments.page import filled, table_of

__all__ = ["text_fig4", "text_fig5", "text_fig6", "text_fig7", "text_fig8"]


def text_fig4(found: Fig4) -> str:
    """The page fig4.md."""
    focal = sorted({row["focal_length_mm"] for row in found.rows}, reverse=True)
    rows = [
        (
            f"{f:g}",
            f"{x_d:g}",
            *(f"{found.row(f / 1e3, x_d, t)['diameter_mm']:.2f}" for t in ROTATIONS),
            *(_apart(found.row(f / 1e3, x_d, t)) for t in ROTATIONS[1:]),
            *(f"{100 * found.row(f / 1e3, x_d, t)['mirror_up_down']:.0f}" for t in ROTATIONS[1:]),
        )
        for f in focal
        for x_d in DISTANCES
    ]
    names = (
        "f (mm)",
        "x_d (m)",
        "80 % in (mm), 0°",
        "0.5°",
        "1°",
        "rings apart (mm), 0.5°",
        "1°",
        "up/down (%), 0.5°",
        "1°",
    )
    table = table_of(names, rows)
    first = focal[0] / 1e3
    turned = [found.row(first, x_d, ROTATIONS[-1]) for x_d in DISTANCES]
    windows = ", ".join(f"{1e3 * width:g}" for width in found.windows)
    rim = max(row["rim_over_peak"] for row in found.rows)
    left_right = max(row["mirror_left_right"] for row in found.rows)
    stretch = ", ".join(f"{row['width_x_mm'] / row['width_y_mm']:.2f}" for row in turned)
    focused = ", ".join(f"{x_d:g}" for x_d in DISTANCES)
    side = found.images.shape[-1]
    shrinks = all(
        found.row(f / 1e3, a, t)["diameter_mm"] > found.row(f / 1e3, b, t)["diameter_mm"]
        for f in focal
        for t in ROTATIONS
        for a, b in pairwise(DISTANCES)
    )
    sized = "becomes smaller" if shrinks else "does not always become smaller"
    rounds = [row["width_x_mm"] / row["width_y_mm"] for row in found.rows if not row["rotation_deg"]]
    pairs = [(row["ring_centres_apart_mm"], row["ring_centres_expected_mm"]) for row in found.rows]
    ratios = [apart / expected for apart, expected in pairs if apart is not None and expected]
    parted = (min(ratios), max(ratios)) if ratios else (float("nan"), float("nan"))
    mirrored = [row["mirror_up_down"] for row in found.rows if row["rotation_deg"]]
    least, most = (edge(row["return_radius_at_probe_mm"] for row in found.rows) for edge in (min, max))
    return filled(f"""# Fig. 4: a thin lens, turned and refocused

![Retro-reflections of three thin lenses, turned and refocused](fig4.png)

**The paper** (section 4.1; f = 75 and 50 mm are in its supplement): looking straight at the probe the lens gives an
Airy disc. At small rotations two patterns like Airy discs appear, symmetric across the line perpendicular to the
rotation and farther apart as the rotation grows; at large ones often a long ellipse. The smaller x_d, the larger
the RR, and the more it resembles the target's aperture. Simulation and experiment agree for f = 100 mm, "albeit
with fewer details" in the experiment; for 75 and 50 mm only the general shapes do.

**Here**: collimated light of 640 nm, the probe 5 m away with f_p = 200 mm, an aperture radius of 3 mm (assumed: the
paper gives none), rotation about x. The windows are {windows} mm wide for x_d = 1, 2.5 and 5 m, in {side} pixels a
side, so that each RR is seen whole: no pixel of a rim is above {100 * rim:.1f} % of its image's peak. The planner
states an error of at most {found.expected_error:.0e} of the peak.

{table}

*80 % in*: diameter of the circle about the middle that holds 80 % of the light in the window. *Rings apart*:
distance of the centres of the two ring systems on the middle column, and in brackets what rays expect: f_p · 2z
tanθ · 2/(x_d + f), the returning pupil's displacement times the returning wave's curvature. Each centre is the
column's highest maximum within 1.5 λ f_p/2r (32 µm) of that place. *Up/down*: light that the image and its mirrored
self across the horizontal line do not share; a picture and something wholly apart from it would give 100.

- **Size**: the RR {sized} as x_d grows (all focal lengths and rotations).
- **At 0°** its width over its height lies between {min(rounds):.2f} and {max(rounds):.2f}.
- **Two ring systems** part along the direction of rotation (up and down): where both are found, their distance is
  {parted[0]:.2f} to {parted[1]:.2f} times what rays expect. Across the horizontal line {100 * min(mirrored):.0f} to
  {100 * max(mirrored):.0f} % of the light is not shared; left and right are the same to {left_right:.0e} of it.
- **At 1°** the bright part is {stretch} times as wide across the direction of rotation as along it (widths with 80 % of
  the light, f = {1e3 * first:g} mm, x_d = {focused} m). The paper has its ellipse "in the direction of rotation".

**What differs**: the real lens has aberrations, and its target is a real sensor with pixels; neither is in this
thin lens with a mirror. Nothing here was compared with the paper's images themselves, only with what it says of
them. All of the return is shown, whatever the probe's aperture: at the probe its radius is {least:.1f} to
{most:.1f} mm.
""")


def text_fig5(found: Fig5) -> str:
    """The page fig5.md."""
    first, last = found.distances[0], found.distances[-1]
    rows = [
        (
            strip.name,
            f"{1e6 * strip.exposure:.2g}",
            _fitted(strip.measured),
            _fitted(strip.without_floor),
            f"{100 * strip.signal[-1] / strip.total[-1]:.0f}",
            f"{1e3 * strip.diameter[0]:.2f}",
            f"{1e3 * strip.diameter[-1]:.2f}",
            f"{1e3 * strip.diameter.min():.2f} to {1e3 * strip.diameter.max():.2f}",
        )
        for strip in found.strips
    ]
    names = (
        "target",
        "exposure (µs)",
        "exponent, above the floor",
        "exponent, all light",
        f"light kept at {last:g} m (%)",
        f"80 % in (mm), {first:g} m",
        f"{last:g} m",
        "range",
    )
    strip, points = found.strips[0], len(found.distances)
    middle = min(found.distances, key=lambda d: abs(d - 2.5))
    from_middle = np.array(found.distances) >= middle
    times = [_fold(one.diameter) for one in found.strips]
    beyond = [_fold(one.diameter[from_middle]) for one in found.strips]
    disc = 1e3 * LENS["aperture_radius"] * 0.2 / first
    square = all(abs(one.without_floor.exponent + 2) < 0.01 for one in found.strips)
    faster = [one.name for one in found.strips if one.measured.exponent < one.without_floor.exponent]
    followed = "follows" if square else "does not follow"
    everywhere = "in every row" if len(faster) == len(found.strips) else f"in {len(faster)} rows"
    order = sorted(found.strips, key=lambda one: one.without_floor.exponent - one.measured.exponent)
    return filled(f"""# Fig. 5: head-on, from {first:g} to {last:g} m

![Frames, summed signal and size of a head-on retro-reflection over the distance](fig5.png)

**The paper** (section 4.2): with a Fujinon DV3.4x3.8SA-1 and a diverging beam of 0.5° the RR's shape does not
change much from 0.5 to 5 m, and the sum of all pixels above the noise floor falls as the beam's area grows, ∝ 1/d².

**Here**: a thin lens of 3.8 mm at f/1.4, the widest and fastest setting of that zoom, before a mirror of
reflectance 0.1; 1 mW at 640 nm from a point at the probe, 0.5° full angle. Frames have the noise of the bench's
sensor (12 bit, full well 6500 e⁻, read noise 2 e⁻; background of 10 e⁻ a pixel assumed) and are means of 4. Each
row has one exposure for all distances, chosen so that its brightest pixel is filled to 80 %: nothing saturates, at
0.5 m neither. The noise floor is 5 standard deviations of the dark mean frame, {strip.floor:.1f} e⁻. Each exponent
is a straight line through {points} points in logarithms; ± is its standard error from the residuals.

{table_of(names, rows)}

- **Intensity**: the light that comes back {followed} 1/d², as the
  beam's area says (exponents of *all light* within 0.01 of −2). What is *above a fixed floor* falls faster
  {everywhere}: the outer rings of a dim RR drop below it, an error that the ± does not hold. It is largest for
  *{order[-1].name}* and least for *{order[0].name}*.
- **Shape**: over all distances the diameter changes {times[0]:.1f}-fold (focused on the probe), {times[1]:.1f}-fold
  (left at 5 m) and {times[2]:.2f}-fold (flat wave, which is what the paper's simulation sends, its equation 1); from
  {middle:g} m on {beyond[0]:.1f}-, {beyond[1]:.1f}- and {beyond[2]:.2f}-fold. A beam that diverges from the probe is a
  spherical wave of radius d: a target focused on the probe (x_d = d, as in the paper's Rotation videos) returns it
  converging on the probe, and a probe focused at infinity sees a disc of radius r f_p/d, here {disc:.2f} mm at
  {first:g} m.

**What differs**: the paper's lens has many elements and aberrations; where these widen its RR, the same wave
changes it less, which was not simulated; which of its foci was used, and how far behind the probe's exit its beam
seems to begin, the paper does not say (a source farther away makes the wave flatter). Which is why three cases are
shown, and none is called the paper's.
""")


def text_fig6(found: Fig6) -> str:
    """The page fig6.md."""
    mirror, card = found.named("mirror"), found.named("white cardboard")
    flat, bare, glass = found.named("mirror, flat wave"), found.named("white, no spread"), found.surfaces[-1]
    first, last = found.distances[0], found.distances[-1]
    near, far = 1e3 * bare.diameter[0], 1e3 * bare.diameter[-1]
    changes = [1e3 * float(np.ptp(surface.diameter)) for surface in (mirror, card, flat)]
    brighter = [float(mirror.peak[i] / bare.peak[i]) for i in (0, -1)]
    discs, boards = glass.diameter / found.aperture_image, card.diameter / found.aperture_image
    wide = "as wide" if (np.abs(boards - 1) < 0.02).all() else "not as wide"
    proof = "no proof that a reflection is diffuse" if (np.abs(discs - boards) < 0.05).all() else "not the filter's"
    laws = [_fitted(surface.size) for surface in (card, glass, mirror, flat)]
    rows = [
        (
            f"{d:g}",
            f"{1e3 * mirror.diameter[i]:.3f}",
            f"{1e3 * flat.diameter[i]:.3f}",
            f"{1e3 * card.diameter[i]:.2f}",
            f"{1e3 * glass.diameter[i]:.2f}",
            f"{1e3 * found.aperture_image[i]:.2f}",
            f"{mirror.peak[i] / card.peak[i]:.1e}",
            f"{mirror.power[i] / card.power[i]:.1e}",
        )
        for i, d in enumerate(found.distances)
    ]
    names = (
        "d (m)",
        "mirror (mm)",
        "mirror, flat wave",
        "cardboard",
        "filter",
        "D_p f_p/d",
        "mirror/cardboard, peak",
        "power",
    )
    return filled(f"""# Fig. 6: a mirror, white cardboard, and a filter

![Retro-reflections of a mirror, of cardboard and of a filter over the distance](fig6.png)

**The paper** (section 4.3): with a Fujinon DV3.4x3.8SA-1 the diffuse RR (white cardboard at the sensor plane) is
larger, takes the shape of the probe's aperture and scales in size with d; the specular one (a mirror) is brighter
and constant in size.

**Here**: the thin lens of Fig. 5 (3.8 mm, f/1.4), focused at 5 m and left there; a diverging beam of 0.5°; a probe
with an aperture of 20 mm. All assumed, the paper gives none of these: mirror of reflectance 0.9 without scattering;
cardboard with an albedo of 0.8 and no mirror image, Lambertian, which carries light 0.3 mm (standard deviation)
sideways. Images are expected irradiance: no noise and no speckle, which a laser on real cardboard has. The size is
the diameter of the even disc that would hold half of its light in the same circle.

{table_of(names, rows)}

Fitted size ∝ dⁿ: cardboard n = {laws[0]}, filter {laws[1]}, mirror {laws[2]}, mirror in a flat wave {laws[3]}.

- **Diffuse**: {wide} as an image of the probe's aperture, D_p f_p/d, to 2 %. The light leaves the target's
  lens in a cone that overfills the probe by far; that is a condition, which the assumed 0.3 mm meet. A white plane
  that carries no
  light sideways (*white, no spread*) scatters from the spot alone, and its light comes back through the lens as a
  narrow beam, as a mirror's does: it is {near:.2f} to {far:.2f} mm wide from {first:g} to {last:g} m, and does not
  show the aperture.
- **Specular**: between {first:g} and {last:g} m its size changes by {changes[2]:.3f} mm in a flat wave and by
  {changes[0]:.2f} mm in the diverging one, for the reason given beside Fig. 5; the cardboard's changes by
  {changes[1]:.1f} mm.
- **Brighter**: in the table. The cardboard's brightness goes about as the inverse square of the assumed spread, so
  the ratios are no prediction. Without any spread the mirror's peak is still {brighter[0]:.0f} and
  {brighter[1]:.0f} times as high ({first:g} and {last:g} m).
- **A filter**: 0.2 mm before the focus a plane of reflectance 0.04 (specular, no scattering at all) returns light as if
  from a point near the lens. Its disc is {min(discs):.2f} to {max(discs):.2f} times D_p f_p/d wide, the cardboard's
  {min(boards):.2f} to {max(boards):.2f} times: the cardboard's size is {proof}.

**What differs**: the aberrations of the paper's lens, which widen the specular RR, and its unknown focus. The
diffuse image leaves out coherence across the target's pupil where the probe's aperture clips (2 to 6 % of the peak,
see the validation of the diffuse return).
""")


def text_fig7(found: Fig7) -> str:
    """The page fig7.md."""
    refused = [f"({letter}) {one.name}: {one.refused}" for letter, row in found.rows() for one in row if one.refused]
    left_out = " Not simulated: " + "; ".join(refused) + "." if refused else ""
    claimed = max(one.row["error"] for _, row in found.rows() for one in row if not one.refused)
    sizes = [one.row["diameter_um"] for one in found.focusing if not one.refused]
    lengths = [one.row["diameter_um"] for one in found.focal_lengths if not one.refused]
    smaller = "Smaller with every step" if _falls(sizes) else "Not smaller with every step"
    shrinks = "shrinks" if _falls(lengths) else "does not always shrink"
    spots = [one.row["spots_above_half"] for one in found.rotation if not one.refused]
    tall = [one.row["width_y_um"] / one.row["width_x_um"] for one in found.rotation if not one.refused]
    tables = "\n\n".join(
        table_of(
            (
                f"({letter})",
                "tilt (°)",
                "80 % in (µm)",
                "width x (µm)",
                "width y (µm)",
                "spots",
                "peak (%)",
                "saturated",
                "stated error (%)",
            ),
            [_sampled(one) for one in row],
        )
        for letter, row in found.rows()
    )
    return filled(f"""# Fig. 7: samples of Rotation and Focusing

![Simulated retro-reflections of a turning, a refocused and a zoomed camera](fig7.png)

**The paper** (section 4.4): (a) an Airy disc where the target looks straight at the probe; as it rotates the pattern
becomes elliptical and a brighter line appears perpendicular to the direction of rotation; at large rotations a strong
central ellipse with a dim "+". (b) at f_t = 135 mm the RR becomes smaller and closely approaches a point as x_d grows.
(c) shows a decreasing f_t at a fixed x_d.

**Here**: simulation of stand-ins, not the paper's cameras. (a) a published f/1.4 lens scaled to 3.8 mm for the Fujinon,
focused on the probe; (b, c) a published 18 to 140 mm zoom for the Canon, the probe {GAZE:g} of the field below its
middle. Both 5.5 m away, 640 nm, with a second beam of 10 %: its fainter RR lies up and to the left. Frames with their
noise, at the exposure of the bundled scenes `rotation` and `focusing`, cut out as a dataset does.{left_out}

{tables}

*80 % in*: circle about the crop's middle with 80 % of the light in the crop. *Spots*: connected parts above half of the
peak of the light, smoothed by 1.5 pixels. *Stated error*: the planner's, of the peak; up to {100 * claimed:.0f} %.

- **(a)** The picture's height over its width goes from {tall[0]:.2f} in the middle to {tall[-1]:.2f} at the last gaze,
  at most {max(tall):.2f} (above 1: longer along the way the target turns). The paper has its line perpendicular to
  the rotation. There are {min(spots)} to
  {max(spots)} *spots*.
- **(b)** {smaller} as the focus goes from {found.focusing[0].name} to the probe:
  {sizes[0]:.0f} to {sizes[-1]:.0f} µm. The paper's comes close to a point. A thin lens focused on the probe would
  show a disc there: it
  returns diverging light to the probe's aperture, and the probe is focused at infinity.
- **(c)** At x_d = {AT:g} m the RR {shrinks} with the focal length: {lengths[0]:.0f} to
  {lengths[-1]:.0f} µm.

**What differs**: the lenses are other ones; aberrations, filters and sensors are assumed. Nothing was compared with the
paper's pictures, only with its words.
""")


def text_fig8(found: Fig8) -> str:
    """The page fig8.md."""
    rows = [
        (
            one.name,
            f"{one.row['cameras']}",
            f"{one.row['seen']}",
            f"{one.row['disc_um']:.0f}",
            f"{100 * one.row['peak_over_full_scale']:.0f}",
            f"{one.row['saturated_pixels']}",
            f"{one.row['flash_electrons']:.1f}" if "flash_electrons" in one.row else "–",
        )
        for one in found.opened
    ]
    names = ("phone", "cameras", "seen", "disc (µm)", "peak (%)", "saturated", "flash (e⁻)")
    told = "; ".join(f"{one.name}: {text}" for one in found.opened for text in one.row.get("refused", []))
    left_out = f" Not simulated: {told}." if told else ""
    several = sum(one.row["seen"] > 1 for one in found.opened)
    burnt = sum(one.row["saturated_pixels"] > 0 for one in found.opened)
    sizes = [1e-6 * one.row["disc_um"] / found.disc for one in found.opened]
    gaze = ", ".join(f"{part:g}" for part in PHONE_GAZE)
    flashes = [one.row["flash_electrons"] for one in found.opened if "flash_electrons" in one.row]
    least, most = (min(flashes), max(flashes)) if flashes else (0.0, 0.0)
    return filled(f"""# Fig. 8: one picture of each phone

![Simulated retro-reflections of eleven phones, with the camera app open and shut](fig8.png)

**The paper** (section 4.5): at 785 nm the RRs of eleven phone models differ strongly. Each holds the return of every
camera of the phone. Early elements such as the IR filter send back strong RRs whose size goes with the distance; a
dimmer spot is there only while the camera takes pictures, most obvious in two of the models, and flashes as the camera
app is toggled.

**Here**: simulation of the catalogue's phones, clusters of published lenses of our own; none is one of the paper's.
Scene `phones`: 785 nm, 5.5 m, the probe at ({gaze}) of the main camera's field. Frames with their noise, cut out as a
dataset does.{left_out}

{table_of(names, rows)}

*Seen*: cameras whose return is above three times the dark noise of a pixel. *Disc*: diameter of the even disc that
would hold half of its light in the same circle, of the brightest return, second beam included; the probe's aperture
D_p f_p/d is {1e6 * found.disc:.0f} µm. *Flash*: the most that opening the app adds to a pixel, of the few phones in the
row below.

- **Several RRs**: {several} of {len(found.opened)} phones show more than one, at their cameras' places on the back.
- **Discs**: {min(sizes):.2f} to {max(sizes):.2f} times the image of the probe's aperture. Filters stand before the
  focus;
  they are mirrors here and not rough. Light that a filter scatters makes an even disc of the same size.
- **The spot that flashes**: in the row below what opening the app adds is {least:.0f} to {most:.0f} electrons at its
  brightest, against peaks of the whole picture in the table. The paper calls its spot dimmer than the filters' RRs.
- **Saturated**: {burnt} of {len(found.opened)} phones fill pixels of the probe's sensor at the one exposure of all.

**What differs**: which filters and lenses real phones have is not published; glints of housings and cover glasses, and
the light of dot projectors, are not in these pictures (the filmed set has the latter).
""")


def _sampled(one: Sample) -> tuple[str, ...]:
    if one.refused:
        return (one.name, *["–"] * 8)
    row = one.row
    lengths = (f"{row[key]:.0f}" for key in ("diameter_um", "width_x_um", "width_y_um"))
    peak = f"{100 * row['peak_over_full_scale']:.0f}"
    told = (f"{row['spots_above_half']}", peak, f"{row['saturated_pixels']}", f"{100 * row['error']:.1f}")
    return (one.name, f"{row['tilt_deg']:.1f}", *lengths, *told)


def _apart(row: dict[str, float | None]) -> str:
    found, expected = row["ring_centres_apart_mm"], row["ring_centres_expected_mm"]
    return f"{'–' if found is None else f'{found:.2f}'} ({expected:.2f})"


def _falls(values: Sequence[float]) -> bool:
    return all(b < a for a, b in pairwise(values))


def _fold(values: NDArray[np.float64]) -> float:
    return float(values.max() / values.min())


def _fitted(law: PowerLaw) -> str:
    return f"{law.exponent:.3f} ± {law.error:.3f}".replace("-0.000", "0.000").replace("-", "−")
