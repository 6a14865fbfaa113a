"""The operators of the networks, each from its definition; arrays are (C, H, W) float64."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


def convolution(x: F64, weight: F64, bias: F64 | None = None) -> F64:
    """Cross-correlation with weight (out, in, k, k), zeros around, stride 1."""
    size = weight.shape[2]
    reach = size // 2
    height, width = x.shape[1:]
    padded = np.pad(np.asarray(x, np.float64), ((0, 0), (reach, reach), (reach, reach)))
    result = np.zeros((len(weight), height, width))
    for row in range(size):
        for column in range(size):
            shifted = padded[:, row : row + height, column : column + width]
            part = np.asarray(weight[:, :, row, column], np.float64)
            result += np.tensordot(part, shifted, axes=(1, 0))
    return result if bias is None else result + np.asarray(bias, np.float64)[:, None, None]


def relu(x: F64) -> F64:
    return np.maximum(x, 0)


def sigmoid(x: F64) -> F64:
    return 1 / (1 + np.exp(-x))


def max_pool(x: F64, size: int) -> F64:
    channels, height, width = x.shape
    return x.reshape(channels, height // size, size, width // size, size).max(axis=(2, 4))


def batch_norm(x: F64, norm: tuple[F64, F64, F64, F64], epsilon: float) -> F64:
    """By scale, shift, mean and variance, each (C,)."""
    scale, shift, mean, variance = (np.asarray(v, np.float64)[:, None, None] for v in norm)
    return (x - mean) / np.sqrt(variance + epsilon) * scale + shift


def upsample_align_corners(x: F64, factor: int) -> F64:
    """Bilinear; the outermost pixels of both pictures have one place."""
    for axis in (1, 2):
        size = x.shape[axis]
        at = np.arange(size * factor) * (size - 1) / (size * factor - 1)
        low = np.minimum(at.astype(int), max(size - 2, 0))
        high = np.minimum(low + 1, size - 1)
        share = (at - low).reshape((-1, 1) if axis == 1 else (1, -1))
        x = np.take(x, low, axis) * (1 - share) + np.take(x, high, axis) * share
    return x
