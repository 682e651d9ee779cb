"""Can one frame tell where a camera looks from where it does not? Two-hypothesis tests on mean electrons."""

from __future__ import annotations

import torch

from tapetum.bench import Scene
from tapetum.simulate.camera import Camera
from tapetum.simulate.exposure import gain_of
from tapetum.simulate.gaze import largest_sine, tilt_of_gaze
from tapetum.simulate.radiometry import electrons

__all__ = ["sign_dprime"]


def sign_dprime(scene: Scene, gaze: torch.Tensor, *, accuracy: float = 1e-3) -> torch.Tensor:
    """d' of telling a gaze from its opposite in one frame, by the best detector, the RR's place being unknown.

    Parameters
    ----------
    scene
        Its probe's noise decides; its own rotation is not used.
    gaze
        [N, 2], in fractions of the field.
    accuracy
        Of the simulation, in fractions of the peak: differences below it are not resolved.

    Returns
    -------
    torch.Tensor
        [N], float64. With equal odds the sign is right with probability Φ(d'/2): 1 means 69 %, 3 means 93 %.

    Notes
    -----
    d'² = Σ (μ₊ - μ₋)²/(μ̄ + σ²) over the pixels, for Poisson light of means μ and read and rounding noise σ. Where the
    camera stands is unknown, so the part of the difference that a shift of the picture explains is projected out, after
    both pictures have been laid on each other by their centres of light.
    """
    sines = tilt_of_gaze(scene, gaze.to(torch.float64))
    steepest = largest_sine(sines)
    rough = Camera(scene, steepest, accuracy=accuracy)
    # Room for the second beam's RR beside the first one's.
    output = rough.window(margin=True)
    camera = Camera(scene, steepest, accuracy=accuracy, output=output)
    sensor, wavelength = scene.probe.sensor, scene.illumination.wavelength
    # A digital number's rounding adds a uniform error of one step.
    step = 1 / gain_of(sensor)
    noise = sensor.read_noise**2 + step**2 / 12
    results: list[torch.Tensor] = []
    x, y = output.x(), output.y()
    for one in sines:
        both = torch.stack([one, -one])
        light = camera(both).double()
        total = light.sum((1, 2)).clamp_min(torch.finfo(torch.float64).tiny)
        middle = torch.stack([(light.sum(1) @ x) / total, (light.sum(2) @ y) / total], -1)
        light = camera(both, -middle).double()
        plus, minus = electrons(light, sensor, wavelength)
        results.append(_dprime(plus, minus, noise))
    return torch.stack(results)


def _dprime(plus: torch.Tensor, minus: torch.Tensor, noise: float) -> torch.Tensor:
    mean = (plus + minus) / 2
    weight = 1 / (mean + noise).sqrt()
    dy, dx = torch.gradient(mean)
    rest = ((plus - minus) * weight).flatten()
    across, down = (dx * weight).flatten(), (dy * weight).flatten()
    down = _without(down, across)
    return _without(_without(rest, across), down).square().sum().sqrt()


def _without(values: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """What is left of `values` once its part along `direction` is taken out."""
    length = direction.square().sum()
    return values - direction * ((values * direction).sum() / length) if float(length) > 0 else values
