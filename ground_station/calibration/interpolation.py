"""Polynomials through a few frames: where things were between them, and how fast."""

from __future__ import annotations

import numpy as np

from ground_station.arrays import F64


def lagrange(nodes_s: F64, times_s: F64) -> tuple[F64, F64]:
    """Lagrange's polynomials of M nodes at N times (N, M), and their derivatives (N, M)."""
    m = len(nodes_s)
    off = times_s[:, None] - nodes_s  # (N, M)
    values, slopes = np.empty_like(off), np.zeros_like(off)
    for k in range(m):
        others = [j for j in range(m) if j != k]
        scale = 1 / np.prod(nodes_s[k] - nodes_s[others])
        values[:, k] = off[:, others].prod(axis=1) * scale
        for i in others:
            slopes[:, k] += off[:, [j for j in others if j != i]].prod(axis=1) * scale
    return values, slopes
