"""From key points to what the detector is to say: a distribution over each cell's pixels.

SuperPoint (DeTone et al., CVPR-W 2018, section 3.4) labels one pixel of a cell; here a point's
weight is shared among the four pixels around it, so that its fraction of a pixel can be learned.
"""

from __future__ import annotations

import numpy as np

from ground_station.arrays import F32
from ground_station.training.topology import CELL_PX, LOGITS


def confidence(scores: F32, low: float, high: float) -> F32:
    """The teacher's scores (N,) as chances that a point is one: a ramp from `low` to `high`."""
    return np.asarray(np.clip((scores - low) / (high - low), 0, 1), np.float32)


def soft_cells(points_px: F32, chances: F32, shape: tuple[int, int]) -> F32:
    """Labels (65, H/8, W/8) of points (N, 2), x then y, px, for a picture of `shape` (H, W).

    Channel k < 64 is pixel (k // 8, k % 8) of the cell, 64 is "none"; each cell sums to 1. Points
    out of the picture are left out; weight that falls on pixels beyond its edge is lost.
    """
    rows, columns = shape
    mass = np.zeros(rows * columns, np.float32)
    base = np.floor(points_px).astype(np.int64)
    part = points_px - base
    for dy in (0, 1):
        for dx in (0, 1):
            x, y = base[:, 0] + dx, base[:, 1] + dy
            inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
            share = np.where(dx, part[:, 0], 1 - part[:, 0])
            share = share * np.where(dy, part[:, 1], 1 - part[:, 1]) * chances
            np.add.at(mass, (y * columns + x)[inside], share[inside].astype(np.float32))
    h, w = rows // CELL_PX, columns // CELL_PX
    cells = mass.reshape(h, CELL_PX, w, CELL_PX).transpose(1, 3, 0, 2).reshape(-1, h, w)
    total = cells.sum(axis=0)
    result = np.empty((LOGITS, h, w), np.float32)
    result[:-1] = cells / np.maximum(total, 1)
    result[-1] = np.maximum(1 - total, 0)
    return result
