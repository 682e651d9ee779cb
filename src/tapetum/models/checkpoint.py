"""Checkpoints: everything that the next epoch of a training needs, written completely or not at all."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.models.epochs import EpochReport

__all__ = ["CHECKPOINT", "HISTORY", "TrainingState", "read_checkpoint", "remove_checkpoint", "write_checkpoint"]

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


def write_checkpoint(folder: Path, state: TrainingState, about: Mapping[str, Any]) -> None:
    """Write checkpoint.safetensors and a readable history.json into a folder, which is created if missing.

    `about` (JSON values) identifies the training; only a training with equal `about` may resume.
    """
    tensors = {f"network.{name}": value for name, value in state.network.state_dict().items()}
    tensors |= {f"best.{name}": value for name, value in (state.best or {}).items()}
    for name, parameter in state.network.named_parameters():
        for key, value in state.optimiser.state[parameter].items():
            tensors[f"optimiser.{key}.{name}"] = torch.as_tensor(value)
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    epochs = [asdict(report) for report in state.history]
    metadata = {"format": _FORMAT, "about": json.dumps(about), "history": json.dumps(epochs)}
    with atomic_file(folder / CHECKPOINT) as part:
        save_file(tensors, part, metadata=metadata)
    with atomic_file(folder / HISTORY) as part:
        part.write_text(json.dumps({**about, "epochs": epochs}, indent=2) + "\n", encoding="utf-8")


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
            moments["step"] = tensors[f"optimiser.step.{name}"]
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
