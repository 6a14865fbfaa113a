"""What the page offers: what near a click could be meant, and a fit to the walls as picks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ground_station.arrays import F64, I64
from ground_station.errors import MapError
from ground_station.mapping.registration.picks import MOST_LANDMARKS, Pick
from ground_station.mapping.registration.walls import WallFit

_STEPS = 20
_ANCHORS = 30
"""Landmarks that hold a click: their middle is known ten times better than one of them."""
_WINDOW = 6.0
"""How far wall lines are looked for, in radii of a click."""
_ANGLES = 90
_ACROSS_DEG = 30.0
"""Two lines that meet at less have no corner that a person would click."""
_BINS = 48
_ROUND = 0.5
"""Lesser over greater extent of a pillar's landmarks; a wall's lie along it."""
_LENGTH = 6
"""Half radii of a line that have landmarks: a wall's arm has up to ten, a pillar one or two."""
_CROWDED = 5.0
"""Poisson deviations by which a wall has more landmarks than its surroundings."""


@dataclass(frozen=True)
class Offer:
    """A place (2,) of the top view that a click may have meant: a corner or a pillar."""

    what: str
    place: F64


def anchors_at(positions: F64, click: F64, low: float, high: float) -> I64:
    """Rows of the landmarks (M, 3), z up, next to a click (2,), between two heights.

    They hold the click where it is when the map moves. Raises `MapError` for a click that is
    further from all of them than they are from each other.
    """
    shown = np.flatnonzero((positions[:, 2] >= low) & (positions[:, 2] <= high))
    flat = positions[shown, :2]
    apart = np.linalg.norm(flat - click, axis=1)
    if not len(flat) or not apart.min() <= np.linalg.norm(np.ptp(flat, axis=0)):
        raise MapError("there are no landmarks at this place; zoom in, or show more heights")
    return np.sort(shown[np.argsort(apart, kind="stable")[:_ANCHORS]])


def offer_at(positions: F64, click: F64, radius: float, low: float, high: float) -> Offer | None:
    """What within `radius` of a click (2,) it may have meant: where two walls meet, or a pillar.

    A place along one wall is nothing to be drawn to: every other one of it is as good.
    """
    shown = positions[(positions[:, 2] >= low) & (positions[:, 2] <= high), :2]
    corner = _corner(shown, click, radius)
    if corner is not None:
        return Offer("corner", corner)
    try:
        rows = cluster_at(positions, click, radius, low, high)
    except MapError:
        return None
    middle = positions[rows, :2].mean(axis=0)
    if len(rows) < _ANCHORS // 2 or np.linalg.norm(middle - click) > radius:
        return None
    extent = np.linalg.svd(positions[rows, :2] - middle, compute_uv=False)
    # A pillar stands free: around it there are fewer.
    ring = np.linalg.norm(shown - middle, axis=1)
    outside = np.sum((ring > radius) & (ring <= 2 * radius)) / 3
    if extent[1] < _ROUND * extent[0] or outside > len(rows) / 2:
        return None
    return Offer("pillar", middle)


def _corner(flat: F64, click: F64, radius: float) -> F64 | None:
    """Where the two most crowded lines of landmarks (M, 2) near a click meet, if near it."""
    apart = np.linalg.norm(flat - click, axis=1)
    # Walls go on beyond the radius; through a pillar within it, any two lines would pass.
    near = flat[(apart > radius) & (apart <= _WINDOW * radius)] - click
    first = _line(near, radius, None)
    if first is None:
        return None
    second = _line(near[np.abs(near @ first[:2] - first[2]) > radius / 2], radius, first[:2])
    if second is None:
        return None
    meet = np.linalg.solve(np.array([first[:2], second[:2]]), [first[2], second[2]])
    return click + meet if np.linalg.norm(meet) <= radius else None


def _line(near: F64, radius: float, other: F64 | None) -> F64 | None:
    """The most crowded line n·x = d through landmarks (M, 2) as (3,); it passes near the origin."""
    if len(near) < _ANCHORS:
        return None
    angle = np.pi * np.arange(_ANGLES) / _ANGLES
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if other is not None:
        normals = normals[np.abs(normals @ other) < np.cos(np.radians(_ACROSS_DEG))]
    width = 2 * _WINDOW * radius / _BINS
    best, most = None, 0
    for normal in normals:
        counts = np.bincount(
            np.clip(((near @ normal) / width + _BINS / 2).astype(int), 0, _BINS - 1),
            minlength=_BINS,
        )
        reach = int(np.ceil(radius / width))
        middle = slice(_BINS // 2 - reach, _BINS // 2 + reach)
        k = int(np.argmax(counts[middle])) + middle.start
        if counts[k] > most:
            best, most = np.array([*normal, (k + 0.5 - _BINS / 2) * width]), int(counts[k])
    background = len(near) / _BINS
    if best is None or most < background + _CROWDED * np.sqrt(background + 1):
        return None
    for _ in range(5):  # least squares across the line, of what lies on it
        on = near[np.abs(near @ best[:2] - best[2]) <= width]
        middle_m = on.mean(axis=0)
        normal = np.linalg.svd(on - middle_m, full_matrices=False)[2][-1]
        best = np.array([*normal, normal @ middle_m])
    on = near[np.abs(near @ best[:2] - best[2]) <= width]
    along = np.unique(np.floor(on @ [-best[1], best[0]] / (radius / 2)))
    return best if len(along) >= _LENGTH else None


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
