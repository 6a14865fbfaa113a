"""SuperPoint in both layouts, and ALIKE: weights by torch's names to outputs, and made-up weights.

What they reckon is checked against torch's own modules by hand; the test needs none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from reference.operators import (
    F64,
    batch_norm,
    convolution,
    max_pool,
    relu,
    sigmoid,
    upsample_align_corners,
)

Weights = Mapping[str, npt.NDArray[Any]]

_PAIRS = ((1, 64), (64, 64), (64, 128), (128, 128))
ALIKE_SIZES = {
    "t": (8, 16, 32, 64, 64),
    "s": (8, 16, 48, 96, 96),
    "n": (16, 32, 64, 128, 128),
    "l": (32, 64, 128, 128, 128),
}


def superpoint(weights: Weights, grey: F64) -> tuple[F64, F64]:
    """Magic Leap's: logits (65, H/8, W/8) and raw descriptors (256, H/8, W/8) of grey (H, W)."""

    def layer(x: F64, name: str) -> F64:
        return convolution(x, weights[f"{name}.weight"], weights[f"{name}.bias"])

    x = grey[None]
    for pair in "1234":
        x = relu(layer(relu(layer(x, f"conv{pair}a")), f"conv{pair}b"))
        x = x if pair == "4" else max_pool(x, 2)
    return layer(relu(layer(x, "convPa")), "convPb"), layer(relu(layer(x, "convDa")), "convDb")


def superpoint_port(weights: Weights, grey: F64) -> tuple[F64, F64]:
    """The PyTorch port's: the batch is normalised after the ReLU, with TensorFlow's epsilon."""

    def block(x: F64, name: str, gate: bool = True) -> F64:
        x = convolution(x, weights[f"{name}.conv.weight"], weights[f"{name}.conv.bias"])
        return batch_norm(relu(x) if gate else x, _norm(weights, f"{name}.bn"), 1e-3)

    x = grey[None]
    for pair in range(4):
        x = block(block(x, f"backbone.{pair}.0"), f"backbone.{pair}.1")
        x = x if pair == 3 else max_pool(x, 2)
    logits = block(block(x, "detector.0"), "detector.1", gate=False)
    return logits, block(block(x, "descriptor.0"), "descriptor.1", gate=False)


def alike(weights: Weights, rgb: F64) -> tuple[F64, F64]:
    """Scores (1, H, W) and unit descriptors (D, H, W) of rgb (3, H, W), a multiple of 32."""

    def layer(x: F64, name: str, place: int) -> F64:
        x = convolution(x, weights[f"{name}.conv{place}.weight"])
        return batch_norm(x, _norm(weights, f"{name}.bn{place}"), 1e-5)

    def residual(x: F64, name: str) -> F64:
        down = f"{name}.downsample"
        same = convolution(x, weights[f"{down}.weight"], weights[f"{down}.bias"])
        return relu(layer(relu(layer(x, name, 1)), name, 2) + same)

    x = relu(layer(relu(layer(rgb, "block1", 1)), "block1", 2))
    parts = [relu(convolution(x, weights["conv1.weight"]))]
    for number, pool, scale in ((2, 2, 2), (3, 4, 8), (4, 4, 32)):
        x = residual(max_pool(x, pool), f"block{number}")
        part = relu(convolution(x, weights[f"conv{number}.weight"]))
        parts.append(upsample_align_corners(part, scale))
    x = np.concatenate(parts)
    if "convhead1.weight" in weights:
        x = relu(convolution(x, weights["convhead1.weight"]))
    head = convolution(x, weights["convhead2.weight"])
    length = np.maximum(np.linalg.norm(head[:-1], axis=0), 1e-12)
    return sigmoid(head[-1:]), head[:-1] / length


def _norm(weights: Weights, name: str) -> tuple[F64, F64, F64, F64]:
    scale, shift, mean, variance = (
        weights[f"{name}.{part}"] for part in ("weight", "bias", "running_mean", "running_var")
    )
    return scale, shift, mean, variance


class _MadeUp:
    """Weights that keep the size of what they are given, about as a trained network's do."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self.weights: dict[str, npt.NDArray[np.float32]] = {}

    def convolution(self, name: str, shape: tuple[int, ...], bias: bool = True) -> None:
        spread = np.sqrt(2 / np.prod(shape[1:]))
        self._set(f"{name}.weight", self._random.normal(0, spread, shape))
        if bias:
            self._set(f"{name}.bias", self._random.normal(0, 0.1, shape[0]))

    def norm(self, name: str, channels: int) -> None:
        self._set(f"{name}.weight", self._random.normal(1, 0.3, channels))
        self._set(f"{name}.bias", self._random.normal(0, 0.3, channels))
        self._set(f"{name}.running_mean", self._random.normal(0, 0.3, channels))
        self._set(f"{name}.running_var", self._random.uniform(0.3, 2, channels))

    def _set(self, name: str, values: F64) -> None:
        self.weights[name] = values.astype(np.float32)


def superpoint_weights(seed: int = 1) -> dict[str, npt.NDArray[np.float32]]:
    """Made-up weights of Magic Leap's layout."""
    made = _MadeUp(seed)
    for number, (wide, width) in enumerate(_PAIRS, 1):
        made.convolution(f"conv{number}a", (width, wide, 3, 3))
        made.convolution(f"conv{number}b", (width, width, 3, 3))
    for letter, channels in (("P", 65), ("D", 256)):
        made.convolution(f"conv{letter}a", (256, 128, 3, 3))
        made.convolution(f"conv{letter}b", (channels, 256, 1, 1))
    return made.weights


def superpoint_port_weights(seed: int = 1) -> dict[str, npt.NDArray[np.float32]]:
    """Made-up weights of the port's layout; a factor of a norm may be negative."""
    made = _MadeUp(seed)

    def block(name: str, shape: tuple[int, ...]) -> None:
        made.convolution(f"{name}.conv", shape)
        made.norm(f"{name}.bn", shape[0])

    for number, (wide, width) in enumerate(_PAIRS):
        block(f"backbone.{number}.0", (width, wide, 3, 3))
        block(f"backbone.{number}.1", (width, width, 3, 3))
    for head, channels in (("detector", 65), ("descriptor", 256)):
        block(f"{head}.0", (256, 128, 3, 3))
        block(f"{head}.1", (channels, 256, 1, 1))
    made.weights["backbone.0.0.bn.weight"][:5] *= -1
    return made.weights


def alike_weights(size: str, seed: int = 1) -> dict[str, npt.NDArray[np.float32]]:
    """Made-up weights of ALIKE."""
    made, wide = _MadeUp(seed), 3
    *widths, dimension = ALIKE_SIZES[size]
    for number, width in enumerate(widths, 1):
        name = f"block{number}"
        made.convolution(f"{name}.conv1", (width, wide, 3, 3), bias=False)
        made.convolution(f"{name}.conv2", (width, width, 3, 3), bias=False)
        made.norm(f"{name}.bn1", width)
        made.norm(f"{name}.bn2", width)
        if number > 1:
            made.convolution(f"{name}.downsample", (width, wide, 1, 1))
        made.convolution(f"conv{number}", (dimension // 4, width, 1, 1), bias=False)
        wide = width
    if size == "l":
        made.convolution("convhead1", (dimension, dimension, 1, 1), bias=False)
    made.convolution("convhead2", (dimension + 1, dimension, 1, 1), bias=False)
    return made.weights
