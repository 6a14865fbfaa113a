"""Made-up models for the tests of training: a teacher of ALIKE's layout, and weights for export."""

from pathlib import Path

import numpy as np

from ground_station.feature_models.graph import Graph
from ground_station.features.model_info import ModelInfo
from ground_station.training.topology import Shape, layers


def teacher(path: Path, seed: int = 0) -> str:
    """A network of layout `pixels` built as ALIKE is: parts of three sizes under one head.

    Its scores answer to contrast, so that it finds points on any picture.
    """
    rng = np.random.default_rng(seed)
    graph = Graph("made-up")
    image = graph.input("image", 3)
    sharp = np.full((4, 3, 5, 5), -1 / 25, np.float32)
    sharp[:, :, 2, 2] += 1
    sharp *= np.array([6, -6, 3, -3], np.float32)[:, None, None, None]
    parts = [graph.relu(graph.conv(image, sharp))]
    for scale in (2, 8):
        small = graph.max_pool(image, scale)
        weight = rng.standard_normal((4, 3, 1, 1)).astype(np.float32)
        parts.append(graph.resize_bilinear(graph.relu(graph.conv(small, weight)), scale, True))
    x = graph.concat(parts)
    head = np.concatenate([np.full((1, 4, 1, 1), 2.0), np.full((1, 8, 1, 1), -0.3)], axis=1)
    graph.output(graph.sigmoid(graph.conv(x, head)), "scores", 1)
    weight = rng.standard_normal((8, 12, 1, 1)).astype(np.float32)
    graph.output(graph.l2_normalize(graph.conv(x, weight)), "descriptors", 8)
    graph.save(path, ModelInfo("made-up", "pixels", 8, 32, "none", "a test", 2, 0.2, 2))
    return str(path)


def weights(shape: Shape, seed: int = 0) -> dict[str, np.ndarray]:
    """Random weights of a shape, about as large as a start of training's."""
    rng = np.random.default_rng(seed)
    made: dict[str, np.ndarray] = {}
    for layer in layers(shape):
        n, m, k = layer.channels_out, layer.channels_in, layer.size
        made[f"{layer.name}.weight"] = rng.normal(0, (2 / (m * k * k)) ** 0.5, (n, m, k, k))
        if layer.norm:
            made[f"{layer.name}.norm.weight"] = rng.uniform(0.5, 1.5, n)
            made[f"{layer.name}.norm.bias"] = rng.normal(0, 0.2, n)
            made[f"{layer.name}.norm.mean"] = rng.normal(0, 0.2, n)
            made[f"{layer.name}.norm.var"] = rng.uniform(0.5, 2, n)
        else:
            made[f"{layer.name}.bias"] = rng.normal(0, 0.2, n)
    return {name: value.astype(np.float32) for name, value in made.items()}
