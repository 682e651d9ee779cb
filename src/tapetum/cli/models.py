"""Finding the model that a name on the command line means."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from tapetum.errors import InputError, one_of

if TYPE_CHECKING:
    from tapetum.models import Predictor

__all__ = ["find_model", "warn_of_intervals"]


def find_model(name: str, device: str = "auto", unit: str | None = None) -> Predictor:
    """Load a model by its folder, its exported file NAME.onnx, a scene NAME.yaml, or the name of a bundled one.

    A network computes on `device`, and has the intervals of `unit` (`tapetum.models.base.UNIT_CHOICES`). Raises an
    InputError for an unknown model, one that runs on the CPU only, and one without intervals for another copy.
    """
    from tapetum.models import NetworkEstimator, load_predictor, pretrained
    from tapetum.models.simulation import SCENE_SUFFIXES

    if Path(name).exists() or Path(name).suffix.lower() in (".onnx", *SCENE_SUFFIXES) or Path(name).name != name:
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
    if unit is not None:
        from tapetum.models.base import UNIT_CHOICES

        model.whose = one_of(unit, UNIT_CHOICES, "--unit")
        if unit == "other" and model.others_ is None:
            remedy = "calibrate them: tapetum calibrate units"
            raise InputError(f"{name} has no intervals for another copy of its camera", where="--unit", remedy=remedy)
    return model


def warn_of_intervals(names: Sequence[object], unsure: Sequence[str]) -> None:
    """Say of which models the intervals may be too narrow (`Predictor.unsure`), and what to do."""
    for name, why in zip(names, unsure, strict=True):
        if why:
            remedy = "`--unit own` says that it shows that camera, `tapetum calibrate units` makes intervals for others"
            typer.echo(f"note: {name}: {why}: {remedy}", err=True)
