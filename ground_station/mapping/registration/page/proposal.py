"""A fit of the map to the plan's walls, as the page shows it, and as picks once it is accepted."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ground_station.arrays import F64, I64
from ground_station.mapping.registration.picks import Pick
from ground_station.mapping.registration.walls import WallFit

_PLACES = 12
"""Places of the walls that an accepted fit is kept as: enough that one more changes little."""
_LANDMARKS = 30
"""Landmarks of each, as those that hold a click."""


def shown(fit: WallFit) -> dict[str, Any]:
    """The fit as plain values, the map's place on the plan as `to_plan` before and after."""

    def to_plan(a: complex, b: complex) -> list[float]:
        return [a.real, a.imag, a.imag, -a.real, b.real, b.imag]

    return {
        "before": to_plan(*fit.start),
        "after": to_plan(fit.a, fit.b),
        "residual_m": fit.residual_m,
        "start_residual_m": fit.start_residual_m,
        "on_walls": fit.on_walls,
        "ambiguous": fit.ambiguous,
    }


def wall_picks(fit: WallFit, rows: I64, flat: F64, position: F64, ids: I64) -> list[Pick]:
    """Picks of places far apart on the walls that the fit found.

    `rows` (M,) are of the landmarks that were fitted, `flat` (M, 2) of their top view; `position`
    (N, 3) and `ids` (N,) of all. Each place's pixel is where the fit puts it and, further, as far
    as its landmarks are off the drawn outline: so what walls disagree is left as the residual.
    """
    on = np.flatnonzero(fit.on)
    z = flat[on, 0] - 1j * flat[on, 1]
    w = fit.a * z + fit.b
    correction = fit.offset_px[on]
    # Where they are dense, they are of one wall: places are taken from the denser half.
    tree = cKDTree(np.stack([z.real, z.imag], axis=1))
    width = tree.query(tree.data, k=min(_LANDMARKS, len(z)))[0][:, -1]
    dense = width <= np.median(width)
    chosen = [int(np.argmax(dense * np.abs(z - z.mean())))]
    apart = dense * np.abs(z - z[chosen[0]])
    while len(chosen) < min(_PLACES, len(z)):
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.abs(z - z[chosen[-1]]))
    picks = []
    for k, at in enumerate(chosen, 1):
        near = np.argsort(np.abs(z - z[at]), kind="stable")[:_LANDMARKS]
        mine = rows[on[near]]
        pixel = (w[near] + correction[near]).mean()
        place = position[mine].mean(axis=0)
        picks.append(Pick(f"wall {k}", ids[mine], place, np.array([pixel.real, pixel.imag])))
    return picks
