"""Model files: read, and what a graph may hold looked at before anything of it is run."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from pathlib import Path

import onnx

from ground_station.features.extractor import FeatureError
from ground_station.features.model_info import MAX_BYTES, Model, ModelInfo
from ground_station.files import read_bytes

OPSETS = (17, 26)
"""The oldest and the newest of ONNX's operator sets that are taken."""
OPERATORS = {
    "Add", "AveragePool", "BatchNormalization", "Cast", "Clip", "Concat", "Constant", "Conv",
    "ConvInteger", "ConvTranspose", "DepthToSpace", "DequantizeLinear", "Div",
    "DynamicQuantizeLinear", "Elu", "Exp", "Gelu", "GlobalAveragePool", "GridSample",
    "HardSigmoid", "HardSwish", "Identity", "LeakyRelu", "LpNormalization", "MatMul", "Max",
    "MaxPool", "Min", "Mul", "Neg", "PRelu", "Pad", "Pow", "QLinearConv", "QuantizeLinear",
    "ReduceL2", "ReduceMax", "ReduceMean", "ReduceSum", "Relu", "Reshape", "Resize", "Sigmoid",
    "Slice", "Softmax", "Softplus", "SpaceToDepth", "Split", "Sqrt", "Squeeze", "Sub", "Sum",
    "Tanh", "Transpose", "Unsqueeze",
}  # fmt: skip
"""Arithmetic on arrays of known size. No loops, no branches, nothing that repeats or makes up
values, nothing that takes its size from a value."""

_DOMAINS = ("", "ai.onnx")
_MOST_NODES = 5000
_MOST_VALUES_A_PIXEL = 512
"""Of any one array; at full resolution, that many channels."""
_MOST_MACS_A_PIXEL = 2_000_000
"""SuperPoint takes 85 000."""
_PROBE_PX = 128
"""The picture for which sizes are reckoned: a multiple of all that `ModelInfo` allows."""


def read(path: str | Path) -> Model:
    """Reads a model's file and looks through its graph; runs nothing.

    Raises `FeatureError` with one line naming the file: it is not there, too large, cut, not ONNX,
    has other metadata, or a graph that is not a feature network's (see `inspection.check`).
    """
    path = Path(path)
    data = read_bytes(path, MAX_BYTES, FeatureError)
    try:
        proto = parse(data)
        info = ModelInfo.of_metadata({item.key: item.value for item in proto.metadata_props})
        check(proto, info)
    except FeatureError as error:
        raise FeatureError(f"{path}: {error}") from None
    except (AttributeError, TypeError, ValueError, LookupError) as error:
        # protobuf hands on text that is none as bytes, and numbers beyond what they count.
        raise FeatureError(f"{path}: it is damaged ({type(error).__name__})") from None
    return Model(path, info, data, hashlib.sha256(data).hexdigest())


def parse(data: bytes) -> onnx.ModelProto:
    """A file's bytes as a graph; raises `FeatureError` with one line. Reads no other file."""
    try:
        proto = onnx.load_model_from_string(data)
    except Exception as error:  # protobuf's errors have no common base that it exports
        raise FeatureError(f"not an ONNX file, or cut ({type(error).__name__})") from None
    if not proto.graph.node:
        raise FeatureError("not an ONNX file, or cut (it holds no graph)")
    return proto


def check(proto: onnx.ModelProto, info: ModelInfo) -> None:
    """Raises `FeatureError` with one line unless the graph is a feature network of that layout.

    That is: operators of ONNX itself and of the list above, all values in the file, inputs and
    outputs of the layout's names, types and shapes, and no array so large, nor so much to compute,
    that a picture would exhaust the machine.
    """
    _check_operators(proto)
    _check_values(proto.graph)
    inputs, outputs = _expected(info)
    _check_ends("input", [v for v in proto.graph.input if not _is_weight(proto.graph, v)], inputs)
    _check_ends("output", list(proto.graph.output), outputs)
    sizes = _sizes(proto, info)
    for name, shape in sizes.items():
        if math.prod(shape) > _MOST_VALUES_A_PIXEL * _PROBE_PX**2:
            raise FeatureError(
                f"the array '{name:.40}' has {math.prod(shape) / _PROBE_PX**2:.0f} values a pixel; "
                f"at most {_MOST_VALUES_A_PIXEL} are allowed"
            )
    for name, expected in outputs.items():
        if sizes.get(name) != expected:
            raise FeatureError(
                f"for a picture of {_PROBE_PX}x{_PROBE_PX} the output '{name}' has the shape "
                f"{_text(sizes.get(name))}; the layout '{info.layout}' needs {_text(expected)}"
            )
    cost = _macs(proto.graph, sizes) / _PROBE_PX**2
    if cost > _MOST_MACS_A_PIXEL:
        raise FeatureError(
            f"it takes {cost:.3g} multiplications a pixel; at most {_MOST_MACS_A_PIXEL} are allowed"
        )


def macs(data: bytes, info: ModelInfo, width_px: int = 640, height_px: int = 480) -> float:
    """Multiplications and additions of all convolutions for a picture of that size."""
    proto = parse(data)
    a_pixel = _macs(proto.graph, _sizes(proto, info)) / _PROBE_PX**2
    return a_pixel * width_px * height_px


def _check_operators(proto: onnx.ModelProto) -> None:
    for opset in proto.opset_import:
        if opset.domain not in _DOMAINS:
            raise FeatureError(f"it needs operators of '{opset.domain:.40}'; allowed: ONNX's own")
        if not OPSETS[0] <= opset.version <= OPSETS[1]:
            raise FeatureError(
                f"its operators are of set {opset.version}; allowed: {OPSETS[0]} to {OPSETS[1]}"
            )
    if not proto.opset_import:
        raise FeatureError("it names no operator set")
    if proto.functions:
        raise FeatureError(f"it defines an operator of its own, '{proto.functions[0].name:.40}'")
    if proto.training_info:
        raise FeatureError("it holds a training graph")
    if len(proto.graph.node) > _MOST_NODES:
        raise FeatureError(f"it has {len(proto.graph.node)} nodes; allowed: {_MOST_NODES}")
    for node in proto.graph.node:
        if node.domain not in _DOMAINS or node.op_type not in OPERATORS:
            name = f"{node.domain}.{node.op_type}" if node.domain else node.op_type
            raise FeatureError(f"it uses the operator '{name:.60}', which no feature network needs")
        if any(a.HasField("g") or len(a.graphs) for a in node.attribute):
            raise FeatureError(f"its node '{node.name:.40}' holds another graph")


def _check_values(graph: onnx.GraphProto) -> None:
    if graph.sparse_initializer:
        raise FeatureError("it holds sparse values")
    for tensor in _tensors(graph):
        if tensor.data_location != onnx.TensorProto.DEFAULT or tensor.external_data:
            raise FeatureError(f"its values '{tensor.name:.40}' are in another file")


def _tensors(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("sparse_tensor") or attribute.sparse_tensors:
                raise FeatureError("it holds sparse values")
            if attribute.HasField("t"):
                yield attribute.t
            yield from attribute.tensors


def _is_weight(graph: onnx.GraphProto, value: onnx.ValueInfoProto) -> bool:
    return any(tensor.name == value.name for tensor in graph.initializer)


def _expected(info: ModelInfo) -> tuple[dict[str, tuple[int, ...]], dict[str, tuple[int, ...]]]:
    """Shapes of inputs and outputs for one picture of the probe's size."""
    side, quarter, eighth = _PROBE_PX, _PROBE_PX // 4, _PROBE_PX // 8
    inputs: dict[str, tuple[int, ...]] = {"image": (1, info.channels, side, side)}
    if info.layout == "blobs":
        return inputs, {
            "descriptors": (1, info.dimension - info.details, eighth, eighth),
            "details": (1, info.details, quarter, quarter),
            "worth": (1, 1, eighth, eighth),
        }
    if info.layout == "cells":
        descriptors = (1, info.dimension, eighth, eighth)
        return inputs, {"logits": (1, 65, eighth, eighth), "descriptors": descriptors}
    descriptors = (1, info.dimension, side, side)
    return inputs, {"scores": (1, 1, side, side), "descriptors": descriptors}


def _check_ends(
    kind: str, values: list[onnx.ValueInfoProto], expected: dict[str, tuple[int, ...]]
) -> None:
    names = [value.name for value in values]
    if sorted(names) != sorted(expected):
        shown = ", ".join(name[:40] for name in names[:4]) or "none"
        raise FeatureError(f"its {kind}s are {shown}; needed: {', '.join(expected)}")
    for value in values:
        if value.type.tensor_type.elem_type != onnx.TensorProto.FLOAT:
            raise FeatureError(f"its {kind} '{value.name}' is not of 32-bit floating point")


def _sizes(proto: onnx.ModelProto, info: ModelInfo) -> dict[str, tuple[int, ...]]:
    """The shape of every array for one picture of the probe's size."""
    fixed = onnx.ModelProto()
    fixed.CopyFrom(proto)
    inputs, _ = _expected(info)
    graph = fixed.graph
    del graph.value_info[:]
    for value in graph.output:  # what the graph does counts, not what it says
        value.type.tensor_type.ClearField("shape")
    for value in graph.input:
        if value.name not in inputs:
            continue
        dims, wanted = value.type.tensor_type.shape.dim, inputs[value.name]
        if len(dims) != 4 or any(
            dim.HasField("dim_value") and (k != 1 or dim.dim_value != wanted[1])
            for k, dim in enumerate(dims)
        ):
            raise FeatureError(
                f"its input '{value.name}' must be (N, {wanted[1]}, H, W) with N, H and W free"
            )
        for dim, size in zip(dims, wanted, strict=True):
            dim.dim_value = size
    try:
        inferred = onnx.shape_inference.infer_shapes(
            fixed, check_type=True, strict_mode=True, data_prop=True
        )
    except Exception as error:  # what onnx raises has no common base
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FeatureError(f"its graph does not fit together: {reason:.200}") from None
    graph = inferred.graph
    sizes = {tensor.name: tuple(tensor.dims) for tensor in graph.initializer}
    for value in (*graph.input, *graph.value_info, *graph.output):
        shape = value.type.tensor_type.shape
        if value.type.tensor_type.HasField("shape") and all(
            dim.HasField("dim_value") for dim in shape.dim
        ):
            sizes[value.name] = tuple(dim.dim_value for dim in shape.dim)
    for node in graph.node:
        for name in node.output:
            if name and name not in sizes:
                raise FeatureError(f"the size of its array '{name:.40}' cannot be told beforehand")
    return sizes


def _macs(graph: onnx.GraphProto, sizes: dict[str, tuple[int, ...]]) -> float:
    total = 0.0
    for node in graph.node:
        if node.op_type in ("Conv", "ConvInteger", "QLinearConv"):
            weight = sizes[node.input[3 if node.op_type == "QLinearConv" else 1]]
            total += math.prod(sizes[node.output[0]]) * math.prod(weight[1:])
        elif node.op_type == "ConvTranspose":
            total += math.prod(sizes[node.input[0]]) * math.prod(sizes[node.input[1]][1:])
        elif node.op_type == "MatMul":
            total += math.prod(sizes[node.output[0]]) * sizes[node.input[0]][-1]
    return total


def _text(shape: tuple[int, ...] | None) -> str:
    return "none" if shape is None else "x".join(map(str, shape))
