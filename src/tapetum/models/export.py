"""A network as one ONNX file: from counts to values, probabilities and novelty, for any program that reads ONNX."""

from __future__ import annotations

import math
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tapetum.data.dataset import QUANTITIES
from tapetum.errors import InputError, need
from tapetum.files import atomic_file
from tapetum.models.architectures import ARCHITECTURES
from tapetum.models.base import Predictor
from tapetum.models.domain import ORDER, Domain, groups, projection
from tapetum.models.inputs import SOFTENING
from tapetum.models.network import NetworkEstimator
from tapetum.models.novelty import Novelty
from tapetum.models.onnx_graph import Graph, array

__all__ = ["EXTRA", "FORMAT", "VERSION", "export_onnx", "onnx_bytes", "onnx_card"]

FORMAT, VERSION = "tapetum-onnx", 1
EXTRA = "fast"
"""The extra of Tapetum that brings what is needed to write and run ONNX files."""

_SUFFIX = ".onnx"

_PREPARATION = (
    "counts: float32 [N, {crop}, {crop}], the central {crop} x {crop} pixels of crops centred on the retro-reflection,"
    " grey levels as the camera counts them, finite and not negative; full_scale: float32 scalar, the camera's largest"
    " count (255 for 8 bits). Averaging over areas to {size} x {size}, square root, background and scaling are inside."
    " Intervals of 90 %: value - half_width ... value + half_width, from the row of half_width whose SNR (edges between"
    " the rows: snr_edges) is the crop's. novelty above 1: none of the classes. distance above 1: the crop is unlike"
    " the training frames, and the answer means nothing."
)


def onnx_card(model: NetworkEstimator) -> dict[str, Any]:
    """Return what an exported model says of itself; the file holds it as JSON in its metadata, under "tapetum".

    `half_width` [B, K] (None where unknown) and `snr_edges` [B - 1] are those of `tapetum.models.intervals.Intervals`.
    """
    widths = [[float(w) if math.isfinite(w) else None for w in row] for row in model.intervals_.half_width]
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
        "half_width": widths,
        "snr_edges": [float(edge) for edge in model.intervals_.edges],
        "training_data": model.data_hash_,
        "versions": {"tapetum": metadata.version("tapetum"), "torch": metadata.version("torch")},
        "use": _PREPARATION.format(crop=model.crop, size=model.size),
    }


def export_onnx(model: Predictor, path: str | Path) -> Path:
    """Write a fitted network to an ONNX file; one that is there already is replaced.

    Parameters
    ----------
    model
        A fitted `tapetum.models.NetworkEstimator`.
    path
        NAME.onnx.

    Returns
    -------
    Path
        The file. Its inputs and outputs are those of `onnx_bytes`.

    Raises
    ------
    InputError
        When the model is of another kind or not fitted, or the name ends otherwise.
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
    quantities; `probability` [N, C] and `novelty` [N] where there are classes; `distance` [N] of
    `tapetum.models.domain.Domain` where the model has one. Normalisations, standard deviations and
    the temperature are folded into the weights, in float64.

    Raises
    ------
    InputError
        When the model is of another kind or not fitted.
    MissingExtraError
        When the extra `fast` is not installed.

    Notes
    -----
    Written node by node: torch's own exporter needs three more packages and ten seconds for the same graph.
    """
    if not isinstance(model, NetworkEstimator):
        kind = getattr(model, "kind", type(model).__name__)
        if kind in ARCHITECTURES:
            raise InputError("is exported already", where="model", remedy="give the model's folder")
        raise InputError(f"only networks become ONNX, this one is {kind}", where="model", remedy="train one")
    state = model.state()  # says so when the model is not fitted
    card = onnx_card(model)
    graph = Graph(need("onnx", EXTRA))
    unit = float(state["scaling.unit"][0])
    seen = _prepared(graph, model)
    outputs = _outputs(graph, model, state, model.network_.to_onnx(graph, seen, unit))
    if model.domain_ is not None:
        _distance(graph, model.domain_, seen, model.size, unit)
        outputs["distance"] = ()
    return graph.finished(outputs, model.crop, card)


def _prepared(graph: Graph, model: NetworkEstimator) -> str:
    """`tapetum.models.inputs.prepare`, [N, 1, size, size]."""
    crop, size = model.crop, model.size
    pictures = graph.add("picture", "Unsqueeze", "counts", graph.constant("channel", [1], np.int64))
    if crop % size == 0:
        pool = [crop // size] * 2
        small = graph.add("small_counts", "AveragePool", pictures, kernel_shape=pool, strides=pool)
    else:
        area = _area_average(crop, size)
        rows = graph.add("rows", "MatMul", graph.constant("area_rows", area), pictures)
        small = graph.add("small_counts", "MatMul", rows, graph.constant("area_columns", area.T))
    small = graph.add("small", "Div", small, "full_scale")
    flat = graph.add("flat", "Reshape", small, graph.constant("flat_shape", [0, 1, 1, size * size], np.int64))
    # torch's median is the lower one: the largest of the smaller half.
    half = graph.constant("half", [(size * size - 1) // 2 + 1], np.int64)
    lower = graph.add("lower_half", "TopK", flat, half, outputs=("lower", "places"), axis=3, largest=0, sorted=0)
    median = graph.add("median", "ReduceMax", lower, graph.constant("along", [3], np.int64))
    if model.background == "level":
        out = graph.add("out", "Sub", small, median)
        soft = graph.add("soft", "Add", graph.add("size", "Abs", out), graph.constant("softening", SOFTENING))
        least = graph.constant("least", SOFTENING**0.5)
        height = graph.add("height", "Sub", graph.add("soft_root", "Sqrt", soft), least)
        seen = graph.add("seen", "Mul", height, graph.add("sign", "Sign", out))
    else:
        root, background = graph.add("root", "Sqrt", small), graph.add("background", "Sqrt", median)
        seen = graph.add("seen", "Sub", root, background)
    if not model.hide:
        return seen
    at = (np.arange(size) - (size - 1) / 2) * crop / size
    kept = at[:, None] ** 2 + at**2 > model.hide**2
    return graph.add("hidden", "Mul", seen, graph.constant("kept", kept))


def _area_average(crop: int, size: int) -> NDArray[np.float64]:
    """Return the matrix [size, crop] of torch's "area" interpolation: means over whole pixels that may overlap."""
    matrix = np.zeros((size, crop))
    for k in range(size):
        first, last = k * crop // size, -(-(k + 1) * crop // size)
        matrix[k, first:last] = 1 / (last - first)
    return matrix


def _outputs(
    graph: Graph, model: NetworkEstimator, state: dict[str, torch.Tensor], features: str
) -> dict[str, tuple[int, ...]]:
    """What the file answers, from the features: names, and shapes a frame."""
    head = model.network_.head
    weight, bias = array(head.weight), array(head.bias)
    k, classes = len(model.quantities), len(model.classes())
    shapes: dict[str, tuple[int, ...]] = {}
    if k:
        spread, centre = array(state["scaling.spread"]), array(state["scaling.centre"])
        linear = graph.constant("value.weight", (weight[:k] * spread[:, None]).T)
        graph.add("value", "Gemm", features, linear, graph.constant("value.bias", bias[:k] * spread + centre))
        shapes["value"] = (k,)
    if classes:
        linear = graph.constant("score.weight", weight[k:].T / model.temperature_)
        offset = graph.constant("score.bias", bias[k:] / model.temperature_)
        scores = graph.add("score", "Gemm", features, linear, offset)
        graph.add("probability", "Softmax", scores, axis=1)
        shapes["probability"] = (classes,)
    if model.novelty_ is not None:
        _novelty(graph, model.novelty_, features)
        shapes["novelty"] = ()
    return shapes


def _novelty(graph: Graph, novelty: Novelty, features: str) -> None:
    """`tapetum.models.novelty.Novelty`, [N]; distances from differences, which lose nothing in float32."""
    unit = novelty.unit
    white = graph.add("white", "MatMul", features, graph.constant("novelty.whitening", novelty.whitening / unit))
    each = graph.add("white_row", "Unsqueeze", white, graph.constant("novelty.row", [1], np.int64))
    apart = graph.add("apart", "Sub", each, graph.constant("novelty.means", novelty.means / unit))
    far = graph.add("far", "ReduceL2", apart, graph.constant("novelty.along", [2], np.int64), keepdims=0)
    graph.add("novelty", "ReduceMin", far, graph.constant("novelty.nearest", [1], np.int64), keepdims=0)


def _distance(graph: Graph, domain: Domain, seen: str, size: int, unit: float) -> None:
    """`tapetum.models.domain.Domain` of `picture_features`, [N]."""
    flat = graph.add("look", "Reshape", seen, graph.constant("look_shape", [0, size * size], np.int64))
    modes = graph.add("modes", "MatMul", flat, graph.constant("modes.projection", projection(size) / unit))
    kinds = np.kron(np.eye(2), groups(ORDER))
    square = graph.add("modes_square", "Mul", modes, modes)
    sizes = graph.add("magnitudes", "Sqrt", graph.add("sums", "MatMul", square, graph.constant("kinds", kinds)))
    along = graph.constant("look_along", [1], np.int64)
    scale = graph.constant("look_scale", 1 / unit)
    length = graph.add("length", "ReduceL2", flat, along)
    rms = graph.add("rms", "Mul", length, graph.constant("rms_scale", 1 / (unit * size)))
    largest = graph.add("largest", "Mul", graph.add("top", "ReduceMax", flat, along), scale)
    features = graph.add("described", "Concat", sizes, rms, largest, axis=1)
    apart = graph.add("from_mean", "Sub", features, graph.constant("domain.mean", domain.mean))
    white = graph.add("from_white", "MatMul", apart, graph.constant("domain.whitening", domain.whitening / domain.unit))
    graph.add("distance_", "ReduceL2", white, along, outputs=("distance",), keepdims=0)
