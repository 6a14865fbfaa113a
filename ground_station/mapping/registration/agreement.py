"""Whether a trajectory is of the flight that a map was built from: what its poses must show.

A similarity has seven parameters and always fits somehow: smooth paths that have nothing to do with
each other can agree by four fifths of their spread. So a fit counts only when it leaves little of
the path's spread, and of how far the camera turns. Simulated flights in three buildings, a real
kitchen, a corridor and two desks, each fitted to others by all poses (258 pairs), left 12 % or more
of the path, 70 % at the median.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64, I64, Bools
from ground_station.errors import GeometryError
from ground_station.geometry import poses
from ground_station.geometry.alignment import align
from ground_station.geometry.trajectory import Trajectory
from ground_station.map.uncertainty import Uncertainty
from ground_station.mapping.registration.pose_similarity import Offset, Positions

MOST_SCATTER = 0.1
"""Scatter of positions over the spread of their path, each along one axis."""
_MOST_TURN = np.sqrt(0.1)
"""Scatter of orientations over how far both cameras turn: one in ten of the squares."""
_STEADY_DEG = 3.0
"""Total scatter that an attitude estimate good to 1.7 degrees an axis has: no disagreement, and,
where the camera turns no further than that, no agreement."""
_MOST_LEFT_OUT = 0.25
"""Share of poses that a robust fit may leave out; half would let two halves of a path disagree."""
_FASTEST_M_S = 50.0
"""No camera that a map of a building is made with flies at 180 km/h; in millimetres all do."""
_BETTER = 0.5
"""A known mistake explains a fit that is twice as good without it."""
_LEAST_SHIFT_NS = 10_000_000
"""As far as a pose may be off its keyframe's time."""
_SHIFTS, _FINE = 200, 20
_FEWEST = 10
"""Positions below which one more or less decides what a fit leaves."""


@dataclass(frozen=True)
class Fitted:
    """What a fit of matched poses left: the positions `used`, their `scatter_m` along an axis.

    `offset` is of the orientations of the matched poses of `model` and `truth` (N, 4, 4).
    """

    used: Positions
    scatter_m: float
    offset: Offset
    model: F64
    truth: F64


def most_agree(alike: Bools) -> bool:
    """Whether of all poses (N,) no more lie far off the others than a robust fit may leave out."""
    return bool(np.mean(~alike) <= _MOST_LEFT_OUT)


def disagreement(found: Fitted) -> str:
    """What shows that the poses are not of the map's flight; empty where nothing does."""
    used, n = len(found.used.source), len(found.model)
    spread_m = found.used.spread_m()
    allowed_m = MOST_SCATTER * spread_m
    if found.scatter_m > allowed_m:
        return (
            "the map has not the shape of the trajectory: its keyframes scatter "
            f"{found.scatter_m:.3g} m an axis about a path that spreads {spread_m:.3g} m "
            f"(allowed: {allowed_m:.3g} m)"
        )
    if n - used > _MOST_LEFT_OUT * n:
        return (
            f"{n - used} of {n} positions lie far off where the others agree (allowed: a quarter): "
            "the trajectory jumps, or parts of the map do"
        )
    turn = np.hypot(_turning_deg(found.model), _turning_deg(found.truth))
    offset = found.offset
    measured = _turning_deg(found.truth) > np.degrees(1e-3)
    if measured and offset.scatter_deg > _STEADY_DEG:
        if offset.scatter_deg > _MOST_TURN * turn:
            return (
                f"the orientations scatter {offset.scatter_deg:.1f} deg about the camera's, of "
                f"{turn:.1f} deg that both turn (allowed: {_MOST_TURN * turn:.1f} deg)"
            )
        if offset.share < 1 - _MOST_LEFT_OUT:
            return (
                f"{1 - offset.share:.0%} of the orientations are far off where the others agree "
                "(allowed: a quarter)"
            )
    if not (measured and offset.scatter_deg <= _MOST_TURN * turn) and _runs_backwards(found):
        return (
            "the path fits backwards as well, and the orientations turn too little to decide: "
            "nothing shows that it is this flight's"
        )
    return ""


def extrapolates(known: Uncertainty, path: F64) -> str:
    """Says so where poses are too few, or span too little, to place the whole path (K, 3), m."""
    error_m = float(known.radius_m(path).max())
    allowed_m = MOST_SCATTER * float(np.sqrt(np.mean((path - path.mean(axis=0)) ** 2)))
    if error_m <= allowed_m:
        return ""
    return (
        f"the keyframes that have a pose in the trajectory leave others of the map open by "
        f"{error_m:.3g} m in 90 % (allowed: {allowed_m:.3g} m, a tenth of the path's spread); "
        "give a trajectory that covers more of the flight"
    )


def too_fast(time_ns: I64, position_m: F64) -> str:
    """Says so where times (N,) and positions (N, 3) move as nothing does in metres; else empty."""
    order = np.argsort(time_ns, kind="stable")
    seconds = np.diff(time_ns[order]) / 1e9
    steps = np.linalg.norm(np.diff(position_m[order], axis=0), axis=1)
    if not (seconds > 0).any():
        return ""
    speed = float(np.median(steps[seconds > 0] / seconds[seconds > 0]))
    if speed <= _FASTEST_M_S:
        return ""
    return (
        f"the trajectory moves at {speed:.0f} m/s (allowed: {_FASTEST_M_S:g}): is it in "
        "millimetres? Positions must be in metres"
    )


def mistakes(truth: F64) -> Iterator[tuple[str, F64]]:
    """Trajectories (N, 4, 4) that these poses would be without a known mistake, and its name."""
    quaternion, position = poses.to_quaternion(truth), truth[:, :3, 3]
    yield (
        "with its quaternions read as w, x, y, z it fits: write them as x, y, z, w",
        poses.from_quaternion(position, quaternion[:, [1, 2, 3, 0]]),
    )
    yield (
        "read as poses of the world in the camera it fits: invert them (camera to world is needed)",
        poses.inverse(truth),
    )
    turned = truth.copy()
    turned[:, :3, :3] = np.swapaxes(truth[:, :3, :3], 1, 2)
    yield "with its rotations inverted it fits: they must be camera to world", turned
    yield "with its poses in reverse it fits: its times run backwards", truth[::-1]


def mirrored(found: Fitted) -> str:
    """Says so where a mirrored map fits much better: an axis of the trajectory has a wrong sign."""
    x, y = found.used.source, found.used.target
    try:
        left = _scatter_m(x * [1.0, 1.0, -1.0], y)
    except GeometryError:
        return ""
    if left < _BETTER * found.scatter_m and left < MOST_SCATTER * found.used.spread_m():
        return "mirrored it fits: one of its axes has the wrong sign, or two are exchanged"
    return ""


def late(model: F64, time_ns: I64, trajectory: Trajectory) -> str:
    """Says so where positions `model` (N, 3) of the times `time_ns` (N,) fit much better at others.

    Other times are these and a constant; each is compared by the keyframes that it has a pose for.
    """
    seconds = (time_ns - time_ns[0]) / 1e9
    order = np.argsort(trajectory.time_ns, kind="stable")
    known = trajectory.time_ns[order] / 1e9 - time_ns[0] / 1e9
    path = trajectory.position_m[order]

    def left(shift: float) -> tuple[float, float]:
        """What positions leave so much later, of what they leave now, and of the path's spread."""
        inside = (seconds + shift >= known[0]) & (seconds + shift <= known[-1])
        if inside.sum() < max(_FEWEST, len(seconds) // 2):
            return np.inf, np.inf
        now, then = (
            np.stack([np.interp(seconds[inside] + s, known, axis) for axis in path.T], axis=1)
            for s in (0.0, shift)
        )
        try:
            scatter_m = _scatter_m(model[inside], then)
            before_m = _scatter_m(model[inside], now)
        except GeometryError:
            return np.inf, np.inf
        spread_m = float(np.sqrt(np.mean((then - then.mean(axis=0)) ** 2)))
        return scatter_m / max(before_m, 1e-300), scatter_m / spread_m

    best, span = 0.0, (seconds[-1] - seconds[0]) / 2
    for steps in (_SHIFTS, _FINE, _FINE):  # coarse over half the flight, then fine about the best
        shifts = best + np.linspace(-span, span, steps + 1)
        best = float(min(shifts, key=lambda shift: left(shift)[0]))
        span *= 2 / steps
    better, rest = left(best)
    if abs(best) * 1e9 <= _LEAST_SHIFT_NS or better > _BETTER or rest > MOST_SCATTER:
        return ""
    return (
        f"with its times {abs(best):.2f} s {'earlier' if best > 0 else 'later'} it fits: its clock "
        "is not the video's; shift them"
    )


def _turning_deg(wTc: F64) -> float:
    """How far orientations (N, 4, 4) spread about their mean, root of the mean square, degrees."""
    all_ = Rotation.from_matrix(wTc[:, :3, :3])
    return float(np.degrees(np.sqrt(np.mean((all_.mean().inv() * all_).magnitude() ** 2))))


def _runs_backwards(found: Fitted) -> bool:
    """Whether the path would fit in reverse, too: a straight line and a circle at even speed do."""
    x, y = found.used.source, found.used.target[::-1]
    try:
        return _scatter_m(x, y) <= MOST_SCATTER * found.used.spread_m()
    except GeometryError:
        return True  # one line, of which both ends are alike


def _scatter_m(source: F64, target: F64) -> float:
    error = align(source, target, True).apply(source) - target
    return float(np.sqrt(np.sum(error**2) / max(3 * len(error) - 7, 1)))
