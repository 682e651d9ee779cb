"""Checks of the tensors from which an estimator's parts are rebuilt."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from tapetum.errors import InputError

__all__ = ["MISMATCH", "checked_state"]

MISMATCH = "the model's card and its weights do not belong together"
"""The remedy where weights do not fit what the card says."""


def checked_state(
    state: Mapping[str, torch.Tensor], shapes: Mapping[str, tuple[int, ...]], prefix: str = ""
) -> dict[str, NDArray[np.float64]]:
    """Return the tensors named `prefix` + name as float64 arrays; raise an InputError for missing or unusable ones."""
    arrays: dict[str, NDArray[np.float64]] = {}
    for name, shape in shapes.items():
        tensor = state.get(prefix + name)
        if tensor is None or tuple(tensor.shape) != shape:
            found = "missing" if tensor is None else f"{tuple(tensor.shape)}"
            what = f"expected {prefix}{name} of shape {shape}, found {found}"
            raise InputError(what, where="weights", remedy=MISMATCH)
        arrays[name] = tensor.detach().cpu().double().numpy()
        if not np.isfinite(arrays[name]).all():
            raise InputError(f"{prefix}{name} is not finite", where="weights", remedy="train the model again")
    return arrays
