"""Training beside copies of the camera: they share all layers but the last.

No retro-reflection shows where a copy's point of symmetry lies, so frames of copies cannot teach the last layer. What
they can teach the layers before it is what differs between copies and what does not: a network that has seen many is
carried over to a further one by fewer frames (`tapetum.models.adapt`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray
from torch import Tensor, nn

from tapetum.data.dataset import UNIT
from tapetum.errors import InputError, of_type
from tapetum.models.architectures import ARCHITECTURES, Network
from tapetum.models.losses import MixedLoss

__all__ = ["OwnLayers", "beside_copies", "copies_of", "targets_beside", "without_copies"]


@dataclass(frozen=True)
class OwnLayers:
    """`MixedLoss` of quantities, of the last layer of each image's camera.

    The last column of the targets is the camera's number: 0 is the one that the network is for, whose last layer gives
    the first `quantities` outputs. The next ones are what each copy's layer adds to it.
    """

    quantities: int
    weighted: bool = False

    def __call__(self, output: Tensor, target: Tensor) -> Tensor:
        """Return the mean loss of outputs [n, (C + 1) K] for targets [n, K + 1], with weights K columns more."""
        number = target[:, -1].long()
        each = output.view(len(output), -1, self.quantities)
        added = each[torch.arange(len(output), device=output.device), number]
        found = each[:, 0] + added * (number > 0)[:, None]
        return MixedLoss(self.quantities, self.weighted)(found, target[:, :-1])


def copies_of(
    dataset: xr.Dataset, quantities: tuple[str, ...]
) -> tuple[xr.Dataset, NDArray[np.float64], NDArray[np.int64]]:
    """Return a dataset's training frames, their labels [N, K] and the number of each frame's copy [N], from 1 on.

    Raises
    ------
    InputError
        Where the dataset does not say which copy a frame shows, or a label is missing or no number.
    """
    of_type(dataset, xr.Dataset, "copies", "open it by tapetum.data.open_dataset")
    train = dataset.tp.train
    if UNIT not in train or not train.sizes["frame"]:
        what = "has no training frames whose copy of the camera is known"
        raise InputError(what, where="copies", remedy="make it by `tapetum dataset synth … --units N`")
    labels = train.tp.values(quantities)
    if not np.isfinite(labels).all():
        raise InputError("has labels that are not numbers", where="copies", remedy="build the set again without them")
    return train, labels, np.unique(np.asarray(train[UNIT].values), return_inverse=True)[1].astype(np.int64) + 1


def targets_beside(own: Tensor, labels: NDArray[np.float64], number: NDArray[np.int64]) -> Tensor:
    """Return the camera's own targets [n, K], with weights [n, 2 K], and below them those of copies, for `OwnLayers`.

    Labels [N, K] of copies count as in `own`, and have the mean weight, 1.
    """
    some = torch.from_numpy(np.concatenate([labels, np.ones((len(labels), own.shape[1] - labels.shape[1]))], axis=1))
    numbers = torch.cat([own.new_zeros(len(own)), torch.from_numpy(number).to(own)])
    return torch.cat([torch.cat([own, some.to(own)]), numbers[:, None]], dim=1)


def beside_copies(architecture: str, quantities: int, copies: int, seed: int) -> Network:
    """Return a new network whose last layer also has what each copy's adds to that of the camera: nothing yet."""
    network = ARCHITECTURES[architecture](quantities * (1 + copies), seed=seed)
    with torch.no_grad():
        network.head.weight[quantities:] = 0
        network.head.bias[quantities:] = 0
    return network


def without_copies(network: Network, quantities: int) -> Network:
    """Return the network with the last layer of its own camera alone."""
    head = network.head
    head.weight = nn.Parameter(head.weight.detach()[:quantities].clone())
    head.bias = nn.Parameter(head.bias.detach()[:quantities].clone())
    head.out_features = quantities
    return network
