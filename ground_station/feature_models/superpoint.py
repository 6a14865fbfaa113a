"""SuperPoint (DeTone, Malisiewicz and Rabinovich, CVPR workshops 2018) from its weights.

Two layouts of one network: Magic Leap's `superpoint_v1.pth`, and the PyTorch port of the
TensorFlow re-implementation of Pautrat and Sarlin, which normalises each batch after the ReLU.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from ground_station.feature_models.graph import Graph, batch_norm_terms, fold_batch_norm
from ground_station.feature_models.torch_file import Weights
from ground_station.features.model_info import ModelInfo

_WIDTHS: Final = (64, 64, 128, 128)
"""Of the encoder's four pairs of 3x3 convolutions, with a pooling between two pairs."""
_HEAD = 256
_LOGITS = 65
_DIMENSION = 256
_EPSILON = 1e-3
"""Of the port's batch normalisation: TensorFlow's default."""

_MAGIC_LEAP_NAMES = (
    *(f"conv{pair}{letter}" for pair in "1234" for letter in "ab"),
    *("convPa", "convPb", "convDa", "convDb"),
)
_PORT_NAMES = (
    *(f"backbone.{pair}.{place}" for pair in range(4) for place in range(2)),
    *("detector.0", "detector.1", "descriptor.0", "descriptor.1"),
)

_INFO = ModelInfo(
    name="superpoint",
    layout="cells",
    dimension=_DIMENSION,
    multiple=8,
    licence="Magic Leap: academic or non-profit noncommercial research only, no redistribution",
    source="SuperPoint, Magic Leap's superpoint_v1.pth",
    nms_px=4,
    threshold=0.015,
)
_PORT_INFO = replace(
    _INFO,
    name="superpoint-open",
    licence="as its source says; the port's repository is under MIT",
    source="SuperPoint, PyTorch port of the re-implementation of Pautrat and Sarlin",
    threshold=0.005,
)


def recognises(weights: Weights) -> bool:
    """Whether the file looks like SuperPoint, in either layout."""
    return any(map(weights.has, ("conv1a.weight", "backbone.0.0.conv.weight")))


def build(weights: Weights) -> tuple[Graph, ModelInfo]:
    """The network of layout `cells`.

    Raises `WeightsError` naming the first tensor that is missing or of another shape.
    """
    port = not weights.has("conv1a.weight")
    names = _PORT_NAMES if port else _MAGIC_LEAP_NAMES
    graph = Graph("superpoint")
    x = graph.input("image", 1)
    layer = _port_layer if port else _layer
    wide = 1
    for pair, width in enumerate(_WIDTHS):
        x = graph.max_pool(x, 2) if pair else x
        for name in names[2 * pair : 2 * pair + 2]:
            x = layer(graph, weights, x, name, (width, wide, 3, 3), relu=True)
            wide = width
    heads = (("logits", names[8:10], _LOGITS), ("descriptors", names[10:12], _DIMENSION))
    for output, (first, second), channels in heads:
        head = layer(graph, weights, x, first, (_HEAD, wide, 3, 3), relu=True)
        head = layer(graph, weights, head, second, (channels, _HEAD, 1, 1), relu=False)
        graph.output(head, output, channels)
    return graph, _PORT_INFO if port else _INFO


def _layer(
    graph: Graph, weights: Weights, x: str, name: str, shape: tuple[int, ...], relu: bool
) -> str:
    weight = weights.take(f"{name}.weight", shape)
    x = graph.conv(x, weight, weights.take(f"{name}.bias", shape[:1]))
    return graph.relu(x) if relu else x


def _port_layer(
    graph: Graph, weights: Weights, x: str, name: str, shape: tuple[int, ...], relu: bool
) -> str:
    """Convolution, ReLU where there is one, and after it the batch normalisation."""
    weight = weights.take(f"{name}.conv.weight", shape)
    bias = weights.take(f"{name}.conv.bias", shape[:1])
    norm = weights.batch_norm(f"{name}.bn", shape[0])
    if not relu:
        return graph.conv(x, *fold_batch_norm(weight, bias, *norm, _EPSILON))
    # The next convolution pads its input with noughts, so the shift cannot be folded into it.
    return graph.scale_shift(
        graph.relu(graph.conv(x, weight, bias)), *batch_norm_terms(*norm, _EPSILON)
    )
