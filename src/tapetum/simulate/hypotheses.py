"""Whether one frame distinguishes a gaze from its opposite: two-hypothesis tests on mean electrons."""

# Torch types lstsq in part only.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false

from __future__ import annotations

import torch

from tapetum.bench import PrescriptionLens, Scene
from tapetum.optics.grid import lens_numbers
from tapetum.simulate.camera import Camera
from tapetum.simulate.exposure import readout_variance
from tapetum.simulate.gaze import field_size, largest_sine, tilt_of_gaze
from tapetum.simulate.radiometry import electrons

__all__ = ["point_of_symmetry", "sign_dprime"]


def point_of_symmetry(scene: Scene) -> torch.Tensor:
    """The gaze [2], float64, in fractions of the field, at which light meets a perfect sensor at normal incidence.

    It is the middle of the field for a centred lens and an untilted sensor. A sensor tilted by a moves it to -a R from
    the lens's axis, R being the distance of the exit pupil. Gazes opposite each other about it give the same picture.
    """
    target = scene.target
    if isinstance(target.lens, PrescriptionLens):
        focused = target.lens.focused(scene.illumination.wavelength, target.object_distance)
        pupil = focused.image - focused.exit_pupil
    else:
        pupil, _ = lens_numbers(target.lens.focal_length, target.object_distance)
    sensor = target.sensor
    tilt = torch.tensor(sensor.tilt, dtype=torch.float64)
    return (torch.tensor(sensor.decentre, dtype=torch.float64) - tilt * pupil) / field_size(scene)


def sign_dprime(
    scene: Scene, gaze: torch.Tensor, *, accuracy: float = 1e-3, centre: torch.Tensor | None = None
) -> torch.Tensor:
    """Discriminability d' [N], float64, of a gaze and its opposite in one frame, the RR's place unknown, best detector.

    With equal odds the sign is right with probability Φ(d'/2): 1 means 69 %, 3 means 93 %.

    Parameters
    ----------
    scene
        Supplies the probe's noise; its own rotation is not used.
    gaze
        [N, 2], in fractions of the field.
    accuracy
        Of the simulation, in fractions of the peak: smaller differences are not resolved.
    centre
        [2], the gaze about which the opposite one lies; default: the middle of the field.

    Notes
    -----
    d'² = Σ (μ₊ - μ₋)²/(μ̄ + σ²) over the pixels, for Poisson light of means μ and read and rounding noise σ. The
    camera's place is unknown, so both pictures are aligned by their centroids, and the part of their difference that a
    shift explains is projected out.
    """
    gaze = gaze.to(torch.float64)
    opposite = -gaze if centre is None else 2 * centre - gaze
    sines = torch.stack([tilt_of_gaze(scene, gaze), tilt_of_gaze(scene, opposite)], 1)
    steepest = largest_sine(sines.flatten(0, 1))
    # As recordings treat the sensor's edge.
    rough = Camera(scene, steepest, accuracy=accuracy, edge="dimmed")
    # Room for the second beam's RR beside the first one's.
    output = rough.window(margin=True)
    camera = Camera(scene, steepest, accuracy=accuracy, output=output, edge="dimmed", pictures=4 * len(sines))
    sensor, wavelength = scene.probe.sensor, scene.illumination.wavelength
    results: list[torch.Tensor] = []
    x, y = output.x(), output.y()
    for both in sines:
        light = camera(both).double().cpu()
        total = light.sum((1, 2)).clamp_min(torch.finfo(torch.float64).tiny)
        middle = torch.stack([(light.sum(1) @ x) / total, (light.sum(2) @ y) / total], -1)
        light = camera(both, -middle).double().cpu()
        plus, minus = electrons(light, sensor, wavelength)
        results.append(_dprime(plus, minus, readout_variance(sensor)))
    return torch.stack(results)


def _dprime(plus: torch.Tensor, minus: torch.Tensor, noise: float) -> torch.Tensor:
    mean = (plus + minus) / 2
    weight = 1 / (mean + noise).sqrt()
    shifts = torch.stack([(slope * weight).flatten() for slope in torch.gradient(mean)], 1)
    apart = ((plus - minus) * weight).flatten()[:, None]
    return (apart - shifts @ torch.linalg.lstsq(shifts, apart).solution).norm()
