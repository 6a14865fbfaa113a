"""Which landmarks a click in the top view means."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ground_station.errors import MapError
from ground_station.mapping.registration.picks import MOST_LANDMARKS

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

_STEPS = 20


def cluster_at(positions: F64, click: F64, radius: float, low: float, high: float) -> I64:
    """Rows of the landmarks (M, 3), z up, around the place to which a click (2,) is drawn.

    Of those between the heights `low` and `high`: mean shift with a flat kernel of `radius`
    (Comaniciu and Meer, "Mean shift: a robust approach toward feature space analysis", PAMI 24,
    2002), so that a click beside a pillar means the pillar. Raises `MapError` where there are none.
    """
    shown = np.flatnonzero((positions[:, 2] >= low) & (positions[:, 2] <= high))
    flat = positions[shown, :2]
    place, inside = click, np.zeros(len(flat), dtype=bool)
    for _ in range(_STEPS):
        now = np.sum((flat - place) ** 2, axis=1) <= radius**2
        if not now.any():
            raise MapError("there are no landmarks at this place; zoom in, or show more heights")
        if (now == inside).all():
            break
        inside, place = now, flat[now].mean(axis=0)
    rows = shown[inside]
    if len(rows) > MOST_LANDMARKS:
        near = np.argsort(np.sum((positions[rows, :2] - place) ** 2, axis=1), kind="stable")
        rows = np.sort(rows[near[:MOST_LANDMARKS]])
    return rows
