"""Random variations of the training images that do not change the gaze: brightness, centring, noise."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from tapetum.errors import InputError

__all__ = ["Augmentation", "augment"]


@dataclass(frozen=True)
class Augmentation:
    """Random variations of training images that leave the gaze unchanged.

    Flips and rotations are excluded: they turn the gaze, while the second beam, which shows its sign, does not follow.

    Parameters
    ----------
    gain
        The image is multiplied by exp(u), u uniform in -gain ... gain. An image is the root of the intensity above its
        background, so the intensity changes by exp(2 u).
    shift
        Largest sub-pixel shift along each axis in pixels of the network's input, as large as the centring error.
    noise
        Standard deviation of white noise, in units of the training images' standard deviation. White noise is right
        here because the root makes shot noise independent of the count (Anscombe, Biometrika 35, 246 (1948)).
    """

    gain: float = 0.1
    shift: float = 1.5
    noise: float = 0.03

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (math.isfinite(value) and value >= 0):
                what = f"must not be negative, is {value}"
                raise InputError(what, where=f"augmentation.{name}", remedy="0 turns it off")

    @classmethod
    def none(cls) -> Self:
        """Return settings that leave images unchanged."""
        return cls(0, 0, 0)


def augment(images: Tensor, settings: Augmentation, generator: torch.Generator) -> Tensor:
    """Return images [N, 1, H, W] with random gain, sub-pixel shift and noise.

    Random numbers are drawn on the generator's device; a generator on the images' device avoids copies.
    """
    n, _, height, width = images.shape

    def uniform(*shape: int) -> Tensor:
        return (2 * torch.rand(*shape, generator=generator, dtype=torch.float32, device=generator.device) - 1).to(
            images
        )

    if settings.shift > 0:
        across, down = (settings.shift * uniform(n, 2)).unbind(1)
        # affine_grid counts in half images: 2/width is a pixel.
        offset = torch.stack([across * (2 / width), down * (2 / height)], 1)
        eye = torch.eye(2, dtype=images.dtype, device=images.device).expand(n, 2, 2)
        grid = F.affine_grid(torch.cat([eye, offset[:, :, None]], dim=2), list(images.shape), align_corners=False)
        images = F.grid_sample(images, grid, mode="bilinear", padding_mode="border", align_corners=False)
    if settings.gain > 0:
        images = images * torch.exp(settings.gain * uniform(n, 1, 1, 1))
    if settings.noise > 0:
        noise = torch.randn(images.shape, generator=generator, dtype=torch.float32, device=generator.device)
        images = torch.add(images, noise.to(images), alpha=settings.noise)
    return images
