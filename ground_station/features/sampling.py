"""Descriptors at key points, from a network's map of them."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.sparse import csr_array

from ground_station.arrays import F32, I32, Bools

_A = -0.75
"""The cubic's slope; what TensorFlow, PyTorch and OpenCV interpolate with."""


def bicubic(descriptors: F32, at: F32) -> F32:
    """A map (D, h, w) at positions (N, 2), x then y in its own pixels: (N, D).

    Cubic convolution (Keys, IEEE T-ASSP 1981) over 4x4 neighbours; beyond the edge the edge's
    values go on.
    """
    base = np.floor(at)
    weight = _cubic(at - base)  # (N, 2, 4)
    step = np.arange(-1, 3)
    h, w = descriptors.shape[1:]
    x = np.clip(base[:, 0, None].astype(np.int32) + step, 0, w - 1)
    y = np.clip(base[:, 1, None].astype(np.int32) + step, 0, h - 1)
    return _weighted(
        descriptors, (y[:, :, None] * w + x[:, None, :]), weight[:, 1, :, None] * weight[:, 0, None]
    )


def bilinear(descriptors: F32, at: F32) -> F32:
    """A map (D, H, W) at positions (N, 2), x then y in its pixels: (N, D), of 2x2 neighbours."""
    h, w = descriptors.shape[1:]
    at = np.clip(at, 0, np.array([w - 1, h - 1], np.float32))
    low = np.minimum(at.astype(np.int32), np.array([w - 2, h - 2], np.int32))
    part = at - low
    flat = descriptors.reshape(len(descriptors), -1)
    place = low[:, 1] * w + low[:, 0]
    fx, fy = part[:, 0], part[:, 1]
    # The map is as large as the picture: four gathers of N are less than turning it round once.
    total = flat[:, place] * ((1 - fx) * (1 - fy))
    total += flat[:, place + 1] * (fx * (1 - fy))
    total += flat[:, place + w] * ((1 - fx) * fy)
    total += flat[:, place + w + 1] * (fx * fy)
    return np.ascontiguousarray(total.T, np.float32)


def unit(descriptors: F32) -> tuple[F32, Bools]:
    """Rows (N, D) at unit L2 norm, and which of them had one: finite and not nought (N,)."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.sqrt(np.einsum("nd,nd->n", descriptors, descriptors))
    good = np.isfinite(length) & (length > 1e-12)
    length = np.where(good, length, 1)[:, None]
    return np.asarray(descriptors / length, np.float32), good


def _cubic(t: F32) -> F32:
    """Weights of the neighbours at -1, 0, 1, 2 for the offset t (…) in 0..1: (…, 4)."""
    s = np.float32(1) - t
    return np.stack(
        [
            _A * t * s * s,
            (_A + 2) * t**3 - (_A + 3) * t**2 + 1,
            (_A + 2) * s**3 - (_A + 3) * s**2 + 1,
            _A * s * t * t,
        ],
        axis=-1,
    ).astype(np.float32)


def _weighted(descriptors: F32, place: I32, weight: F32) -> F32:
    """Sums of weight (N, …) times the descriptors at flat indices place (N, …)."""
    n = len(place)
    taps = place[0].size if n else 1
    # A product with a sparse matrix reads each neighbour's vector once, in one piece.
    table = cv2.transpose(descriptors.reshape(len(descriptors), -1))
    ends = np.arange(0, n * taps + 1, taps, dtype=np.int32)
    matrix = csr_array((weight.ravel(), place.ravel(), ends), shape=(n, len(table)))
    return np.asarray(matrix @ table, np.float32)
