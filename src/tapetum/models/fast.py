"""Networks on ONNX Runtime: the same numbers as `tapetum.models.NetworkEstimator`, sooner on a CPU."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tapetum.errors import InputError, need
from tapetum.models.base import Data, batches, frame_count
from tapetum.models.domain import judged
from tapetum.models.export import EXTRA, FORMAT, VERSION, onnx_bytes
from tapetum.models.inputs import central
from tapetum.models.intervals import Intervals
from tapetum.models.network import NetworkEstimator
from tapetum.models.prediction import Prediction, joined
from tapetum.models.snr import crop_snr
from tapetum.progress import Progress, quiet

__all__ = ["FastResNet18"]

# More at a time is no faster: one frame already fills the cores, and the tensors of a few stay in their caches.
_BATCH = 8
_ERRORS_ONLY = 3


class FastResNet18:
    """A trained network that only predicts, on ONNX Runtime and the CPU.

    Parameters
    ----------
    model
        A file of `tapetum.models.export.export_onnx` (NAME.onnx), a model's folder, or a fitted
        `tapetum.models.NetworkEstimator`.
    threads
        Threads of ONNX Runtime; as many as torch uses where left out.

    Attributes
    ----------
    card
        What the exported model says of itself: `tapetum.models.export.onnx_card`.
    target_names, quantities, data_hash_
        As those of the model that was exported.

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

    def __init__(self, model: str | Path | NetworkEstimator, *, threads: int | None = None) -> None:
        if threads is not None and threads < 1:
            raise InputError(f"must be at least 1, is {threads}", where="threads", remedy="leave it out")
        runtime = need("onnxruntime", EXTRA)
        content, where = _content(model)
        options = runtime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads() if threads is None else threads
        options.log_severity_level = _ERRORS_ONLY
        # Else its threads keep the cores busy for milliseconds after every frame, which detection needs.
        options.add_session_config_entry("session.force_spinning_stop", "1")
        try:
            self._session: Any = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # of several kinds, none of them public
            what = f"cannot be read as ONNX ({str(error).splitlines()[0]})"
            raise InputError(what, where=where, remedy="export it again with `tapetum export`") from error
        self.card = _card(self._session.get_modelmeta().custom_metadata_map, where)
        self.kind: str = self.card.get("kind", "resnet18")
        self.target_names: tuple[str, ...] = tuple(self.card["targets"])
        self.quantities: tuple[str, ...] = tuple(self.card["quantities"])
        self.data_hash_: str | None = self.card["training_data"]
        self._intervals = _intervals(self.card, where)
        self._outputs = [output.name for output in self._session.get_outputs()]

    def classes(self) -> tuple[str, ...]:
        """Return the names of the devices learned; empty where that is no target."""
        return tuple(self.card["classes"])

    def parameters(self) -> dict[str, Any]:
        """Return what its card says about the model that was exported."""
        told = {name: self.card[name] for name in ("crop", "size") if name in self.card}
        return {"target": list(self.target_names), **told, "runtime": "ONNX"}

    def predict(
        self, data: Data, *, full_scale: float | None = None, progress: Progress = quiet, anyway: bool = False
    ) -> Prediction:
        """Estimate the target for every image.

        Parameters
        ----------
        data
            A dataset or crops [N, side, side], centred as those of the training were.
        full_scale
            Largest count of the camera, for crops that are not uint8.
        progress
            Shown over the batches.
        anyway
            Answer also where the model does not apply; the prediction still says so.

        Returns
        -------
        Prediction

        Raises
        ------
        InputError
            When the images do not fit the model.
        """
        total = -(-frame_count(data) // _BATCH)
        parts = list(self._parts(progress(batches(data, full_scale, _BATCH), f"{self.kind}, fast", total=total)))
        found = joined(parts or [self._predicted(self._empty(), np.empty(0))])
        return found if anyway else found.withheld()

    def _parts(self, images: Any) -> Iterator[Prediction]:
        for crops, depth in images:
            counts, scale = (
                central(crops, self.card["crop"]).astype(np.float32, copy=False),
                np.array(depth, dtype=np.float32),
            )
            given = self._session.run(self._outputs, {"counts": counts, "full_scale": scale})
            found = {name: np.asarray(one, dtype=np.float64) for name, one in zip(self._outputs, given, strict=True)}
            # The SNR costs half a millisecond a frame: only where the intervals hang on it.
            snr = crop_snr(crops, depth) if self._intervals.conditional else np.zeros(len(crops))
            yield self._predicted(found, snr)

    def _empty(self) -> dict[str, NDArray[np.float64]]:
        shapes = {"value": (0, len(self.quantities)), "probability": (0, len(self.classes()))}
        return {name: np.empty(shapes.get(name, (0,))) for name in self._outputs}

    def _predicted(self, found: dict[str, NDArray[np.float64]], snr: NDArray[np.float64]) -> Prediction:
        value = found.get("value", np.empty((len(snr), 0)))
        width = self._intervals.at(snr)
        raw = Prediction(
            self.quantities,
            value,
            value - width,
            value + width,
            self.classes(),
            found.get("probability"),
            found.get("novelty"),
        )
        return judged(raw, found.get("distance"))


def _content(model: str | Path | NetworkEstimator) -> tuple[bytes | str, object]:
    """Return an ONNX model, or the path of one, and how to call it in messages."""
    if isinstance(model, NetworkEstimator):
        return onnx_bytes(model), "model"
    path = Path(model)
    if path.is_dir():
        from tapetum.models.store import load_model

        loaded = load_model(path)
        if not isinstance(loaded, NetworkEstimator):
            what = f"only networks have a fast path, this one is {loaded.kind}"
            raise InputError(what, where=path, remedy="use it as it is")
        return onnx_bytes(loaded), path
    if not path.is_file():
        raise InputError("there is no such model", where=path, remedy="write one with `tapetum export`")
    return str(path), path


def _card(metadata: dict[str, str], where: object) -> dict[str, Any]:
    """Read and check what an ONNX file says of itself."""
    remedy = "export it again with `tapetum export`"
    try:
        card = json.loads(metadata["tapetum"])
    except (KeyError, ValueError) as error:
        raise InputError("is an ONNX file, but not one of Tapetum", where=where, remedy=remedy) from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise InputError("is an ONNX file, but not one of Tapetum", where=where, remedy=remedy)
    version = card.get("version")
    if not isinstance(version, int) or version > VERSION:
        what = f"has version {version!r} of the format, this Tapetum reads up to {VERSION}"
        raise InputError(what, where=where, remedy="update Tapetum")
    needed = {"targets": list, "quantities": list, "classes": list, "crop": int, "half_width": list, "snr_edges": list}
    lost = [name for name, kind in needed.items() if not isinstance(card.get(name), kind)]
    if lost or "training_data" not in card:
        raise InputError(f"its card lacks {', '.join(lost) or 'training_data'}", where=where, remedy=remedy)
    return card


def _intervals(card: dict[str, Any], where: object) -> Intervals:
    try:
        widths = [[np.inf if w is None else float(w) for w in row] for row in card["half_width"]]
        edges = np.array(card["snr_edges"], dtype=np.float64)
        return Intervals(edges, np.array(widths).reshape(len(edges) + 1, len(card["quantities"])))
    except (TypeError, ValueError) as error:
        remedy = "export it again with `tapetum export`"
        raise InputError("the intervals on its card cannot be read", where=where, remedy=remedy) from error
