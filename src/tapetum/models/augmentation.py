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
    """What is varied at random about an image while training, and nothing that the gaze would change.

    Never flips or rotations: they turn the gaze with them, and what tells its sign (the second beam) does not
    follow.

    Parameters
    ----------
    gain
        The image is multiplied by exp(u), u uniform in -gain ... gain. An image here is the root of the
        intensity less the root of its background; more light or a longer exposure scales both roots alike, by
        exp(u), and so the intensity by exp(2 u).
    shift
        Largest shift in pixels of the network's input, each axis, between pixels as well; the centre is known no
        better.
    noise
        Standard deviation of white noise, in units of the training images' standard deviation. The root makes
        white noise the right kind: counts of a mean n spread by sqrt(n), their root by 1/2 whatever n is
        (Anscombe, Biometrika 35, 246 (1948)), bright pixels and dark ones alike.
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
        """Leave the images as they are."""
        return cls(0, 0, 0)


def augment(images: Tensor, settings: Augmentation, generator: torch.Generator) -> Tensor:
    """Return images [N, 1, H, W] with random gain, sub-pixel shift and noise; see `Augmentation`.

    The numbers are drawn where the generator lives: one of the images' device spares the way there.
    """
    n, _, height, width = images.shape

    def uniform(*shape: int) -> Tensor:
        return (2 * torch.rand(*shape, generator=generator, device=generator.device) - 1).to(images)

    if settings.shift > 0:
        # affine_grid counts in half images: 2/width is a pixel.
        offset = settings.shift * uniform(n, 2) * torch.tensor([2 / width, 2 / height]).to(images)
        eye = torch.eye(2).to(images).expand(n, 2, 2)
        grid = F.affine_grid(torch.cat([eye, offset[:, :, None]], dim=2), list(images.shape), align_corners=False)
        images = F.grid_sample(images, grid, mode="bilinear", padding_mode="border", align_corners=False)
    if settings.gain > 0:
        images = images * torch.exp(settings.gain * uniform(n, 1, 1, 1))
    if settings.noise > 0:
        noise = torch.randn(images.shape, generator=generator, device=generator.device)
        images = torch.add(images, noise.to(images), alpha=settings.noise)
    return images
