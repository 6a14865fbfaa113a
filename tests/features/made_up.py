"""Models with made-up weights, which need no training and whose answers can be told."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ground_station.feature_models.graph import Graph
from ground_station.features.model_info import ModelInfo


def info(name: str = "made-up", layout: str = "cells", **changes: object) -> ModelInfo:
    """A model's metadata."""
    values = {
        "name": name,
        "layout": layout,
        "dimension": 16,
        "multiple": 8,
        "licence": "none",
        "source": "made up for a test",
    }
    return ModelInfo(**(values | changes))


def drawn(rng: np.random.Generator, out: int, into: int, size: int) -> np.ndarray:
    """A convolution's weights that keep values about as large as they were."""
    scale = np.sqrt(2 / (into * size * size))
    return rng.normal(0, scale, (out, into, size, size)).astype(np.float32)


def write_cells(
    folder: Path, about: ModelInfo, widths: tuple[int, ...] = (8, 12, 16), seed: int = 0
) -> Path:
    """A small network of layout `cells`, of three halving stages and two heads."""
    rng = np.random.default_rng(seed)
    graph = Graph(about.name)
    x, channels = graph.input("image", 1), 1
    for width in widths:
        x = graph.relu(graph.conv(x, drawn(rng, width, channels, 3)))
        x, channels = graph.max_pool(x, 2), width
    graph.output(graph.conv(x, 4 * drawn(rng, 65, channels, 1)), "logits", 65)
    out = graph.conv(x, drawn(rng, about.dimension, channels, 1))
    graph.output(out, "descriptors", about.dimension)
    path = folder / f"{about.name}.onnx"
    graph.save(path, about)
    return path


def write_pixels(folder: Path, about: ModelInfo, seed: int = 0) -> Path:
    """A small network of layout `pixels`: two convolutions, a score and a descriptor a pixel."""
    rng = np.random.default_rng(seed)
    graph = Graph(about.name)
    x = graph.relu(graph.conv(graph.input("image", 3), drawn(rng, 8, 3, 3)))
    graph.output(graph.sigmoid(graph.conv(x, 3 * drawn(rng, 1, 8, 3))), "scores", 1)
    out = graph.conv(x, drawn(rng, about.dimension, 8, 3))
    graph.output(out, "descriptors", about.dimension)
    path = folder / f"{about.name}.onnx"
    graph.save(path, about)
    return path


def write_blobs(folder: Path, about: ModelInfo, seed: int = 0) -> Path:
    """A small network of layout `blobs`: two halving stages, details, a third, the other heads."""
    rng = np.random.default_rng(seed)
    graph = Graph(about.name)
    x = graph.max_pool(graph.relu(graph.conv(graph.input("image", 1), drawn(rng, 8, 1, 3))), 4)
    graph.output(graph.conv(x, drawn(rng, about.details, 8, 3)), "details", about.details)
    x = graph.max_pool(graph.relu(graph.conv(x, drawn(rng, 12, 8, 3))), 2)
    rest = about.dimension - about.details
    graph.output(graph.conv(x, drawn(rng, rest, 12, 1)), "descriptors", rest)
    graph.output(graph.conv(x, drawn(rng, 1, 12, 1)), "worth", 1)
    path = folder / f"{about.name}.onnx"
    graph.save(path, about)
    return path
