"""Networks on ONNX Runtime: the results of `tapetum.models.NetworkEstimator`, faster on a CPU."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tapetum.errors import InputError, need
from tapetum.models.base import Predictor
from tapetum.models.card import check_version
from tapetum.models.export import EXTRA, FORMAT, VERSION, onnx_bytes
from tapetum.models.inputs import central
from tapetum.models.intervals import Intervals
from tapetum.models.network import NetworkEstimator
from tapetum.models.prediction import Prediction
from tapetum.models.simulation import SCENE_SUFFIXES, read_by_scene
from tapetum.models.snr import crop_snr
from tapetum.models.store import load_model

__all__ = ["FastResNet18", "load_predictor"]

_ERRORS_ONLY = 3
_REMEDY = "export it again with `tapetum export`"


class FastResNet18(Predictor):
    """A trained network that only predicts, on ONNX Runtime and the CPU.

    Parameters
    ----------
    model
        A file of `tapetum.models.export.export_onnx` (NAME.onnx), a model's folder, or a fitted
        `tapetum.models.NetworkEstimator`.
    threads
        Most images that are estimated at once, each by one thread; by default as many as torch uses threads.

    Attributes
    ----------
    card
        The exported model's `tapetum.models.export.onnx_card`.

    Raises
    ------
    InputError
        When the model is no network, or the file is missing, damaged, foreign or newer.
    MissingExtraError
        When the extra `fast` is not installed.

    Examples
    --------
    >>> from tapetum.models.fast import FastResNet18
    >>> model = FastResNet18("gaze.onnx")  # doctest: +SKIP
    >>> model.predict(crops, full_scale=255)["gaze_x"]  # doctest: +SKIP
    """

    # Larger batches are no faster: small ones stay in the cores' caches.
    _batch = 8
    # Parts of a batch for each thread: where another thread takes one of the cores, the others take more parts.
    _parts = 2

    def __init__(self, model: str | Path | NetworkEstimator, *, threads: int | None = None) -> None:
        if threads is not None and threads < 1:
            raise InputError(f"must be at least 1, is {threads}", where="threads", remedy="leave it out")
        runtime = need("onnxruntime", EXTRA)
        content, where = _content(model)
        options = runtime.SessionOptions()
        # Threads that share one image wait for each other, busily, after each layer: beside detection, which takes a
        # core now and then, they spend a third more of processor time than threads with images of their own.
        options.intra_op_num_threads = 1
        options.log_severity_level = _ERRORS_ONLY
        self._threads = torch.get_num_threads() if threads is None else threads
        self._pool = ThreadPoolExecutor(self._threads, "models")
        try:
            self._session: Any = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # of several kinds, none of them public
            what = f"cannot be read as ONNX ({str(error).splitlines()[0]})"
            raise InputError(what, where=where, remedy=_REMEDY) from error
        self.card = _card(self._session.get_modelmeta().custom_metadata_map, where)
        self.kind = self.card.get("kind", "resnet18")
        self.target_names = tuple(self.card["targets"])
        self.quantities = tuple(self.card["quantities"])
        self.data_hash_ = self.card["training_data"]
        self.intervals_ = _intervals(self.card["half_width"], self.card["snr_edges"], self.card, where)
        # Files of older versions lack both.
        other = self.card.get("other_unit")
        self.others_ = _intervals(*_told(other, where), self.card, where) if other else None
        self._outputs = [output.name for output in self._session.get_outputs()]

    @property
    def marks(self) -> frozenset[str]:
        return frozenset(map(str, self.card.get("films") or ()))

    def classes(self) -> tuple[str, ...]:
        return tuple(self.card["classes"])

    def parameters(self) -> dict[str, Any]:
        """Return the exported model's target and sizes, from its card."""
        sizes = {name: self.card[name] for name in ("crop", "size") if name in self.card}
        return {"target": list(self.target_names), **sizes, "runtime": "ONNX"}

    def _progress_label(self) -> str:
        return f"{self.kind}, fast"

    def _estimate(self, images: NDArray[np.generic], full_scale: float, own: bool = True) -> Prediction:
        counts = central(images, self.card["crop"]).astype(np.float32, copy=False)
        # ONNX Runtime refuses an empty batch: it gets a black image, whose result is dropped.
        counts = counts if len(counts) else np.zeros((1, *counts.shape[1:]), np.float32)
        given = self._run(counts, full_scale)
        found = {
            name: np.asarray(one, np.float64)[: len(images)] for name, one in zip(self._outputs, given, strict=True)
        }
        return self._prediction(
            found.get("value", np.empty((len(images), 0))),
            lambda: crop_snr(images, full_scale),
            found.get("distance"),
            found.get("probability"),
            found.get("novelty"),
            own,
            found.get("deviation"),
        )

    def _run(self, counts: NDArray[np.float32], full_scale: float) -> list[NDArray[np.generic]]:
        """Return the network's outputs for images, parts of which are estimated at once."""
        scale = np.array(full_scale, np.float32)

        def run(part: NDArray[np.float32]) -> list[NDArray[np.generic]]:
            return self._session.run(self._outputs, {"counts": part, "full_scale": scale})

        if self._threads == 1 or len(counts) == 1:
            return run(counts)
        parts = self._pool.map(run, np.array_split(counts, min(len(counts), self._parts * self._threads)))
        return [np.concatenate(one) for one in zip(*parts, strict=True)]


def load_predictor(path: str | Path) -> Predictor:
    """Load a model's folder, a network exported to NAME.onnx, which is faster on a CPU, or a scene, NAME.yaml.

    A scene, such as a twin, reads frames by simulation (`tapetum.models.simulation.read_by_scene`).

    Raises
    ------
    InputError
        As `load_model`, `FastResNet18` and `read_by_scene`.
    MissingExtraError
        For an .onnx file when the extra `fast` is not installed.
    """
    ending = Path(path).suffix.lower()
    if ending in SCENE_SUFFIXES:
        return read_by_scene(path)
    return FastResNet18(path) if ending == ".onnx" else load_model(path)


def _content(model: str | Path | NetworkEstimator) -> tuple[bytes | str, object]:
    """Return an ONNX model, or the path of one, and its name for messages."""
    if isinstance(model, NetworkEstimator):
        return onnx_bytes(model), "model"
    path = Path(model)
    if path.is_dir():
        loaded = load_model(path)
        if not isinstance(loaded, NetworkEstimator):
            what = f"only networks have a fast path, this one is {loaded.kind}"
            raise InputError(what, where=path, remedy="use it as it is")
        return onnx_bytes(loaded), path
    if not path.is_file():
        raise InputError("there is no such model", where=path, remedy="write one with `tapetum export`")
    return str(path), path


def _card(metadata: dict[str, str], where: object) -> dict[str, Any]:
    """Read and check the card in an ONNX file's metadata."""
    try:
        card = json.loads(metadata["tapetum"])
    except (KeyError, ValueError):
        card = None
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise InputError("is an ONNX file, but not one of Tapetum", where=where, remedy=_REMEDY)
    check_version(card.get("version"), VERSION, where)
    needed = {"targets": list, "quantities": list, "classes": list, "crop": int, "half_width": list, "snr_edges": list}
    missing = [name for name, kind in needed.items() if not isinstance(card.get(name), kind)]
    if missing or "training_data" not in card:
        raise InputError(f"its card lacks {', '.join(missing) or 'training_data'}", where=where, remedy=_REMEDY)
    return card


def _told(other: Any, where: object) -> tuple[Any, Any]:
    if not isinstance(other, dict) or not {"half_width", "distance_edges"} <= set(other):
        raise InputError("the intervals for another unit on its card cannot be read", where=where, remedy=_REMEDY)
    return other["half_width"], other["distance_edges"]


def _intervals(half_width: Any, limits: Any, card: dict[str, Any], where: object) -> Intervals:
    try:
        widths = [[np.inf if w is None else float(w) for w in row] for row in half_width]
        edges = np.array(limits, dtype=np.float64)
        return Intervals(edges, np.array(widths).reshape(len(edges) + 1, len(card["quantities"])))
    except (TypeError, ValueError) as error:
        raise InputError("the intervals on its card cannot be read", where=where, remedy=_REMEDY) from error
