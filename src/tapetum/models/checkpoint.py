"""A training on disk: everything that its next epoch needs, whole or not at all."""

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
    """What changes from epoch to epoch.

    Parameters
    ----------
    network
        Its weights and statistics.
    optimiser
        AdamW over the network's parameters.
    best
        The network's state after its best epoch, on the CPU; None where the last one is kept.
    history
        Reports of the epochs so far.
    """

    network: nn.Module
    optimiser: torch.optim.Optimizer
    best: dict[str, Tensor] | None
    history: list[EpochReport]


def write_checkpoint(folder: Path, state: TrainingState, about: Mapping[str, Any]) -> None:
    """Write checkpoint.safetensors, and history.json for people, into a folder that is made where missing.

    `about` is JSON-able: what the training depends on; only a training of the same may continue from here.
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
    """Put a checkpoint's content into `state`: into its network and optimiser in place.

    Raises
    ------
    InputError
        When the file is damaged, of another version or of another training; the state is then as it was or, where
        the network is another, of no use.
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
                # In the order of memory that the weights have (channels last): the fused step goes through all
                # of them by place in memory, and would mix up what belongs to different weights.
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
    """Remove a checkpoint that is no longer needed, and its folder where nothing else is in it."""
    for name in (CHECKPOINT, HISTORY):
        (folder / name).unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        folder.rmdir()
