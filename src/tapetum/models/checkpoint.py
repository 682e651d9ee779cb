"""Checkpoints: everything that the next epoch of a training needs, written completely or not at all."""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.models.epochs import EpochReport

__all__ = ["CHECKPOINT", "HISTORY", "KeptEpoch", "TrainingState", "read_checkpoint", "remove_checkpoint"]

CHECKPOINT, HISTORY = "checkpoint.safetensors", "history.json"
_FORMAT = "tapetum-checkpoint/2"
_MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass
class TrainingState:
    """What changes from epoch to epoch; `best` is the network's state on the CPU after its best epoch, or None."""

    network: nn.Module
    optimiser: torch.optim.Optimizer
    best: dict[str, Tensor] | None
    history: list[EpochReport]


class KeptEpoch:
    """Keeps the last whole epoch of a training: on disk, or in memory until its turn comes.

    A checkpoint of ResNet-18 takes a quarter of a second, which is half of an epoch on a GPU: after the first one,
    epochs are written at most every `seconds`. As a context it writes the last epoch when an exception ends it, Ctrl-C
    too; a process that is killed loses the epochs of some seconds.
    """

    def __init__(self, folder: Path, state: TrainingState, about: Mapping[str, Any], seconds: float = 10.0) -> None:
        self._folder, self._state, self._about, self._seconds = folder, state, dict(about), seconds
        self._written = -math.inf
        self._waiting: tuple[dict[str, Tensor], dict[str, str]] | None = None

    def keep(self, *, last: bool = False) -> None:
        """Keep the epoch that has just ended; the `last` one is written at once."""
        kept = _tensors(self._state), _metadata(self._state, self._about)
        if last or time.monotonic() - self._written >= self._seconds:
            _write(self._folder, *kept)
            self._written, self._waiting = time.monotonic(), None
        else:
            self._waiting = {name: tensor.clone() for name, tensor in kept[0].items()}, kept[1]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._waiting is not None:
            _write(self._folder, *self._waiting)
            self._waiting = None


def _tensors(state: TrainingState) -> dict[str, Tensor]:
    """Return what a checkpoint holds by its name, where it lies."""
    tensors = {f"network.{name}": value for name, value in state.network.state_dict().items()}
    tensors |= {f"best.{name}": value for name, value in (state.best or {}).items()}
    for name, parameter in state.network.named_parameters():
        for key, value in state.optimiser.state[parameter].items():
            tensors[f"optimiser.{key}.{name}"] = torch.as_tensor(value)
    return {name: tensor.detach() for name, tensor in tensors.items()}


def _metadata(state: TrainingState, about: Mapping[str, Any]) -> dict[str, str]:
    epochs = [asdict(report) for report in state.history]
    return {"format": _FORMAT, "about": json.dumps(about), "history": json.dumps(epochs)}


def _write(folder: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str]) -> None:
    """Write checkpoint.safetensors and a readable history.json into a folder, which is created if missing."""
    there = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
    with atomic_file(folder / CHECKPOINT) as part:
        save_file(there, part, metadata=metadata)
    told = {**json.loads(metadata["about"]), "epochs": json.loads(metadata["history"])}
    with atomic_file(folder / HISTORY) as part:
        part.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")


def read_checkpoint(folder: Path, state: TrainingState, about: Mapping[str, Any]) -> None:
    """Load a checkpoint into `state`, its network and optimiser in place.

    Raises an InputError when the file is damaged, of another version or of another training; with a network that does
    not fit, the state is then unusable.
    """
    path, remedy = folder / CHECKPOINT, "remove the folder and train from the start"
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, OSError) as error:
        raise InputError(f"damaged checkpoint ({error})", where=path, remedy=remedy) from error
    if (version := metadata.get("format")) != _FORMAT:
        what = f"is a checkpoint of another version ({version!r}; this version reads {_FORMAT!r})"
        raise InputError(what, where=path, remedy=remedy)
    try:
        if json.loads(metadata["about"]) != about:
            what = "was left by a training with other settings or other data"
            raise InputError(what, where=path, remedy="remove the folder, or train as its history.json says")
        history = [EpochReport(**report) for report in json.loads(metadata["history"])]
        state.network.load_state_dict(_under("network.", tensors))
        for name, parameter in state.network.named_parameters():
            moments = state.optimiser.state[parameter]
            moments["step"] = tensors[f"optimiser.step.{name}"].to(parameter.device)
            for key in _MOMENTS:
                # In the weights' memory order (channels last): the fused step indexes all tensors by memory position.
                stored = tensors[f"optimiser.{key}.{name}"]
                moments[key] = torch.empty_like(parameter, requires_grad=False).copy_(stored)
    except InputError:
        raise
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"checkpoint does not fit the network ({error})", where=path, remedy=remedy) from error
    state.best, state.history = _under("best.", tensors) or None, history


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def remove_checkpoint(folder: Path) -> None:
    """Remove a checkpoint, and its folder if nothing else is in it."""
    for name in (CHECKPOINT, HISTORY):
        (folder / name).unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        folder.rmdir()
