"""An ONNX graph that is written node by node."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

__all__ = ["Graph", "array"]

# Read by every ONNX Runtime since 1.15 (2023); nothing newer is needed.
_OPSET, _IR = 18, 9


class Graph:
    """Nodes and constants as they are added; every node gives one tensor, named as the node."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def constant(self, name: str, values: Any, dtype: type[np.generic] = np.float32) -> str:
        """Add a constant tensor; return its name."""
        array = np.ascontiguousarray(values, dtype=dtype).reshape(np.shape(values))
        self._constants.append(self._onnx.numpy_helper.from_array(array, name))
        return name

    def add(self, name: str, operator: str, *inputs: str, outputs: tuple[str, ...] = (), **attributes: Any) -> str:
        """Add a node; return the name of what it gives."""
        made = [*outputs] or [name]
        self._nodes.append(self._onnx.helper.make_node(operator, inputs, made, name=name, **attributes))
        return made[0]

    def finished(self, outputs: dict[str, tuple[int, ...]], crop: int, card: dict[str, Any]) -> bytes:
        """Return the whole model, checked."""
        helper, float32 = self._onnx.helper, self._onnx.TensorProto.FLOAT
        graph = helper.make_graph(
            self._nodes,
            "tapetum",
            [
                helper.make_tensor_value_info("counts", float32, ["N", crop, crop]),
                helper.make_tensor_value_info("full_scale", float32, []),
            ],
            [helper.make_tensor_value_info(name, float32, ["N", *shape]) for name, shape in outputs.items()],
            self._constants,
            doc_string=card["use"],
        )
        made = helper.make_model(
            graph,
            producer_name="tapetum",
            producer_version=card["versions"]["tapetum"],
            ir_version=_IR,
            opset_imports=[helper.make_opsetid("", _OPSET)],
        )
        helper.set_model_props(made, {"tapetum": json.dumps(card, allow_nan=False)})
        self._onnx.checker.check_model(made, full_check=True)
        return made.SerializeToString()

    def convolution(
        self, name: str, x: str, convolution: nn.Module, normalisation: nn.Module | None = None, *, unit: float = 1.0
    ) -> str:
        """Add a convolution of an input that is `unit` times as large, with a batch normalisation that follows."""
        assert isinstance(convolution, nn.Conv2d)
        weight = array(convolution.weight) / unit
        bias = np.zeros(len(weight)) if convolution.bias is None else array(convolution.bias)
        if normalisation is not None:
            assert isinstance(normalisation, nn.BatchNorm2d)
            mean, variance = array(normalisation.running_mean), array(normalisation.running_var)
            gain = array(normalisation.weight) / np.sqrt(variance + normalisation.eps)
            weight, bias = weight * gain[:, None, None, None], array(normalisation.bias) + (bias - mean) * gain
        (down, across), (high, wide) = convolution.stride, convolution.kernel_size
        above, left = (int(p) for p in convolution.padding)
        return self.add(
            name,
            "Conv",
            x,
            self.constant(f"{name}.weight", weight),
            self.constant(f"{name}.bias", bias),
            kernel_shape=[high, wide],
            strides=[down, across],
            pads=[above, left, above, left],
            group=convolution.groups,
        )


def array(tensor: torch.Tensor | None) -> NDArray[np.float64]:
    """Return a tensor of a module as an array, in double precision."""
    assert tensor is not None
    return tensor.detach().cpu().double().numpy()
