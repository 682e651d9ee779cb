"""Fig. 6: a mirror against white cardboard in the sensor's place, and a filter that looks like cardboard."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.bench import load_scene, with_values
from tapetum.experiments.fig5 import LENS, LIGHT
from tapetum.experiments.measure import PowerLaw, holding_diameter, power_law
from tapetum.progress import Progress, quiet
from tapetum.simulate import retroreflect

__all__ = ["DISTANCES", "SURFACES", "Fig6", "Surface", "simulate_fig6"]

DISTANCES = (1.5, 2.0, 3.0, 4.0, 5.0)
# Assumed: the paper gives neither the reflectances nor the lateral scattering of cardboard.
MIRROR = {"reflectance": 0.9}
CARDBOARD = {"reflectance": 0.0, "diffuse": {"albedo": 0.8, "spread": 0.3e-3}}
NO_SPREAD = {"reflectance": 0.0, "diffuse": {"albedo": 0.8, "spread": 0.0}}
FILTER = {"reflectance": 0.0, "layers": [{"depth": 0.2e-3, "reflectance": 0.04}]}
# Name, what lies at the sensor, the images' width in metres, changes of the scene.
SURFACES: tuple[tuple[str, dict[str, Any], float, dict[str, Any]], ...] = (
    ("mirror", MIRROR, 0.6e-3, {}),
    ("mirror, flat wave", MIRROR, 0.6e-3, {"illumination": {**LIGHT, "vergence": 0.0}}),
    ("white cardboard", CARDBOARD, 3.5e-3, {}),
    ("white, no spread", NO_SPREAD, 1.2e-3, {}),
    # The beam from a layer overfills the probe where the sensor's does not: propagate over the finite distance.
    ("filter 0.2 mm before the focus", FILTER, 3.5e-3, {"sampling.propagation": "finite", "sampling.accuracy": 1e-2}),
)
# Aperture of a beam splitter 20 mm wide: assumed, the paper does not give its probe's aperture.
PROBE_RADIUS = 10e-3
_FOCUS = 5.0
_SHARE = 0.5
_FINER = 3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """The returns of one surface at N distances.

    `images` are [N, H, W] irradiance in W/m² over a `window` in metres. `diameter` [N] is that of the uniform disc
    whose inner half of the light fills as large a circle, in metres; `size` its power law against the distance. `peak`
    and `power` are [N] the largest irradiance in W/m² and all light in the window in watts.
    """

    name: str
    images: Array
    window: float
    diameter: Array
    peak: Array
    power: Array
    size: PowerLaw


@dataclass(frozen=True)
class Fig6:
    """All surfaces; `aperture_image` [N] is D_p f_p/d in metres."""

    distances: tuple[float, ...]
    surfaces: list[Surface]
    aperture_image: Array
    expected_error: float

    def named(self, name: str) -> Surface:
        """The surface of that name."""
        return next(surface for surface in self.surfaces if surface.name == name)

    def numbers(self) -> dict[str, Any]:
        """What fig6.json holds."""
        mirror, card = self.named("mirror"), self.named("white cardboard")
        return {
            "distances_m": list(self.distances),
            "focused_at_m": _FOCUS,
            "probe_aperture_diameter_mm": 2e3 * PROBE_RADIUS,
            "aperture_image_mm": (1e3 * self.aperture_image).tolist(),
            "expected_error": self.expected_error,
            "mirror_over_cardboard_peak": (mirror.peak / card.peak).tolist(),
            "mirror_over_cardboard_power": (mirror.power / card.power).tolist(),
            "surfaces": [
                {
                    "name": surface.name,
                    "window_mm": 1e3 * surface.window,
                    "diameter_mm": (1e3 * surface.diameter).tolist(),
                    "peak_w_per_m2": surface.peak.tolist(),
                    "power_w": surface.power.tolist(),
                    "size_fit": asdict(surface.size),
                }
                for surface in self.surfaces
            ],
        }


def simulate_fig6(
    *,
    distances: tuple[float, ...] = DISTANCES,
    pixels: int = 300,
    accuracy: float = 1e-3,
    progress: Progress = quiet,
) -> Fig6:
    """Simulate and measure the paper's section 4.3 at three or more distances from probe to target, in metres.

    Images have `pixels` a side over windows of 0.6 mm (mirror), 1.2 mm (no spread) and 3.5 mm; the planner's `accuracy`
    is in fractions of the peak.
    """
    jobs = [(index, d) for index in range(len(SURFACES)) for d in distances]
    base, images, worst = load_scene("thin-lens"), list[Array](), 0.0
    for index, d in progress(jobs, "fig6", total=len(jobs)):
        _, sensor, window, changes = SURFACES[index]
        values: dict[str, Any] = {
            "distance": d,
            "illumination": LIGHT,
            "target.lens": LENS,
            "target.object_distance": _FOCUS,
            "target.sensor": sensor,
            "probe.lens.aperture_radius": PROBE_RADIUS,
            "sampling.accuracy": accuracy,
            **changes,
        }
        # The probe's aperture leaves fringes of λ f_p/D_p = 6.4 µm in a coherent return: a pixel holds their mean.
        fine = _FINER if values.get("sampling.propagation") == "finite" else 1
        values["probe.sensor.pixels"] = [fine * pixels, fine * pixels]
        values["probe.sensor.pitch"] = window / pixels / fine
        image = retroreflect(with_values(base, values))
        worst = max(worst, image.metadata["expected_error"])
        images.append(image.numpy()[0].reshape(pixels, fine, pixels, fine).mean(axis=(1, 3)))
    count = len(distances)
    surfaces: list[Surface] = []
    for index, (name, _, window, _) in enumerate(SURFACES):
        stack, pitch = np.stack(images[index * count : (index + 1) * count]), window / pixels
        diameter = np.array([holding_diameter(one, pitch, _SHARE) for one in stack]) / math.sqrt(_SHARE)
        surfaces.append(
            Surface(
                name=name,
                images=stack,
                window=window,
                diameter=diameter,
                peak=stack.max(axis=(1, 2)),
                power=stack.sum(axis=(1, 2)) * pitch**2,
                size=power_law(distances, diameter),
            )
        )
    aperture = 2 * PROBE_RADIUS * base.probe.lens.focal_length / np.array(distances)
    return Fig6(distances, surfaces, aperture, worst)
