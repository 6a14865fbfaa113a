"""Trained weights to the model's file. Needs no torch: the weights are numpy arrays by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from ground_station.arrays import F32
from ground_station.feature_models import scale
from ground_station.feature_models.graph import Graph, fold_batch_norm
from ground_station.features.model_info import ModelInfo
from ground_station.training.errors import TrainingError
from ground_station.training.topology import OUTPUTS, Conv, Operations, Shape

EPSILON = 1e-5
"""Of the batch normalisations, in training and where they are folded."""

LICENCE = "BSD-3-Clause"

Weights = Mapping[str, F32]


def info(shape: Shape, source: str) -> ModelInfo:
    """What the file says of itself."""
    return ModelInfo(
        name=shape.name,
        layout="blobs",
        dimension=shape.dimension,
        multiple=shape.multiple,
        licence=LICENCE,
        source=source,
        details=shape.details,
    )


def _folded(layer: Conv, weights: Weights) -> tuple[F32, F32]:
    def take(name: str, *shape: int) -> F32:
        if name not in weights:
            raise TrainingError(f"the weights lack '{name}'")
        array = weights[name]
        if array.shape != shape:
            raise TrainingError(f"'{name}' is {array.shape}; this network has {shape}")
        return array

    n, name = layer.channels_out, layer.name
    weight = take(f"{name}.weight", n, layer.channels_in, layer.size, layer.size)
    if not layer.norm:
        return weight, take(f"{name}.bias", n)
    scale, shift, mean, variance = (
        take(f"{name}.norm.{term}", n) for term in ("weight", "bias", "mean", "var")
    )
    return fold_batch_norm(weight, None, scale, shift, mean, variance, EPSILON)


class _OnnxOperations(Operations):
    """The graph's nodes; batch normalisations are folded into the convolutions before them."""

    def __init__(self, graph: Graph, weights: Weights) -> None:
        self._graph, self._weights = graph, weights

    def conv(self, layer: Conv, x: str) -> str:
        weight, bias = _folded(layer, self._weights)
        return self._graph.conv(x, weight, bias, stride=layer.stride)

    def relu(self, x: str) -> str:
        return self._graph.relu(x)

    def add(self, first: str, second: str) -> str:
        return self._graph.add(first, second)

    def double(self, x: str) -> str:
        return self._graph.resize_bilinear(x, 2)

    def fold(self, x: str, side: int) -> str:
        return self._graph.node("SpaceToDepth", [x], blocksize=side)


def export(shape: Shape, weights: Weights, path: str | Path, source: str) -> ModelInfo:
    """Writes the model's file, atomically; raises `TrainingError` naming a weight that is wrong.

    Weights by name: `LAYER.weight` (out, in, k, k), and either `LAYER.bias` or
    `LAYER.norm.weight|bias|mean|var`, all (out,).
    """
    graph = Graph(shape.name)
    image = graph.input("image", 1)
    made = shape.build(_OnnxOperations(graph, weights), image)
    channels = (shape.dimension - shape.details, shape.details, 1)
    for value, name, count in zip(made, OUTPUTS, channels, strict=True):
        graph.output(value, name, count)
    said = info(shape, source)
    said = replace(said, distance_scale=scale.measured(graph.model(said), said))
    graph.save(path, said)
    return said
