"""Fig. 4: the thin lens, rotated and refocused."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks

from tapetum.bench import load_scene, with_values
from tapetum.experiments.measure import holding_diameter, mirror_error, widths
from tapetum.progress import Progress, quiet
from tapetum.simulate import retroreflect

__all__ = ["DISTANCES", "FOCAL_LENGTHS", "ROTATIONS", "Fig4", "ring_centres", "simulate_fig4"]

FOCAL_LENGTHS = (0.1, 0.075, 0.05)
ROTATIONS = (0.0, 0.5, 1.0)
DISTANCES = (1.0, 2.5, 5.0)
# Width of the window, in metres: the brightest ring of the largest RR is 1.5, 0.6 and 0.3 mm wide.
_WINDOWS = {1.0: 3.0e-3, 2.5: 1.5e-3, 5.0: 1.0e-3}
_SHARE = 0.8

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fig4:
    """The simulated images and their measurements.

    `images` are [F, D, R, H, W] irradiance in W/m² over focal lengths, object distances and rotations; `windows` the
    image widths by object distance in metres; `rows` one mapping an image, lengths in millimetres; `expected_error` the
    planner's largest, in fractions of an image's peak.
    """

    images: Array
    windows: tuple[float, ...]
    rows: list[dict[str, Any]]
    expected_error: float

    def numbers(self) -> dict[str, Any]:
        """What fig4.json holds."""
        return {
            "share_of_light": _SHARE,
            "windows_mm": [1e3 * width for width in self.windows],
            "pixels": self.images.shape[-1],
            "expected_error": self.expected_error,
            "images": self.rows,
        }

    def row(self, focal_length: float, object_distance: float, rotation: float) -> dict[str, Any]:
        """The measures of one image; metres and degrees."""
        wanted = (1e3 * focal_length, object_distance, rotation)
        keys = ("focal_length_mm", "object_distance_m", "rotation_deg")
        return next(row for row in self.rows if all(math.isclose(row[k], w) for k, w in zip(keys, wanted, strict=True)))


def simulate_fig4(
    *,
    focal_lengths: tuple[float, ...] = FOCAL_LENGTHS,
    pixels: int = 360,
    accuracy: float = 1e-3,
    progress: Progress = quiet,
) -> Fig4:
    """Simulate and measure the paper's section 4.1 for target focal lengths in metres.

    Images have `pixels` a side over windows of 3, 1.5 and 1 mm; the planner's `accuracy` is in fractions of the peak.
    """
    images, rows, worst = [], [], 0.0
    cases = [(f, x_d) for f in focal_lengths for x_d in DISTANCES]
    for focal_length, x_d in progress(cases, "fig4", total=len(cases)):
        pitch = _WINDOWS[x_d] / pixels
        scene = with_values(
            load_scene("thin-lens"),
            {
                "target.lens.focal_length": focal_length,
                "target.object_distance": x_d,
                "probe.sensor.pixels": [pixels, pixels],
                "probe.sensor.pitch": pitch,
                "sampling.accuracy": accuracy,
                # The return, up to 26 mm wide at the probe, may exceed its 25 mm aperture; collect all of it.
                "sampling.propagation": "far field",
            },
        )
        image = retroreflect(scene, ROTATIONS)
        worst = max(worst, image.metadata["expected_error"])
        taken = image.numpy()
        images.append(taken)
        for rotation, one in zip(ROTATIONS, taken, strict=True):
            wide, tall = widths(one, pitch, _SHARE)
            rim = max(one[0].max(), one[-1].max(), one[:, 0].max(), one[:, -1].max())
            row: dict[str, Any] = {
                "focal_length_mm": 1e3 * focal_length,
                "object_distance_m": x_d,
                "rotation_deg": rotation,
                "diameter_mm": 1e3 * holding_diameter(one, pitch, _SHARE),
                "width_x_mm": 1e3 * wide,
                "width_y_mm": 1e3 * tall,
                "mirror_left_right": mirror_error(one, 1),
                "mirror_up_down": mirror_error(one, 0),
                "rim_over_peak": float(rim / one.max()),
                "return_radius_at_probe_mm": 1e3 * image.metadata["return_radius_at_probe"],
                "ring_centres_apart_mm": None,
                "ring_centres_expected_mm": None,
            }
            if rotation:
                lens = scene.target.lens
                expected = _centres_apart(lens.focal_length, x_d, rotation, scene.probe.lens.focal_length)
                fringe = scene.illumination.wavelength * scene.probe.lens.focal_length / (2 * lens.aperture_radius)
                found = ring_centres(one, pitch, expected, fringe)
                row["ring_centres_expected_mm"] = 1e3 * expected
                row["ring_centres_apart_mm"] = None if found is None else 1e3 * found
            rows.append(row)
    shape = (len(focal_lengths), len(DISTANCES), len(ROTATIONS), pixels, pixels)
    return Fig4(np.stack(images).reshape(shape), tuple(_WINDOWS[x] for x in DISTANCES), rows, worst)


def _centres_apart(focal_length: float, x_d: float, rotation: float, probe_focal_length: float) -> float:
    """Distance of the two ring systems by ray optics, in metres.

    One belongs to the edge of the exit pupil, one to the image of the entrance pupil's, 2z tanθ away; the curvature
    2/(x_d + f) of the returning wave turns that distance into an angle.
    """
    z = 1 / (1 / focal_length - 1 / x_d)
    return probe_focal_length * 2 * z * math.tan(math.radians(rotation)) * 2 / (x_d + focal_length)


def ring_centres(image: Array, pitch: float, expected: float, fringe: float) -> float | None:
    """Distance of the two ring systems' bright centres on the image's middle column, in metres.

    Each is the column's highest maximum within 1.5 `fringe` (λ f_p/2r, in metres) of where it is `expected`; rings are
    about two fringes apart. None without such a maximum, as where both centres coincide.
    """
    rows = image.shape[0]
    y = (np.arange(rows) - (rows - 1) / 2) * pitch
    middle = (image.shape[1] - 1) // 2
    column = image[:, middle : middle + 1 + (image.shape[1] + 1) % 2].mean(axis=1)
    tops, _ = find_peaks(column)
    places: list[float] = []
    for side in (-1, 1):
        near = [top for top in tops if abs(y[top] - side * expected / 2) <= 1.5 * fringe and side * y[top] > 0]
        if not near:
            return None
        places.append(float(y[max(near, key=lambda top: column[top])]))
    return places[1] - places[0]
