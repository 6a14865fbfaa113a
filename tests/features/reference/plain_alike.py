"""ALIKE's key points and descriptors (Zhao et al., IEEE T-MM 2022) as plain loops, float64."""

from __future__ import annotations

import math

import numpy as np


def soft_argmax(
    scores: np.ndarray, row: int, column: int, radius: int, temperature: float
) -> tuple[float, float]:
    """x, y: the mean of the places in the window, by exp((s - s_max) / T)."""
    window = [
        (float(scores[j, i]), i, j)
        for j in range(row - radius, row + radius + 1)
        for i in range(column - radius, column + radius + 1)
    ]
    highest = max(score for score, _, _ in window)
    total = x = y = 0.0
    for score, i, j in window:
        weight = math.exp((score - highest) / temperature)
        total += weight
        x += weight * i
        y += weight * j
    return x / total, y / total


def descriptor(descriptors: np.ndarray, x: float, y: float) -> np.ndarray:
    """The map (D, H, W) at pixel x, y, bilinearly. Not normalised."""
    i, j = math.floor(x), math.floor(y)
    fx, fy = x - i, y - j
    return (
        descriptors[:, j, i] * (1 - fx) * (1 - fy)
        + descriptors[:, j, i + 1] * fx * (1 - fy)
        + descriptors[:, j + 1, i] * (1 - fx) * fy
        + descriptors[:, j + 1, i + 1] * fx * fy
    )
