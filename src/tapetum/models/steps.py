"""One step of a training; on one GPU recorded once as a CUDA graph and replayed.

A step of a small network starts some hundred kernels that each take microseconds: started one by one from Python, the
GPU waits for them most of the time.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from tapetum.models.augmentation import Augmentation, augment

if TYPE_CHECKING:
    from lightning_fabric import Fabric

__all__ = ["RecordedStep", "Step", "set_rate"]

# Steps of a batch size that run as they are before the next one is recorded: libraries choose algorithms and allocate
# memory in the first ones, which a recording may not.
_BEFORE = 3


@dataclass
class Step:
    """A step of the optimiser on some of the images, which adds the sum of their losses to `total`."""

    fabric: Fabric
    module: Callable[[Tensor], Tensor]
    optimiser: Any
    loss: Callable[[Tensor, Tensor], Tensor]
    images: Tensor
    targets: Tensor
    augmentation: Augmentation
    varied: torch.Generator
    total: Tensor

    def __call__(self, chosen: Tensor, share: float) -> None:
        """Train on the `chosen` images [n]; `share` weighs their mean loss in the gradients."""
        device = self.fabric.device
        images = augment(self.images[chosen].to(device), self.augmentation, self.varied)
        target = self.targets[chosen].to(device)
        self.optimiser.zero_grad(set_to_none=True)
        loss = self.loss(self.module(images.contiguous(memory_format=torch.channels_last)), target)
        self.fabric.backward(loss * share)
        self.optimiser.step()
        self.total += loss.detach() * len(chosen)

    def stream(self) -> contextlib.AbstractContextManager[Any]:
        """Where the steps of an epoch must run."""
        return contextlib.nullcontext()


@dataclass
class RecordedStep(Step):
    """The same on one GPU: after a few steps of a batch size, the next is recorded and from then on replayed.

    Images and targets must be on the GPU. A replayed step reads the learning rate from the optimiser's tensor, random
    numbers from `varied`, and changes weights, moments and `total` in place; only the choice of images is copied.
    """

    _own: torch.cuda.Stream = field(init=False)
    _steps: dict[int, int] = field(init=False, default_factory=dict)
    _graphs: dict[int, tuple[torch.cuda.CUDAGraph, Tensor]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self._own = torch.cuda.Stream(self.fabric.device)

    def stream(self) -> contextlib.AbstractContextManager[Any]:
        # What is recorded may not wait for work that runs elsewhere, so the steps before it run here too.
        self._own.wait_stream(torch.cuda.current_stream(self.fabric.device))
        return torch.cuda.stream(self._own)

    def __call__(self, chosen: Tensor, share: float) -> None:
        count = len(chosen)
        done = self._steps[count] = self._steps.get(count, 0) + 1
        if done <= _BEFORE:
            super().__call__(chosen, share)
            return
        if count not in self._graphs:
            self._graphs[count] = self._recorded(chosen, share)
        graph, places = self._graphs[count]
        places.copy_(chosen)
        graph.replay()

    def _recorded(self, chosen: Tensor, share: float) -> tuple[torch.cuda.CUDAGraph, Tensor]:
        """The step's graph and the places that it reads; recording changes nothing."""
        places, graph = chosen.clone(), torch.cuda.CUDAGraph()
        graph.register_generator_state(self.varied)
        with torch.cuda.graph(graph, stream=self._own):
            super().__call__(places, share)
        return graph, places


def set_rate(optimiser: Any, rate: float) -> None:
    """Set the learning rate of all parameters; a tensor is filled, as recorded steps read it."""
    for group in optimiser.param_groups:
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate
