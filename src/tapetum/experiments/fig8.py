"""Fig. 8: one retro-reflection of each phone, with the camera app open and closed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tapetum.bench import Scene, load_scene, phone_names, with_values
from tapetum.errors import InputError
from tapetum.experiments.fig7 import Sample, measured
from tapetum.experiments.measure import holding_diameter
from tapetum.progress import Progress, quiet
from tapetum.simulate import Camera, Image, expose
from tapetum.simulate.camera import sensor_grid
from tapetum.simulate.gaze import largest_sine, tilt_of_gaze
from tapetum.simulate.phone import phone_scenes, seen_from_probe
from tapetum.simulate.radiometry import photoelectrons

__all__ = ["GAZE", "SHUT", "Fig8", "simulate_fig8"]

GAZE = (0.03, 0.02)
# Prepare lenses for gazes up to here, as for a video: fits over a tiny tilt range miss a pupil's edge.
_UP_TO = (0.1, 0.05)
# Phones whose filters pass most of the light at 785 nm; the others' block their sensors' returns.
_FEW = ("phone-02", "phone-11")
SHUT = {"paper": ("phone-02", "phone-05", "phone-07", "phone-11"), "laptop": _FEW, "small": _FEW}
_SHARE = 0.5

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fig8:
    """The phones with the app open, and some of them with it closed; `disc` is D_p f_p/d in metres."""

    opened: list[Sample]
    shut: list[Sample]
    disc: float
    full_scale: int
    pitch: float

    def numbers(self) -> dict[str, Any]:
        """What fig8.json holds."""
        return {
            "gaze": list(GAZE),
            "aperture_image_um": 1e6 * self.disc,
            "full_scale": self.full_scale,
            "open": [{"name": one.name, **one.row} for one in self.opened],
            "shut": [{"name": one.name, **one.row} for one in self.shut],
        }


def simulate_fig8(
    *, size: str = "paper", names: tuple[str, ...] | None = None, seed: int = 1, progress: Progress = quiet
) -> Fig8:
    """Take the samples of the paper's section 4.5, of all phones in the catalogue or those in `names`.

    The sizes `laptop` and `small` take fewer samples with the app closed than `paper`.
    """
    base, wanted = load_scene("phones"), names or tuple(phone_names())
    opened, shut = list[Sample](), list[Sample]()
    for number, name in enumerate(progress(wanted, "fig8", total=len(wanted))):
        scene = with_values(base, {"target.name": name})
        refused = list[str]()
        parts = _parts(scene, refused)
        row = {**_told(scene, parts), "refused": refused}
        if name in SHUT[size]:
            idle = with_values(scene, {"target.imaging": False})
            # The other cameras never image.
            dark = [_parts(idle, refused, first_only=True)[0], *parts[1:]]
            row["flash_electrons"] = float((parts[0] - dark[0]).max())
            shut.append(_taken(name, idle, dark, seed + 100 + number, _told(idle, dark)))
        opened.append(_taken(name, scene, parts, seed + number, row))
    probe = base.probe
    disc = 2 * probe.lens.aperture_radius * probe.lens.focal_length / base.distance
    return Fig8(opened, shut, disc, 2**probe.sensor.bits - 1, probe.sensor.pitch)


def _parts(scene: Scene, refused: list[str], *, first_only: bool = False) -> list[Array]:
    """Electrons [H, W] from every camera of a phone, the gaze's camera first; zero for `refused` ones."""
    sines, farthest = tilt_of_gaze(scene, torch.tensor([GAZE, _UP_TO], dtype=torch.float64))[:, None]
    units = sorted(phone_scenes(scene), key=lambda unit: unit.place != (0.0, 0.0))
    found: list[Array] = []
    for unit in units[: 1 if first_only else None]:
        aside = seen_from_probe(torch.tensor([unit.place], dtype=torch.float64), sines) / scene.distance
        at = scene.probe.lens.focal_length * aside
        try:
            own = unit.sines(torch.cat([sines, farthest]), aside)
            image = Camera(unit.scene, largest_sine(own), output=sensor_grid(scene))(own[:1], at)[0]
        except InputError as error:
            # A camera that the engine refuses is named and must not hide the others.
            refused.append(f"camera at {unit.place}: {error}")
            image = torch.zeros(scene.probe.sensor.pixels[::-1])
        light = photoelectrons(image, scene.probe.sensor, scene.illumination.wavelength)
        found.append(light.double().cpu().numpy())
    return found


def _told(scene: Scene, parts: list[Array]) -> dict[str, Any]:
    """Number of cameras visible, and width of the brightest one's return."""
    sensor = scene.probe.sensor
    noise = np.sqrt(sensor.background + sensor.read_noise**2)
    brightest = max(parts, key=lambda one: float(one.max()))
    y, x = (round(float((np.indices(brightest.shape)[axis] * brightest).sum() / brightest.sum())) for axis in (0, 1))
    half = min(150, y, x, brightest.shape[0] - 1 - y, brightest.shape[1] - 1 - x)
    around = brightest[y - half : y + half + 1, x - half : x + half + 1]
    return {
        "cameras": len(parts),
        "seen": sum(bool(one.max() > 3 * noise) for one in parts),
        "peaks_electrons": [float(one.max()) for one in parts],
        "disc_um": 1e6 * holding_diameter(around, sensor.pitch, _SHARE) / np.sqrt(_SHARE),
    }


def _taken(name: str, scene: Scene, parts: list[Array], seed: int, row: dict[str, Any]) -> Sample:
    sensor, wavelength = scene.probe.sensor, scene.illumination.wavelength
    per_unit = float(photoelectrons(torch.ones((), dtype=torch.float64), sensor, wavelength))
    light = np.sum(parts, axis=0) / per_unit
    image = Image(torch.from_numpy(light)[None], sensor.pitch, {"wavelength": wavelength})
    counts, sizes = measured(expose(image, scene.probe, seed)[0], light, scene)
    return Sample(name, counts, {**row, **sizes})
