"""SuperPoint's post-processing (DeTone et al., CVPR-W 2018) as plain loops, float64."""

from __future__ import annotations

import math

import numpy as np


def scores(logits: np.ndarray) -> np.ndarray:
    """Logits (65, h, w) to scores (8h, 8w): softmax over a cell's channels, "none" left out."""
    _, h, w = logits.shape
    result = np.zeros((8 * h, 8 * w))
    for row in range(h):
        for column in range(w):
            cell = [float(value) for value in logits[:, row, column]]
            highest = max(cell)
            total = sum(math.exp(value - highest) for value in cell)
            for k in range(64):
                place = 8 * row + k // 8, 8 * column + k % 8
                result[place] = math.exp(cell[k] - highest) / total
    return result


def greedy(
    scores: np.ndarray, radius: int, threshold: float, border: int, most: int
) -> list[tuple[int, int]]:
    """Rows and columns of the strongest: sorted, each one kept drops its neighbours."""
    height, width = scores.shape
    points = [
        (-float(scores[row, column]), row, column)
        for row in range(height)
        for column in range(width)
        if scores[row, column] > threshold
    ]
    dropped: set[tuple[int, int]] = set()
    kept = []
    for _, row, column in sorted(points):
        if (row, column) in dropped:
            continue
        for y in range(row - radius, row + radius + 1):
            for x in range(column - radius, column + radius + 1):
                dropped.add((y, x))
        if border <= row < height - border and border <= column < width - border:
            kept.append((row, column))
    return kept[:most]


def cubic(t: float) -> float:
    """Keys's kernel at distance t with a = -0.75."""
    a, t = -0.75, abs(t)
    if t <= 1:
        return (a + 2) * t**3 - (a + 3) * t**2 + 1
    if t < 2:
        return a * t**3 - 5 * a * t**2 + 8 * a * t - 4 * a
    return 0.0


def descriptor(descriptors: np.ndarray, x: float, y: float) -> np.ndarray:
    """The map (D, h, w) at cell position x, y, not normalised; the edge goes on beyond it."""
    _, h, w = descriptors.shape
    result = np.zeros(len(descriptors))
    for row in range(math.floor(y) - 1, math.floor(y) + 3):
        for column in range(math.floor(x) - 1, math.floor(x) + 3):
            weight = cubic(y - row) * cubic(x - column)
            inside = min(max(row, 0), h - 1), min(max(column, 0), w - 1)
            result += weight * descriptors[:, inside[0], inside[1]]
    return result


def expected_place(scores: np.ndarray, row: int, column: int, radius: int) -> tuple[float, float]:
    """x, y: the mean of the places in the window, by their scores."""
    total = x = y = 0.0
    for j in range(row - radius, row + radius + 1):
        for i in range(column - radius, column + radius + 1):
            if 0 <= j < scores.shape[0] and 0 <= i < scores.shape[1]:
                total += scores[j, i]
                x += scores[j, i] * i
                y += scores[j, i] * j
    return x / total, y / total
