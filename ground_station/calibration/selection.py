"""Which views to calibrate with: sharp, slow, and each telling what the others do not.

Views are added one by one, each time the one that adds most to the logarithm of the determinant of
the lens's information (D-optimal design). What is far out in the picture, tilted, near or far
tells most, so that places, tilts and distances need no rules of their own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ground_station.arrays import F64, Bools, Indices
from ground_station.calibration import lens
from ground_station.calibration.detection import BoardObservation, apply_homography
from ground_station.calibration.lens import Points
from ground_station.calibration.views import View

MAX_EDGE_PX = 4.5
"""Views with wider edges are blurred: their corners are off by more than they tell."""
_BOOTSTRAP = 14
_CANDIDATES = 400
_APART_S = 0.25
_ALIKE = 0.04
"""Views whose boards lie closer together, of the picture's width, are the same view twice."""
_LEAST_GAIN = 0.05
"""Of the logarithm of the determinant; a ninth of it is one number's."""

CORNER_SHARE = 0.2
"""The outermost fifth of the width by that of the height is a corner of the picture."""
CORNERS = ("upper left", "upper right", "lower left", "lower right")


def in_corner(px: F64, size_px: tuple[int, int], name: str) -> Bools:
    """Which of (N, 2) pixels lie in that corner of the picture."""
    w, h = size_px
    across = px[:, 0] < CORNER_SHARE * w if "left" in name else px[:, 0] > (1 - CORNER_SHARE) * w
    down = px[:, 1] < CORNER_SHARE * h if "upper" in name else px[:, 1] > (1 - CORNER_SHARE) * h
    return np.asarray(across & down)


def empty_corners(seen: Sequence[BoardObservation], size_px: tuple[int, int]) -> list[str]:
    """The corners of the picture in which no corner of the board was seen."""
    px = np.concatenate([np.empty((0, 2)), *(each.px for each in seen)])
    return [name for name in CORNERS if not in_corner(px, size_px, name).any()]


def sharp(views: Sequence[View]) -> list[View]:
    """Those that are not blurred; of very many, the best known of each stretch of time."""
    kept = [view for view in views if view.seen.edge_px <= MAX_EDGE_PX]
    if len(kept) <= _CANDIDATES:
        return kept
    stretches = np.array_split(np.arange(len(kept)), _CANDIDATES)
    return [kept[min(stretch, key=lambda k: kept[k].sigma_px)] for stretch in stretches]


def spread(views: Sequence[View], size_px: tuple[int, int], outline_m: F64) -> list[int]:
    """Some views as unlike each other as can be, by place, size and perspective of the board.

    No lens is needed for it. `outline_m` (4, 2) are the board's outer corners, metres.
    """
    w, h = size_px
    reach = np.abs(outline_m).max(axis=0)
    features = []
    for view in views:
        H = view.seen.H / view.seen.H[2, 2]
        middle = apply_homography(H, outline_m.mean(axis=0)[None])[0]
        features.append(
            [middle[0] / w, middle[1] / h, 0.5 * np.log(view.seen.square_px), *(H[2, :2] * reach)]
        )
    F = np.array(features)
    F[~np.isfinite(F)] = 0
    # The best known of those with many corners first, then always the one furthest from all.
    worth = [len(view.seen.ids) / view.sigma_px for view in views]
    chosen = [int(np.argmax(worth))]
    distance = np.linalg.norm(F - F[chosen[0]], axis=1)
    known = 1 / np.array([view.sigma_px for view in views])
    while len(chosen) < min(_BOOTSTRAP, len(views)):
        best = int(np.argmax(distance * np.sqrt(known / known.max())))
        if distance[best] <= 1e-6:
            break
        chosen.append(best)
        distance = np.minimum(distance, np.linalg.norm(F - F[best], axis=1))
    return chosen


def informative(
    views: Sequence[View],
    points: Sequence[Points],
    theta: F64,
    poses: Sequence[F64],
    size_px: tuple[int, int],
    outline_m: F64,
    most: int,
) -> list[int]:
    """Up to `most` views that together tell most of the lens, at the lens and poses known so far.

    A corner of the picture that any view has seen is seen by one of these, too.
    """
    tells = np.array([lens.information(theta, p, v) for p, v in zip(poses, points, strict=True)])
    outlines = np.array([apply_homography(view.seen.H, outline_m) for view in views])
    free = np.ones(len(views), bool)
    total = np.diag(lens.weak_prior(size_px, lens.model_of(theta)))
    chosen: list[int] = []

    def take(k: int) -> None:
        nonlocal total
        chosen.append(k)
        total = total + tells[k]
        off = np.sqrt(((outlines - outlines[k]) ** 2).sum(axis=2).mean(axis=1))
        free[off < _ALIKE * size_px[0]] = False
        for j, view in enumerate(views):
            if view.seen.source == views[k].seen.source and view.velocity_px_s is not None:
                apart_s = abs(view.seen.time_ns - views[k].seen.time_ns) / 1e9
                free[j] &= apart_s >= _APART_S
        free[k] = False

    def gains(among: Indices) -> F64:
        return np.asarray(
            np.linalg.slogdet(total + tells[among])[1] - np.linalg.slogdet(total)[1], np.float64
        )

    while len(chosen) < most and free.any():
        among = np.flatnonzero(free)
        gain = gains(among)
        best = int(np.argmax(gain))
        if chosen and not gain[best] > _LEAST_GAIN:
            break
        take(int(among[best]))
    for name in CORNERS:
        within = [np.count_nonzero(in_corner(view.seen.px, size_px, name)) for view in views]
        if any(within[k] for k in chosen) or not any(within):
            continue
        among = np.flatnonzero(np.array(within) > 0)
        take(int(among[np.argmax(gains(among))]))
    return chosen
