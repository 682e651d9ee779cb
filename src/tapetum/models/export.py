"""Export of a network as one ONNX file, from counts to values, probabilities and novelty."""

from __future__ import annotations

import copy
import io
import json
import math
import warnings
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy.linalg import solve_triangular
from torch import Tensor, nn

from tapetum.data.dataset import QUANTITIES
from tapetum.errors import InputError, need
from tapetum.files import atomic_file
from tapetum.models.architectures import ARCHITECTURES
from tapetum.models.base import Predictor
from tapetum.models.domain import described
from tapetum.models.inputs import area_average, root_over_background
from tapetum.models.intervals import Intervals
from tapetum.models.kernel import LEAST, small_area, small_pictures
from tapetum.models.network import NetworkEstimator

__all__ = ["EXTRA", "FORMAT", "VERSION", "export_onnx", "onnx_bytes", "onnx_card"]

FORMAT, VERSION = "tapetum-onnx", 1
EXTRA = "fast"
"""Tapetum's extra with the packages that write and run ONNX files."""

_SUFFIX = ".onnx"
# Every ONNX Runtime since 1.15 (2023) reads it.
_OPSET = 18

_PREPARATION = (
    "counts: float32 [N, {crop}, {crop}], the central {crop} x {crop} pixels of crops centred on the retro-reflection,"
    " grey levels as the camera counts them, finite and not negative; full_scale: float32 scalar, the camera's largest"
    " count (255 for 8 bits). Averaging over areas to {size} x {size}, square root, background and scaling are inside."
    " Intervals of 90 %: value - half_width ... value + half_width, from the row of half_width whose SNR (edges between"
    " the rows: snr_edges) is the crop's; half_width is multiplied by the output deviation, where there is one. These"
    " hold for the copy of the camera trained on; other_unit has those for another copy, by distance (distance_edges)."
    " novelty above 1: none of the classes. distance above 1: the crop is unlike the training frames, and the answer"
    " means nothing."
)


def onnx_card(model: NetworkEstimator) -> dict[str, Any]:
    """Return an exported model's card, which the file holds as JSON in its metadata under "tapetum".

    `half_width` [B, K] (None where unknown) and `snr_edges` [B - 1] are those of `tapetum.models.intervals.Intervals`.
    """
    other = model.others_
    beside = (
        {} if other is None else {"other_unit": {"half_width": _widths(other), "distance_edges": other.edges.tolist()}}
    )
    return {
        "format": FORMAT,
        "version": VERSION,
        "kind": model.kind,
        "targets": list(model.target_names),
        "quantities": list(model.quantities),
        "units": {name: QUANTITIES.get(name, "1") for name in model.quantities},
        "classes": list(model.classes()),
        "crop": model.crop,
        "size": model.size,
        "half_width": _widths(model.intervals_),
        "snr_edges": [float(edge) for edge in model.intervals_.edges],
        **beside,
        "films": sorted(model.marks),
        "training_data": model.data_hash_,
        "versions": {"tapetum": metadata.version("tapetum"), "torch": metadata.version("torch")},
        "use": _PREPARATION.format(crop=model.crop, size=model.size),
    }


def _widths(intervals: Intervals) -> list[list[float | None]]:
    return [[float(w) if math.isfinite(w) else None for w in row] for row in intervals.half_width]


def export_onnx(model: Predictor, path: str | Path) -> Path:
    """Write a fitted network to NAME.onnx, see `onnx_bytes`; an existing file is replaced.

    Raises
    ------
    InputError
        As `onnx_bytes`, and when the name ends otherwise.
    MissingExtraError
        When the extra `fast` is not installed.
    """
    if Path(path).suffix.lower() != _SUFFIX:
        raise InputError(f"unknown kind of export {Path(path).suffix!r}", where=path, remedy=f"name it NAME{_SUFFIX}")
    content = onnx_bytes(model)
    with atomic_file(path) as part:
        part.write_bytes(content)
    return Path(path)


def onnx_bytes(model: Predictor) -> bytes:
    """Return a fitted network as an ONNX model, preparation and scaling included.

    Inputs: `counts` [N, crop, crop] and `full_scale` [], float32. Outputs: `value` [N, K] in SI units where there are
    quantities; `deviation` [N] of `tapetum.models.kernel.ResidualKernel` where the model has one, by which its own
    intervals are multiplied; `probability` [N, C] and `novelty` [N] where there are classes; `distance` [N] of
    `tapetum.models.domain.Domain` where the model has one. Standard deviations and temperature are multiplied into the
    last layer in float64; torch folds batch normalisations into the convolutions.

    Raises
    ------
    InputError
        When the model is of another kind or not fitted.
    MissingExtraError
        When the extra `fast` is not installed.
    """
    if not isinstance(model, NetworkEstimator):
        kind = getattr(model, "kind", type(model).__name__)
        if kind in ARCHITECTURES:
            raise InputError("is exported already", where="model", remedy="give the model's folder")
        raise InputError(f"only networks become ONNX, this one is {kind}", where="model", remedy="train one")
    onnx = need("onnx", EXTRA)
    state = model.state()  # raises when the model is not fitted
    card, content = onnx_card(model), io.BytesIO()
    deployed = _Deployed(model, state).float().eval()
    example = (torch.ones(2, model.crop, model.crop), torch.ones(()))
    with torch.no_grad(), warnings.catch_warnings():
        # torch warns that the tracing exporter is old; the new one needs another package (onnxscript).
        warnings.simplefilter("ignore")
        names = list(deployed(*example))
        torch.onnx.export(
            deployed,
            example,
            content,  # type: ignore[arg-type]  # it takes a stream as well
            dynamo=False,
            opset_version=_OPSET,
            input_names=["counts", "full_scale"],
            output_names=names,
            dynamic_axes={name: {0: "N"} for name in ("counts", *names)},
        )
    made = onnx.load_from_string(content.getvalue())
    made.producer_name, made.producer_version = "tapetum", card["versions"]["tapetum"]
    made.graph.name, made.graph.doc_string = "tapetum", card["use"]
    onnx.helper.set_model_props(made, {"tapetum": json.dumps(card, allow_nan=False)})
    onnx.checker.check_model(made, full_check=True)
    return made.SerializeToString()


class _Deployed(nn.Module):
    """All steps of `NetworkEstimator.predict` in torch alone; constant factors are multiplied in float64."""

    def __init__(self, model: NetworkEstimator, state: dict[str, Tensor]) -> None:
        super().__init__()
        self.crop, self.size, self.hide, self.background = model.crop, model.size, model.hide, model.background
        self.network, k = copy.deepcopy(model.network_).cpu(), len(model.quantities)
        weight, bias = (one.detach().double() for one in self.network.head.parameters())
        spread = state["scaling.spread"]
        constants = {"unit": state["scaling.unit"], "area": area_average(model.crop, model.size)}
        if k:
            constants["value"] = (weight[:k] * spread[:, None]).T
            constants["value_offset"] = bias[:k] * spread + state["scaling.centre"]
        if model.classes():
            constants["score"] = weight[k:].T / model.temperature_
            constants["score_offset"] = bias[k:] / model.temperature_
        for name, one in (("novelty", model.novelty_), ("domain", model.domain_)):
            if one is not None:
                constants[f"{name}_white"] = torch.from_numpy(one.whitening / one.unit)
        if model.novelty_ is not None:
            constants["means"] = torch.from_numpy(model.novelty_.means / model.novelty_.unit)
        if model.domain_ is not None:
            constants["mean"] = torch.from_numpy(model.domain_.mean)
            constants["references"] = torch.from_numpy(model.domain_.references / model.domain_.unit)
            constants["reference_squares"] = constants["references"].square().sum(dim=1)
        if model.kernel_ is not None:
            constants["kernel_area"] = small_area(model.size)
            constants["kernel_units"] = torch.from_numpy(1 / model.kernel_.units)
            # About their mean, squares are small and their differences accurate in float32.
            references = torch.from_numpy(model.kernel_.references)
            constants["kernel_mean"] = references.mean(dim=0)
            constants["kernel_references"] = references - constants["kernel_mean"]
            constants["kernel_squares"] = constants["kernel_references"].square().sum(dim=1)
            constants["kernel_value"] = torch.from_numpy(model.kernel_.coefficients) * spread
            factor = model.kernel_.factor
            constants["kernel_white"] = torch.from_numpy(solve_triangular(factor, np.eye(len(factor)), lower=True)).T
            constants["kernel_unit"] = torch.tensor(model.kernel_.unit)
        for name, values in constants.items():
            self.register_buffer(name, values)

    def forward(self, counts: Tensor, full_scale: Tensor) -> dict[str, Tensor]:
        """Map counts [N, crop, crop] and their full scale [] to the outputs by name."""
        known = dict(self.named_buffers(recurse=False))
        if self.crop % self.size == 0:
            small = F.avg_pool2d(counts[:, None], self.crop // self.size) / full_scale
        else:
            small = known["area"] @ counts[:, None] @ known["area"].T / full_scale
        # torch's lower median: the largest of the smaller half.
        half = small.flatten(1).topk((self.size**2 - 1) // 2 + 1, largest=False, sorted=False).values
        middle = half.amax(dim=1)[:, None, None, None]
        seen = root_over_background(small, middle, self.crop, self.hide, self.background) / known["unit"]
        features = self.network.features(seen)
        found: dict[str, Tensor] = {}
        if "value" in known:
            found["value"] = features @ known["value"] + known["value_offset"]
        if "kernel_value" in known:
            units = known["kernel_units"]
            own = torch.cat([features * units[0], small_pictures(seen, known["kernel_area"]) * units[1]], dim=1)
            own = own - known["kernel_mean"]
            squares = own.square().sum(dim=1, keepdim=True) + known["kernel_squares"]
            alike = torch.exp((own @ known["kernel_references"].T - 0.5 * squares).clamp(max=0))
            found["value"] = found["value"] + alike @ known["kernel_value"]
            left = 1 - (alike @ known["kernel_white"]).square().sum(dim=1)
            found["deviation"] = left.clamp(min=LEAST).sqrt() / known["kernel_unit"]
        if "score" in known:
            found["probability"] = (features @ known["score"] + known["score_offset"]).softmax(dim=1)
        if "means" in known:
            # Explicit differences are accurate in float32.
            apart = (features @ known["novelty_white"])[:, None] - known["means"]
            found["novelty"] = apart.norm(dim=2).amin(dim=1)
        if "mean" in known:
            white = (described(seen, torch.float32) - known["mean"]) @ known["domain_white"]
            squares = white.square().sum(dim=1, keepdim=True) + known["reference_squares"]
            found["distance"] = (squares - 2 * white @ known["references"].T).amin(dim=1).clamp(min=0).sqrt()
        return found
