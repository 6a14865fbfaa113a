"""Fits a map's upright structure to the walls of a floor plan, from a rough start.

Landmarks seen from above lie on walls, pillars and furniture, which a plan draws in black. The
similarity of the floor plane that brings most of them onto the drawn outlines is found as in the
registration of edges to a distance field (Fitzgibbon, "Robust registration of 2D and 3D point
sets", Image and Vision Computing 21, 2003): robust least squares over interpolated distances.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from ground_station.arrays import F64, U8, Bools
from ground_station.errors import MapError
from ground_station.mapping.registration.plan import Plan

C128 = npt.NDArray[np.complex128]

_OCCUPIED = 0.35 * 255
"""What is darker is occupied: map_server's default threshold of 0.65."""
_LANDMARKS, _FEW = 2000, 300
_FEWEST = 100
_ROUGH = 0.1
"""How far off rough clicks may be, of the distance between the two farthest."""
_FINEST_PX = 2.0
"""The last width of the robust loss: a drawn line's own."""
_STARTS = 5
"""Offsets tried along each axis of each of the two clicks that span the start."""
_REFINED = 5
_LEAST_ON_WALLS = 0.3
"""Share of landmarks that must end on a drawn outline; by chance a tenth or less do."""
_ALIKE = 0.9
"""Another place with so much of the best one's score is as good."""
_APART = 5.0
"""And is another one when it lies further off than this many residuals."""
_SLIDES = 0.01
"""Least share of what walls hold along their best direction that must hold the worst one."""


@dataclass(frozen=True)
class WallFit:
    """w = a z + b takes complex top-view coordinates z to pixels of the plan, right and down.

    `start` is the rough (a, b). `residual_m` is the root of the mean squared distance to outlines
    of those landmarks, `on_walls` of all, that lie within two of the loss's widths of one;
    `start_residual_m` is that of the same landmarks at the start. `on` (M,) says which,
    and `offset_px` (M,) how far each is from the nearest edge, right and down.
    `ambiguous` says in words what leaves the place open; empty where nothing does.
    """

    a: complex
    b: complex
    start: tuple[complex, complex]
    residual_m: float
    start_residual_m: float
    on_walls: float
    on: Bools
    offset_px: C128
    ambiguous: str


class _Field:
    """Signed distances, pixels, to the edges of what a plan draws, negative inside, and slopes."""

    def __init__(self, image: U8, cameras: C128) -> None:
        occupied = (image < _OCCUPIED).astype(np.uint8)
        if not occupied.any() or occupied.all():
            raise MapError("the plan draws nothing in black: there are no walls to fit to")
        # Walls are seen from within: without this, a thick one's far side fits nearly as well.
        rooms = np.asarray(cv2.connectedComponents(1 - occupied, connectivity=4)[1])
        u, v = np.rint(cameras.real).astype(int), np.rint(cameras.imag).astype(int)
        height, width = image.shape
        there = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        flown = np.setdiff1d(rooms[v[there], u[there]], [0])
        if len(flown):
            occupied = (~np.isin(rooms, flown)).astype(np.uint8)
        inside, outside = (
            np.asarray(cv2.distanceTransform(part, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float64)
            for part in (occupied, 1 - occupied)
        )
        # Between centres of pixels: the edge lies half a pixel from both its sides.
        self.distance: F64 = np.where(occupied > 0, 0.5 - inside, outside - 0.5)
        self.slope_u = np.asarray(np.gradient(self.distance, axis=1), np.float64)
        self.slope_v = np.asarray(np.gradient(self.distance, axis=0), np.float64)

    def signed(self, w: C128) -> F64:
        """At pixels (N,); outside of the plan they are those at its border."""
        return _sample(self.distance, w)

    def at(self, w: C128) -> F64:
        """Distances without their sign."""
        return np.abs(self.signed(w))

    def slopes(self, w: C128) -> F64:
        """Unit directions (N, 2) of growing distance."""
        slope = np.stack([_sample(self.slope_u, w), _sample(self.slope_v, w)], axis=1)
        return np.asarray(slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9))


def fit_walls(flat: F64, cameras: F64, picked: F64, picked_px: F64, plan: Plan) -> WallFit:
    """The fit of landmarks (M, 2) of the top view from two or more picks (P, 2) on the plan (P, 2).

    Only walls count that face the rooms in which `cameras` (K, 2) lie by these picks.
    Raises `MapError` for fewer than two picks, too few landmarks, a plan without a scale or walls,
    and where no place near the clicks puts the landmarks onto the walls.
    """
    if plan.scale is None:
        raise MapError("the floor plan has no scale: set it first")
    if len(picked) < 2:
        raise MapError(f"{len(picked)} picks; two or more, far apart, are where the fit begins")
    if len(flat) < _FEWEST:
        raise MapError(f"{len(flat)} landmarks at these heights; at least {_FEWEST} are needed")
    some = flat[:: max(1, len(flat) // _LANDMARKS)]
    # The plan's v grows downwards, so the top view is conjugated: a similarity keeps its hand.
    z, zp, wp = _complex(some).conj(), _complex(picked).conj(), _complex(picked_px)
    a, b = _similarity(zp, wp)
    field = _Field(plan.image, a * _complex(cameras).conj() + b)
    i, j = np.unravel_index(np.argmax(np.abs(zp[:, None] - zp[None])), (len(zp), len(zp)))
    ends, reach = zp[[i, j]], _ROUGH * abs(a * (zp[i] - zp[j]))
    found = [_refine(field, z, *start, reach) for start in _starts(field, z, (a, b), ends, reach)]
    found.sort(key=lambda one: -_score(field, z, *one))
    best = found[0]
    distance = field.at(best[0] * z + best[1])
    on = distance <= 2 * _FINEST_PX
    share = float(on.mean())
    if share < _LEAST_ON_WALLS:
        raise MapError(
            f"near the clicks only {share:.0%} of the landmarks come to lie on walls of the plan "
            f"(needed: {_LEAST_ON_WALLS:.0%}): click more exactly, or narrow the heights to walls"
        )
    metres = plan.scale.resolution_m
    residual_px = float(np.sqrt(np.mean(distance[on] ** 2)))
    started = float(np.sqrt(np.mean(field.at(a * z[on] + b) ** 2)))
    everywhere = best[0] * _complex(flat).conj() + best[1]
    slope = field.slopes(everywhere)
    return WallFit(
        complex(best[0]),
        complex(best[1]),
        (a, b),
        metres * residual_px,
        metres * started,
        share,
        field.at(everywhere) <= 2 * _FINEST_PX,
        _complex(-field.signed(everywhere)[:, None] * slope),
        _ambiguous(field, z, on, found, residual_px, metres),
    )


def _starts(
    field: _Field, z: C128, rough: tuple[complex, complex], ends: C128, reach: float
) -> list[tuple[complex, complex]]:
    """The best of the places that the two farthest clicks leave, each off by up to `reach`."""
    step = np.linspace(-reach, reach, _STARTS)
    moves = (step[:, None] + 1j * step[None]).ravel()
    some = z[:: max(1, len(z) // _FEW)]
    target = rough[0] * ends + rough[1]
    tried = []
    for one in moves:
        for other in moves:
            a = (target[1] + other - target[0] - one) / (ends[1] - ends[0])
            b = target[0] + one - a * ends[0]
            cost = np.minimum(field.at(a * some + b), reach / 2).mean()
            tried.append((float(cost), complex(a), complex(b)))
    tried.sort(key=lambda each: each[0])
    return [rough, *((a, b) for _, a, b in tried[:_REFINED])]


def _refine(
    field: _Field, z: C128, a: complex, b: complex, reach: float
) -> tuple[complex, complex]:
    """From (a, b) to the least robust cost, with a loss that narrows from `reach` to a line's."""
    middle = z.mean()
    size = float(np.sqrt(np.mean(np.abs(z - middle) ** 2)))
    # Of a turn and a growth, and a shift, each in pixels where the landmarks are.
    unit = (z - middle) * a / (abs(a) * size)
    fixed = a * z + b

    def moved(x: F64) -> C128:
        return np.asarray(fixed + (x[0] + 1j * x[1]) * unit + (x[2] + 1j * x[3]))

    def jacobian(x: F64) -> F64:
        return _jacobian(field, moved(x), unit)

    x, width = np.zeros(4), max(reach / 2, _FINEST_PX)
    while True:
        x = least_squares(
            lambda x: field.signed(moved(x)), x, jacobian, loss="cauchy", f_scale=width, max_nfev=30
        ).x
        if width <= _FINEST_PX:
            break
        width = max(width / 2, _FINEST_PX)
    grown = a + (x[0] + 1j * x[1]) * a / (abs(a) * size)
    return grown, b + (a - grown) * middle + (x[2] + 1j * x[3])


def _jacobian(field: _Field, w: C128, unit: C128) -> F64:
    n = field.slopes(w)
    along = unit.real, unit.imag
    return np.stack(
        [
            n[:, 0] * along[0] + n[:, 1] * along[1],
            -n[:, 0] * along[1] + n[:, 1] * along[0],
            n[:, 0],
            n[:, 1],
        ],
        axis=1,
    )


def _ambiguous(
    field: _Field,
    z: C128,
    on: Bools,
    found: list[tuple[complex, complex]],
    residual_px: float,
    metres: float,
) -> str:
    """In words, another place that is as good, or a direction in which nothing holds the map."""
    a, b = found[0]
    best = _score(field, z, a, b)
    for other_a, other_b in found[1:]:
        off = float(np.sqrt(np.mean(np.abs((other_a - a) * z + other_b - b) ** 2)))
        if (
            off > _APART * max(residual_px, 1)
            and _score(field, z, other_a, other_b) > _ALIKE * best
        ):
            return (
                f"another place, {metres * off:.2f} m off, fits as well: rows of equal bays do so"
            )
    middle = z.mean()
    unit = (z - middle) * a / np.sqrt(np.mean(np.abs(a * (z - middle)) ** 2))
    J = _jacobian(field, (a * z + b)[on], unit[on])
    value, vector = np.linalg.eigh(J.T @ J)
    if value[0] >= _SLIDES * value[-1]:
        return ""
    turn, grow = np.abs(vector[[1, 0], 0])
    what = "it may slide along its walls" if max(turn, grow) < 0.5 else "its size or turn is open"
    return f"the walls do not hold the map: {what}; click where walls end, too"


def _score(field: _Field, z: C128, a: complex, b: complex) -> float:
    """How much of the landmarks lies on edges, as a normal distribution of the finest width has it.

    A count within a band would call a place that is off by half a wall nearly as good.
    """
    return float(np.mean(np.exp(-0.5 * (field.signed(a * z + b) / _FINEST_PX) ** 2)))


def _similarity(z: C128, w: C128) -> tuple[complex, complex]:
    dz, dw = z - z.mean(), w - w.mean()
    squares = float(np.vdot(dz, dz).real)
    if not squares > 0 or not np.abs(dw).max() > 0:
        raise MapError("the picks are in one place: two, far apart, are where the fit begins")
    a = complex(np.vdot(dz, dw) / squares)
    return a, complex(w.mean() - a * z.mean())


def _complex(places: F64) -> C128:
    return np.asarray(places[:, 0] + 1j * places[:, 1])


def _sample(field: F64, w: C128) -> F64:
    return np.asarray(map_coordinates(field, [w.imag, w.real], order=1, mode="nearest"))
