"""ALIKE (Zhao et al., IEEE Transactions on Multimedia 2022), sizes t, s, n and l, from its weights.

The descriptors are normalised at each pixel, as the paper's own code does before it samples them.
"""

from __future__ import annotations

from dataclasses import replace

from ground_station.feature_models.graph import Graph, fold_batch_norm
from ground_station.feature_models.torch_file import Weights, WeightsError
from ground_station.features.model_info import ModelInfo

_SIZES = {
    # Widths of the four blocks, dimension of the descriptor, whether there is a second head.
    "t": (8, 16, 32, 64, 64, False),
    "s": (8, 16, 48, 96, 96, False),
    "n": (16, 32, 64, 128, 128, False),
    "l": (32, 64, 128, 128, 128, True),
}
_POOLS = (1, 2, 4, 4)
"""Before each block; at the end a pixel of the last one is 32 of the image."""
_EPSILON = 1e-5
"""Of torch's BatchNorm2d."""

_INFO = ModelInfo(
    name="alike",
    layout="pixels",
    dimension=128,
    multiple=32,
    licence="BSD-3-Clause, copyright 2022 Zhao Xiaoming",
    source="ALIKE, Shiaoming/ALIKE",
    nms_px=2,
    threshold=0.2,
    subpixel_px=2,
)


def recognises(weights: Weights) -> bool:
    """Whether the file looks like ALIKE."""
    return weights.has("block1.conv1.weight") and weights.has("convhead2.weight")


def build(weights: Weights) -> tuple[Graph, ModelInfo]:
    """The network of layout `pixels`; which size it is follows from the shapes.

    Raises `WeightsError` naming the first tensor that is missing or of another shape.
    """
    size = _size(weights)
    *widths, dimension, two_heads = _SIZES[size]
    graph = Graph(f"alike-{size}")
    x = graph.input("image", 3)
    wide, scale, parts = 3, 1, []
    for number, (width, pool) in enumerate(zip(widths, _POOLS, strict=True), 1):
        x = x if pool == 1 else graph.max_pool(x, pool)
        scale *= pool
        x = _block(graph, weights, x, number, wide, width)
        wide = width
        share = weights.take(f"conv{number}.weight", (dimension // 4, width, 1, 1))
        part = graph.relu(graph.conv(x, share))
        parts.append(part if scale == 1 else graph.resize_bilinear(part, scale, align_corners=True))
    x = graph.concat(parts)
    if two_heads:
        x = graph.relu(
            graph.conv(x, weights.take("convhead1.weight", (dimension, dimension, 1, 1)))
        )
    head = weights.take("convhead2.weight", (dimension + 1, dimension, 1, 1))
    # One convolution whose channels go two ways is two: what is cut apart need not be copied.
    graph.output(graph.sigmoid(graph.conv(x, head[-1:])), "scores", 1)
    graph.output(graph.l2_normalize(graph.conv(x, head[:-1])), "descriptors", dimension)
    return graph, replace(
        _INFO, name=f"alike-{size}", source=f"{_INFO.source}, alike-{size}", dimension=dimension
    )


def _size(weights: Weights) -> str:
    shapes = tuple(weights.shape(f"block{number}.conv1.weight")[:1] for number in range(1, 5))
    for size, known in _SIZES.items():
        if shapes == tuple((width,) for width in known[:4]):
            return size
    found = ", ".join(str(*shape) for shape in shapes)
    raise WeightsError(
        f"{weights.path}: blocks of {found} channels; known are the sizes {', '.join(_SIZES)}"
    )


def _block(graph: Graph, weights: Weights, x: str, number: int, wide: int, width: int) -> str:
    """Two convolutions; from the second block on the input is added, in as many channels."""
    name = f"block{number}"

    def layer(x: str, place: int, channels: int) -> str:
        weight = weights.take(f"{name}.conv{place}.weight", (width, channels, 3, 3))
        norm = weights.batch_norm(f"{name}.bn{place}", width)
        return graph.conv(x, *fold_batch_norm(weight, None, *norm, _EPSILON))

    made = layer(graph.relu(layer(x, 1, wide)), 2, width)
    if number > 1:
        weight = weights.take(f"{name}.downsample.weight", (width, wide, 1, 1))
        bias = weights.take(f"{name}.downsample.bias", (width,))
        made = graph.add(made, graph.conv(x, weight, bias))
    return graph.relu(made)
