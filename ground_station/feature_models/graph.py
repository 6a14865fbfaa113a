"""A network's ONNX graph from numpy weights: same calls, same bytes.

Operators and their meaning: ONNX, opset 17 (onnx.ai/onnx/operators).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from ground_station import files
from ground_station.arrays import F32, F64
from ground_station.features.extractor import FeatureError
from ground_station.features.model_info import ModelInfo

OPSET = 17
IR_VERSION = 8
"""What belongs to opset 17; the library's own default changes with its version."""

Array = npt.NDArray[np.floating[Any]]


class Graph:
    """Nodes are added in the order in which they run; a tensor is known by the name returned.

    All tensors are float32 (N, C, H, W) with N, H and W free. Weights that are not finite are
    refused with `FeatureError` where they are given, a graph that does not fit together in `save`.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._nodes: list[onnx.NodeProto] = []
        self._weights: dict[str, onnx.TensorProto] = {}
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []
        self._counts: dict[str, int] = {}

    def input(self, name: str, channels: int) -> str:
        """An input (N, channels, H, W)."""
        self._inputs.append(_value(name, channels, "height", "width"))
        return name

    def output(self, x: str, name: str, channels: int) -> str:
        """Makes `x` an output (N, channels, its own height, its own width); it is called so now."""
        if any(value.name == x for value in (*self._inputs, *self._outputs)):
            x = self.node("Identity", [x])
        for node in self._nodes:
            for place in (node.input, node.output):
                place[:] = [name if tensor == x else tensor for tensor in place]
        self._outputs.append(_value(name, channels, f"{name}_height", f"{name}_width"))
        return name

    def node(self, operator: str, inputs: Sequence[str], **attributes: Any) -> str:
        """Any ONNX operator with one output."""
        label = self._label(operator)
        self._nodes.append(helper.make_node(operator, list(inputs), [label], label, **attributes))
        return label

    def weight(self, label: str, values: npt.ArrayLike) -> str:
        """A constant; floating point is stored as float32, other types as they are."""
        array = np.asarray(values)
        if array.dtype.kind == "f":
            array = array.astype(np.float32)
            if not np.isfinite(array).all():
                raise FeatureError(f"{self.name}: the weights of {label} are not all finite")
        self._weights[label] = numpy_helper.from_array(np.ascontiguousarray(array), label)
        return label

    def conv(self, x: str, weight: Array, bias: Array | None = None, stride: int = 1) -> str:
        """Cross-correlation with weight (out, in, height, width), both odd, and bias (out,).

        As many zeros stand around as keep the size at stride 1.
        """
        high, wide = weight.shape[2:]
        label = self._next("Conv")
        inputs = [x, self.weight(f"{label}.weight", weight)]
        if bias is not None:
            inputs.append(self.weight(f"{label}.bias", bias))
        return self.node(
            "Conv", inputs, kernel_shape=[high, wide], strides=[stride, stride],
            pads=[high // 2, wide // 2] * 2,
        )  # fmt: skip

    def scale_shift(self, x: str, scale: Array, shift: Array) -> str:
        """scale · x + shift, both (C,): a batch normalisation that no convolution precedes."""
        label = self._next("BatchNormalization")
        zeros, ones = np.zeros(len(scale)), np.ones(len(scale))
        names = ("scale", "shift", "mean", "variance")
        values = (scale, shift, zeros, ones)
        constants = [self.weight(f"{label}.{n}", v) for n, v in zip(names, values, strict=True)]
        # An epsilon of nought: the variance is one, and scale and shift hold all there is.
        return self.node("BatchNormalization", [x, *constants], epsilon=0.0)

    def relu(self, x: str) -> str:
        """max(x, 0)."""
        return self.node("Relu", [x])

    def sigmoid(self, x: str) -> str:
        """1 / (1 + exp(-x))."""
        return self.node("Sigmoid", [x])

    def max_pool(self, x: str, size: int) -> str:
        """The largest of each window, without padding; windows do not overlap."""
        return self.node("MaxPool", [x], kernel_shape=[size] * 2, strides=[size] * 2)

    def add(self, first: str, second: str) -> str:
        """The sum, element by element."""
        return self.node("Add", [first, second])

    def concat(self, tensors: Sequence[str]) -> str:
        """Tensors of one size, their channels one after the other."""
        return self.node("Concat", tensors, axis=1)

    def resize_bilinear(self, x: str, factor: int, align_corners: bool = False) -> str:
        """`factor` times as high and wide; the two conventions are those of torch's interpolate."""
        label = self._next("Resize")
        scales = self.weight(f"{label}.scales", np.array([1, 1, factor, factor], np.float32))
        return self.node(
            "Resize",
            [x, "", scales],
            mode="linear",
            coordinate_transformation_mode="align_corners" if align_corners else "half_pixel",
        )

    def l2_normalize(self, x: str) -> str:
        """Each pixel's vector divided by its length, or by 1e-12 where that is shorter."""
        length = self.node("ReduceL2", [x], axes=[1], keepdims=1)
        least = self.weight("least_length", np.array(1e-12, np.float32))
        return self.node("Div", [x, self.node("Max", [length, least])])

    def save(self, path: str | Path, info: ModelInfo) -> None:
        """Writes the model and what it is; raises `FeatureError` where it does not fit together."""
        files.write_bytes(path, self.model(info))

    def model(self, info: ModelInfo) -> bytes:
        """The bytes of the model's file; raises as `save` does."""
        graph = helper.make_graph(
            self._nodes, self.name, self._inputs, self._outputs, list(self._weights.values())
        )
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="blimp",
        )
        return serialized(model, info)

    def _next(self, operator: str) -> str:
        """The name that the next node of this operator gets."""
        return f"{operator}_{self._counts.get(operator, 0)}"

    def _label(self, operator: str) -> str:
        label = self._next(operator)
        self._counts[operator] = self._counts.get(operator, 0) + 1
        return label


def serialized(model: onnx.ModelProto, info: ModelInfo) -> bytes:
    """A model with what it is, checked, the same bytes for the same model."""
    del model.metadata_props[:]
    helper.set_model_props(model, dict(sorted(info.metadata().items())))
    try:
        onnx.checker.check_model(model, full_check=True)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        reason = str(error).strip().splitlines()[0]
        raise FeatureError(f"{info.name}: the network does not fit together: {reason}") from None
    data: bytes = model.SerializeToString(deterministic=True)
    return data


def fold_batch_norm(
    weight: Array,
    bias: Array | None,
    scale: Array,
    shift: Array,
    mean: Array,
    variance: Array,
    epsilon: float,
) -> tuple[F32, F32]:
    """Weight and bias of the convolution that is a convolution and then a batch normalisation.

    All but `weight` (out, in, h, w) are (out,). Reckoned in float64 (Ioffe and Szegedy, 2015).
    """
    factor, offset = batch_norm_terms(scale, shift, mean, variance, epsilon)
    before = np.zeros(len(factor)) if bias is None else np.asarray(bias, np.float64)
    folded = np.asarray(weight, np.float64) * factor[:, None, None, None]
    return folded.astype(np.float32), (before * factor + offset).astype(np.float32)


def batch_norm_terms(
    scale: Array, shift: Array, mean: Array, variance: Array, epsilon: float
) -> tuple[F64, F64]:
    """A batch normalisation as factor · x + offset, each (C,) float64."""
    factor = np.asarray(scale, np.float64) / np.sqrt(np.asarray(variance, np.float64) + epsilon)
    return factor, np.asarray(shift, np.float64) - np.asarray(mean, np.float64) * factor


def _value(name: str, channels: int, height: str, width: str) -> onnx.ValueInfoProto:
    shape: list[str | int | None] = ["batch", channels, height, width]
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
