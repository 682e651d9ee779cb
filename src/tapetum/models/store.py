"""Models on disk: a folder with a card, model.json, and weights.safetensors; no pickles."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Mapping
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from tapetum.checked import read_json
from tapetum.data.dataset import QUANTITIES
from tapetum.errors import InputError
from tapetum.files import atomic_file, atomic_folder, sha256_file
from tapetum.models.architectures import ARCHITECTURES
from tapetum.models.base import Estimator, json_safe
from tapetum.models.card import check_version, checked_card
from tapetum.models.network import NetworkEstimator, ResNet18
from tapetum.models.zernike_ridge import ZernikeRidge

__all__ = [
    "CARD",
    "FORMAT",
    "KINDS",
    "VERSION",
    "WEIGHTS",
    "load_model",
    "model_card",
    "pretrained",
    "save_model",
    "write_metrics",
]

FORMAT, VERSION = "tapetum-model", 2
CARD, WEIGHTS = "model.json", "weights.safetensors"
# Function that rebuilds a model of each kind.
KINDS: dict[str, Callable[..., ZernikeRidge | NetworkEstimator]] = {
    ZernikeRidge.kind: ZernikeRidge.from_state,
    **{name: partial(NetworkEstimator.from_state, architecture=name) for name in ARCHITECTURES},
    ResNet18.kind: ResNet18.from_state,
}

# Packages whose versions the card lists.
_PACKAGES = ("tapetum", "torch", "numpy", "scikit-learn", "safetensors")
_REMEDY = "copy it again or train it again"
_INCOMPLETE = "copy the whole folder or train it again"
_PRETRAINED = Path(__file__).parent / "pretrained"


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


def _halved(tensor: torch.Tensor, name: str) -> torch.Tensor:
    # Only large float32 tensors: biases and normalisation statistics are small, and linear models keep float64.
    if tensor.dtype != torch.float32 or tensor.ndim < 2:
        return tensor
    half = tensor.half()
    if not torch.isfinite(half).all():
        raise InputError("weights do not fit half precision", where=name, remedy="save with half=False")
    return half


def save_model(
    model: Estimator,
    path: str | Path,
    *,
    metrics: Mapping[str, Any] | None = None,
    data_hash: str | None = None,
    half: bool = False,
    notes: Mapping[str, Any] | str | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a fitted model to a folder.

    Parameters
    ----------
    model
        A fitted estimator.
    path
        The folder to write.
    metrics, notes
        For the card: what was measured on what; and anything else, such as seeds or the command.
    data_hash
        Hash of the training data; by default the model's own.
    half
        Store matrices and convolutions in float16, half the size. Predictions still run in float32.
    overwrite
        Replace a folder that holds a model.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        When the model is not fitted, metrics or notes are not JSON, or the folder exists and may not be replaced.
    """
    if model.kind not in KINDS:
        what = f"a model of kind {model.kind!r} learns nothing that a folder could keep"
        raise InputError(what, where=path, remedy="make it again from its parameters")
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state().items()}
    if half:
        state = {name: _halved(tensor, name) for name, tensor in state.items()}
    card = {
        "format": FORMAT,
        "version": VERSION,
        "kind": model.kind,
        "targets": list(model.target_names),
        "units": {name: QUANTITIES.get(name, "1") for name in model.quantities},
        "classes": list(model.classes()),
        "parameters": model.parameters(),
        "training_data": model.data_hash_ if data_hash is None else data_hash,
        "training": model.training_,
        "metrics": dict(metrics or {}),
        "notes": notes if notes is None or isinstance(notes, str) else dict(notes),
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES},
    }
    card = json_safe(card, "metrics or notes")
    with atomic_folder(path, FORMAT, overwrite=overwrite) as folder:
        save_file(state, folder / WEIGHTS)
        # Safetensors restricts its file to the owner; everyone who can read the folder may read the model.
        (folder / WEIGHTS).chmod(0o644)
        card["weights"] = {
            "file": WEIGHTS,
            "sha256": sha256_file(folder / WEIGHTS),
            "bytes": (folder / WEIGHTS).stat().st_size,
            "precision": "half" if half else "full",
        }
        (folder / CARD).write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    return Path(path)


def write_metrics(path: str | Path, metrics: Mapping[str, Any]) -> None:
    """Replace `metrics` on a saved model's card; raise an InputError for a bad card or values that are not JSON."""
    card = model_card(path) | {"metrics": json_safe(dict(metrics), "metrics")}
    with atomic_file(Path(path) / CARD) as part:
        part.write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")


def model_card(path: str | Path) -> dict[str, Any]:
    """Read and check the card of a model.

    Raises
    ------
    InputError
        When the folder or its card is missing, is not a model's, or is of a newer version.
    """
    folder = Path(path)
    if not folder.is_dir():
        what = "is a file, and a model is a folder" if folder.exists() else "there is no such model folder"
        raise InputError(what, where=folder, remedy="train one with `tapetum train`")
    try:
        card = read_json(folder / CARD)
    except FileNotFoundError as error:
        raise InputError(f"the model lacks {CARD}", where=folder, remedy=_INCOMPLETE) from error
    except (ValueError, OSError) as error:
        raise InputError(f"cannot be read ({error})", where=folder / CARD, remedy=_REMEDY) from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        what = f"is not the card of a model (format {FORMAT})"
        raise InputError(what, where=folder / CARD, remedy="give a model's folder")
    check_version(card.get("version"), VERSION, folder / CARD)
    if not isinstance(card.get("kind"), str) or card["kind"] not in KINDS:
        what = f"holds a model of unknown kind {card.get('kind')!r}"
        raise InputError(what, where=folder / CARD, remedy=f"this Tapetum knows {', '.join(KINDS)}")
    return checked_card(card, folder / CARD)


def load_model(path: str | Path) -> ZernikeRidge | NetworkEstimator:
    """Load a model that `save_model` wrote, after checking its weights against the hash on its card.

    It predicts in float32 (linear models in float64), whatever the stored precision.

    Raises
    ------
    InputError
        When a file is missing, altered, foreign or newer.
    """
    card, folder = model_card(path), Path(path)
    weights = folder / WEIGHTS
    if not weights.is_file():
        raise InputError(f"the model lacks {WEIGHTS}", where=folder, remedy=_INCOMPLETE)
    if sha256_file(weights) != card["weights"].get("sha256"):
        what = "has been altered: its SHA-256 is not the one on the card"
        raise InputError(what, where=weights, remedy=_REMEDY)
    try:
        state = load_file(weights)
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"cannot be read ({error})", where=weights, remedy=_REMEDY) from error
    state = {name: tensor.float() if tensor.dtype == torch.float16 else tensor for name, tensor in state.items()}
    try:
        model = KINDS[card["kind"]](card["parameters"], state, tuple(card.get("classes", ())))
    except InputError as error:
        raise InputError(str(error), where=folder) from error
    except (TypeError, ValueError) as error:  # an unknown argument, or one of another type
        raise InputError(f"parameters do not fit ({error})", where=folder / CARD, remedy=_REMEDY) from error
    if list(model.target_names) != card["targets"] or set(card["units"]) != set(model.quantities):
        what = "targets and units are not those of parameters.target"
        raise InputError(what, where=folder / CARD, remedy=_REMEDY)
    model.data_hash_, model.training_ = card["training_data"], card.get("training")
    return model


def pretrained(name: str = "thin-lens-gaze") -> ZernikeRidge | NetworkEstimator:
    """Load a bundled model.

    Raises
    ------
    InputError
        When no bundled model has that name; the message lists those that are.
    """
    found = sorted(f.parent.name for f in _PRETRAINED.glob(f"*/{CARD}"))
    if name not in found:
        remedy = f"bundled: {', '.join(found)}" if found else "this build bundles none: make one with `make models`"
        raise InputError(f"no bundled model is called {name!r}", where="pretrained", remedy=remedy)
    return load_model(_PRETRAINED / name)
