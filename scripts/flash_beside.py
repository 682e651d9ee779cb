"""What a phone's flash 10 mm beside its lens sees of a camera that looks at it: the range that `serve`'s scan states.

    .venv/bin/python scripts/flash_beside.py

The camera looks straight at the phone. By rays its return is a disc about the flash of radius 2 a |1 - d/x|, where a is
its aperture's radius, d the distance and x its object distance: the phone's lens stands 10 mm beside the middle.
Fresnel's integral over the aperture adds what diffraction brings there, which the simulator's pictures are too coarse
for; where rays arrive, the simulator itself is asked too, through centred apertures of 10 mm less and more the lens's
radius.

The return is compared with a pixel's light from a wall of reflectance 0.3 at the same distance in the same light, and
with the glint that the front of the camera's lens throws back as a ball does.

Assumed: light of 550 nm in place of white; a sensor that reflects a tenth; a front of 3 mm radius that reflects one
percent; a phone with f = 4.3 mm, f/1.8, pixels of 1.4 micrometres.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import j0

from tapetum.bench import load_scene, with_values
from tapetum.simulate import Camera
from tapetum.simulate.radiometry import irradiance_at_target

APART = 10e-3
FOCAL, RADIUS, PIXEL = 4.3e-3, 4.3e-3 / 1.8 / 2, 1.4e-6
WAVELENGTH = 550e-9
WALL, REFLECTANCE = 0.3, 0.1
FRONT_RADIUS, FRONT = 3e-3, 0.01
DISTANCES = (0.3, 0.5, 1.0, 2.0)


@dataclass(frozen=True)
class Watched:
    """A camera that looks at the phone: its name, focal length, aperture's radius and object distance, in metres."""

    name: str
    focal_length: float
    radius: float
    focus: float


CAMERAS = (
    Watched("a phone, focused far away", 4.3e-3, 1.2e-3, 1e4),
    Watched("a phone, focused at 0.2 m", 4.3e-3, 1.2e-3, 0.2),
    Watched("a small camera, f = 3.6 mm, f/2, focused at 1 m", 3.6e-3, 0.9e-3, 1.0),
    Watched("a large camera, f = 50 mm, f/2.8, focused far away", 50e-3, 9e-3, 1e4),
)
# Where rays arrive and the simulator's samples fit into memory.
CHECKED = ((CAMERAS[1], 1.0),)


def share(one: Watched, distance: float) -> float:
    """Share of the light that the camera throws back which enters the phone's lens, by Fresnel's integral."""
    k = 2 * math.pi / WAVELENGTH
    bend = 2 * (1 - distance / one.focus)
    # Steps of a tenth of a radian at most, at the lens's far edge.
    turn = k * one.radius * (abs(bend) * one.radius + APART + RADIUS) / distance
    n = max(2000, math.ceil(10 * turn))
    r = (np.arange(n) + 0.5) * one.radius / n
    field = np.exp(0.5j * k * bend * r**2 / distance) * r * (one.radius / n) * k / distance
    # Over the lens's disc: chords of circles about the flash.
    rho = APART + RADIUS * np.cos(math.pi * (np.arange(200) + 0.5) / 200)
    light = np.array([abs(np.sum(field * j0(k * r * one_rho / distance))) ** 2 for one_rho in rho])
    cosine = np.clip((rho**2 + APART**2 - RADIUS**2) / (2 * rho * APART), -1, 1)
    arc = 2 * rho * np.arccos(cosine)
    step = RADIUS * np.sin(math.pi * (np.arange(200) + 0.5) / 200) * math.pi / 200
    return float(np.sum(light * arc * step)) / (math.pi * one.radius**2)


def simulated(one: Watched, distance: float) -> float:
    """The same by the simulator, from two centred apertures and the lens's part of the ring between them."""
    ring = (APART + RADIUS) ** 2 - (APART - RADIUS) ** 2
    return (_passed(one, distance, APART + RADIUS) - _passed(one, distance, APART - RADIUS)) * RADIUS**2 / ring


def _passed(one: Watched, distance: float, radius: float) -> float:
    """Share of the light thrown back that comes through a centred aperture."""
    scene = with_values(
        load_scene("thin-lens"),
        {
            "distance": distance,
            "illumination.mode": "diverging",
            "illumination.divergence": 1.0,
            "illumination.wavelength": WAVELENGTH,
            "target.lens.focal_length": one.focal_length,
            "target.lens.aperture_radius": one.radius,
            "target.object_distance": one.focus,
            "target.sensor.reflectance": REFLECTANCE,
            "probe.lens.aperture_radius": radius,
            "probe.lens.focal_length": 0.2,
            "sampling.accuracy": 0.02,
        },
    )
    camera = Camera(scene, 0.0)
    grid = camera.window(left_out=1e-4)
    image = camera.on(grid)(torch.zeros(1, 2, dtype=torch.float64))[0].double()
    watts = float(image.sum()) * grid.pitch**2
    return watts / (irradiance_at_target(scene) * math.pi * one.radius**2 * REFLECTANCE * scene.probe.transmission)


def contrast(one: Watched, distance: float) -> tuple[float, float]:
    """Light of the return, and of the front's glint, over a pixel's light from the wall."""
    # All for an irradiance of 1 W/m² at the distance.
    back = share(one, distance) * REFLECTANCE * math.pi * one.radius**2
    pixel = WALL * RADIUS**2 * (PIXEL / FOCAL) ** 2
    glint = FRONT * FRONT_RADIUS**2 / 4 / distance**2 * math.pi * RADIUS**2
    return back / pixel, glint / pixel


def main() -> None:
    """Print the tables."""
    print(f"| camera | {' | '.join(f'{d:g} m' for d in DISTANCES)} |")
    print(f"|---|{'---|' * len(DISTANCES)}")
    for one in CAMERAS:
        print(f"| {one.name} | {' | '.join(f'{contrast(one, d)[0]:.2g}' for d in DISTANCES)} |", flush=True)
    glints = [contrast(CAMERAS[0], d)[1] for d in DISTANCES]
    print(f"| the glint of its front | {' | '.join(f'{one:.2g}' for one in glints)} |\n")
    for one, d in CHECKED:
        print(f"{one.name}, {d:g} m: share {share(one, d):.3g}, by the simulator {simulated(one, d):.3g}", flush=True)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    main()
