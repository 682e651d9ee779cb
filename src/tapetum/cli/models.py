"""Which model a person means by a name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tapetum.errors import InputError

if TYPE_CHECKING:
    from tapetum.models import Predictor

__all__ = ["find_model"]


def find_model(name: str, device: str = "auto") -> Predictor:
    """Load a model by its folder, by its exported file NAME.onnx or by the name of a bundled one.

    A network computes on `device`. Raises an InputError for an unknown model or one that runs on the CPU only.
    """
    from tapetum.models import NetworkEstimator, load_predictor, pretrained

    if Path(name).exists() or Path(name).suffix.lower() == ".onnx" or Path(name).name != name:
        model = load_predictor(name)
    else:
        try:
            model = pretrained(name)
        except InputError as error:
            what = "is neither a model's folder or .onnx file nor the name of a bundled model"
            raise InputError(what, where=name, remedy=error.remedy) from error
    if isinstance(model, NetworkEstimator):
        model.device = device
    elif device not in ("auto", "cpu"):
        raise InputError(f"{name} computes on the processor alone", where="--device", remedy="leave it out")
    return model
