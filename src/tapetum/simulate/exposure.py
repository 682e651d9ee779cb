"""What the probe's sensor makes of the light: shot noise, read noise, saturation and bits."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from tapetum.bench import Probe, ProbeSensor
from tapetum.simulate.image import Image
from tapetum.simulate.radiometry import electrons

__all__ = ["digitise", "expose"]


def expose(image: Image, probe: Probe, seed: int | np.random.Generator) -> npt.NDArray[np.uint8 | np.uint16]:
    """Take frames of a simulated image.

    Parameters
    ----------
    image
        Irradiance on the probe's pixels.
    probe
        Whose sensor takes it.
    seed
        Of the noise; the same seed gives the same frames.

    Returns
    -------
    numpy.ndarray
        Digital numbers, [B, H, W]: uint8 up to 8 bits, uint16 above.
    """
    mean = electrons(image.irradiance.detach(), probe.sensor, float(image.metadata["wavelength"]))
    return digitise(mean, probe.sensor, np.random.default_rng(seed))


def digitise(mean: torch.Tensor, sensor: ProbeSensor, rng: np.random.Generator) -> npt.NDArray[np.uint8 | np.uint16]:
    """Draw digital numbers for mean electrons of any shape: Poisson light, Gaussian read noise, clipping, rounding."""
    generator = torch.Generator().manual_seed(int(rng.integers(1 << 62)))
    light = mean.detach().to("cpu", torch.float32)
    counts = torch.poisson(light, generator=generator)
    if sensor.read_noise:
        counts += sensor.read_noise * torch.randn(counts.shape, generator=generator)
    top = 2**sensor.bits - 1
    numbers = counts.clamp_(max=sensor.full_well).mul_(top / sensor.full_well).add_(sensor.offset)
    return numbers.round_().clamp_(0, top).numpy().astype(np.uint8 if sensor.bits <= 8 else np.uint16)
