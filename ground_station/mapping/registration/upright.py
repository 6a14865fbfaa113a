"""Which way is up in a map, and where its floor is: from the map itself, for picks on a plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64, I64
from ground_station.map.store import Map
from ground_station.mapping.registration.adjustment import Upright

SOURCES = ("levels", "cameras", "map")
"""Horizontal structure of the landmarks; the cameras' horizontal axes; the map's own z axis."""
_LANDMARKS = 6000
_FEWEST = 100
"""Landmarks below which there are no levels to see."""
_BINS = 400
_TRUSTED = (0.005, 0.995)
_SEARCH_DEG = ((12.0, 1.0), (1.0, 0.2), (0.2, 0.05))
"""How far levels may tilt from the cameras' axes, and the steps in which that is searched."""
_LEAST_TURN = 0.02
"""Share of the cameras' second direction: below, they all look one way, and pitch shows as tilt."""
_CAMERAS_DEG, _LEVELS_DEG, _MAP_DEG = 3.0, 0.1, 0.2
"""Standard deviations about each axis. The cameras': blimps bank, and a mount is askew in every
picture; in eleven parts of the sample they were 0.5 to 5 degrees off. The least of the levels',
which were 0.01 to 0.3 degrees off there, and 1.7 once with other landmarks drawn. The map's own,
once it is registered."""


@dataclass(frozen=True)
class Found:
    """An upward direction, its source, and the levels of floor and ceiling along it (model units).

    `heights` are the landmarks' counts in equal steps from `low` to `high`.
    """

    upright: Upright
    source: str
    ceiling: float
    low: float
    high: float
    heights: list[int]


def find_up(map_: Map, source: str | None = None) -> Found:
    """The vertical of a map by one of `SOURCES`; by default its own when it is registered.

    The cameras' horizontal axes lie in the horizontal plane when nobody rolls them: up is the
    direction across all of them, found with weights that forget the rolled ones. Levels sharpen it:
    floor, ceiling, sills and signs put many landmarks at equal heights, so the histogram of heights
    with the greatest sum of squares is that of the true vertical. Levels are looked for within 12
    degrees of the cameras' vertical.
    """
    if source is None:
        source = "map" if map_.info.registered else "levels"
    if source == "map":
        up, sigma_deg = np.array([0.0, 0.0, 1.0]), _MAP_DEG
    else:
        sigma_deg = _CAMERAS_DEG
        up = _across_cameras(map_.keyframes.wTc)
        if source == "levels" and len(map_.landmarks) < _FEWEST:
            source = "cameras"
        if source == "levels":
            up, sigma_deg = _levels(map_.landmarks.position_m, up)
    return with_up(map_, up, sigma_deg, source)


def with_up(map_: Map, up: F64, sigma_deg: float, source: str, level: float | None = None) -> Found:
    """Floor and ceiling along a given direction (3,); `level` where the floor is known, too."""
    up = up / np.linalg.norm(up)
    heights = map_.landmarks.position_m @ up
    cameras = map_.keyframes.wTc[:, :3, 3] @ up
    if not len(heights):
        heights = cameras
    low, high = (float(x) for x in np.quantile(heights, _TRUSTED))
    margin = max(0.05 * (high - low), 1e-9)
    low, high = low - margin, high + margin
    counts = np.histogram(heights, _BINS, (low, high))[0]
    step = (high - low) / _BINS
    lowest, highest = (float(x) for x in np.quantile(cameras, (0.05, 0.95)))
    floor = 0.0 if source == "map" else _level(counts, low, step, low, lowest)
    ceiling = _level(counts, low, step, highest, high)
    upright = Upright(up, float(np.radians(sigma_deg)), floor if level is None else level, 2 * step)
    return Found(upright, source, ceiling, low, high, counts.tolist())


def upright_rotation(up: F64) -> F64:
    """The rotation (3, 3) that takes a unit direction (3,) to z by the shortest way."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    if sine < 1e-12:
        return np.diag([1.0, 1.0, 1.0]) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return np.asarray(Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix())


def along_walls(positions: F64) -> F64:
    """The turn (3, 3) about z that lays a top view's walls along its axes, the longer side level.

    Walls are to x and y what floors are to heights: many landmarks (M, 3) share a coordinate.
    """
    if len(positions) < _FEWEST:
        return np.eye(3)
    flat = positions[:: max(1, len(positions) // _LANDMARKS), :2]
    low, high = np.quantile(flat, (0.05, 0.95), axis=0)
    flat = flat[((flat >= low) & (flat <= high)).all(axis=1)] - (low + high) / 2
    width = float(np.linalg.norm(high - low)) / _BINS
    if not len(flat) or width <= 0:
        return np.eye(3)
    angles = np.radians(np.arange(0.0, 90.0, 0.5))
    across = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    along = np.stack([-np.sin(angles), np.cos(angles)], axis=1)
    score = [
        _crowding(flat @ x, width) + _crowding(flat @ y, width)
        for x, y in zip(across, along, strict=True)
    ]
    best = int(np.argmax(score))
    x, y = across[best], along[best]
    if np.ptp(flat @ y) > np.ptp(flat @ x):
        x, y = y, -x
    turn = np.eye(3)
    turn[0, :2], turn[1, :2] = x, y
    return turn


def _across_cameras(wTc: F64) -> F64:
    """Up, (3,), from camera poses (K, 4, 4)."""
    across, down = wTc[:, :3, 0], wTc[:, :3, 1]
    mean = -down.mean(axis=0)
    weight = np.ones(len(across))
    up = mean
    for _ in range(10):
        moments = (across * weight[:, None]).T @ across / weight.sum()
        value, vector = np.linalg.eigh(moments)
        if value[1] < _LEAST_TURN:  # all look one way: what is left is that the horizon is level
            up = mean - (mean @ vector[:, 2]) * vector[:, 2]
            break
        up = vector[:, 0]
        tilt = across @ up
        spread = 1.4826 * float(np.median(np.abs(tilt))) + 1e-6
        weight = 1.0 / (1.0 + (tilt / (2 * spread)) ** 2)  # Cauchy's
    up = up if up @ mean > 0 else -up
    length = float(np.linalg.norm(up))
    return up / length if length > 0 else np.array([0.0, 0.0, 1.0])


def _levels(positions: F64, start: F64) -> tuple[F64, float]:
    """The vertical by the levels of landmarks (M, 3), and its deviation about an axis, degrees.

    The deviation is how far the two ends of the map, each by itself, disagree.
    """
    up = _sharpest(positions, start)
    flat = positions - np.outer(positions @ up, up)
    flat = flat - flat.mean(axis=0)
    axis = np.linalg.eigh(flat.T @ flat)[1][:, 2]
    along = flat @ axis
    far = along > np.median(along)
    one, other = _sharpest(positions[far], up), _sharpest(positions[~far], up)
    apart = float(np.degrees(np.arccos(min(1.0, float(one @ other)))))
    return up, max(apart, _LEVELS_DEG)


def _sharpest(positions: F64, start: F64) -> F64:
    """The direction near `start` along which landmarks (M, 3) share the fewest heights."""
    chosen = positions[np.linspace(0, len(positions) - 1, _LANDMARKS).astype(int)]
    if len(positions) <= _LANDMARKS:
        chosen = positions
    low, high = np.quantile(chosen, _TRUSTED, axis=0)
    chosen = chosen[((chosen >= low) & (chosen <= high)).all(axis=1)]
    chosen = chosen - chosen.mean(axis=0)
    if not len(chosen):
        return start
    width = float(np.ptp(chosen @ start)) / _BINS * 2
    if width <= 0:
        return start
    up = start
    for reach, step in _SEARCH_DEG:
        back = upright_rotation(up).T
        angles = np.radians(np.arange(-reach, reach + step / 2, step))
        best, best_score = up, -1.0
        some = chosen[:: 2 if reach > 10 else 1]
        for a in angles:
            for b in angles:
                direction = back @ np.array([np.sin(a), np.sin(b) * np.cos(a), 1.0])
                direction /= np.linalg.norm(direction)
                score = _crowding(some @ direction, width)
                if score > best_score:
                    best, best_score = direction, score
        up = best
    return up


def _crowding(heights: F64, width: float) -> float:
    """How much heights (M,) share steps of a width: the sum of squared counts, half steps apart."""
    place = (heights - heights.min()) / (width / 2)
    half = np.bincount(place.astype(np.int64))
    return float(np.sum((half[:-1] + half[1:]).astype(np.float64) ** 2))


def _level(counts: I64, start: float, step: float, low: float, high: float) -> float:
    """The height with most landmarks between two heights, of a histogram smoothed by two steps."""
    smooth = np.convolve(counts, [0.5, 1.0, 0.5], mode="same")
    middle = start + (np.arange(len(counts)) + 0.5) * step
    inside = (middle >= low) & (middle <= high)
    if not inside.any():
        return low
    return float(middle[inside][np.argmax(smooth[inside])])
