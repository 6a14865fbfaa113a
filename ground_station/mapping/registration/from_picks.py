"""The similarity from picks on a floor plan: x and y are theirs, tilt and height the map's."""

from __future__ import annotations

from typing import Any

import numpy as np

from ground_station.arrays import Bools
from ground_station.errors import MapError
from ground_station.geometry.alignment import Alignment
from ground_station.map.store import Landmarks
from ground_station.mapping.registration.adjustment import (
    KnownPoints,
    Upright,
    adjust_agreeing,
    held_out,
)
from ground_station.mapping.registration.picks import MIN_WIDTH, Picks, at_present
from ground_station.mapping.registration.registration import (
    GATE_DEVIATION,
    Registration,
    check_spread,
    listed,
    similarity_report,
)
from ground_station.mapping.registration.upright import upright_rotation

_PAIRS = 2000
_CLICK_PX = 2.0
"""Nobody clicks better than two pixels of the plan: what is off by less is not off."""


def by_picks(landmarks: Landmarks, picks: Picks, seed: int) -> Registration:
    """The similarity from picks, of which wrong ones are found where enough others agree.

    A plan tells x and y, so a similarity of the floor plane; the vertical and a level of known
    height give the rest, and their own uncertainty. Raises `MapError` as `check_picks` does.
    """
    picks = at_present(picks, landmarks)
    up = picks.upright
    world = picks.scale.to_world(np.array([pick.plan_px for pick in picks.picks]))
    points = KnownPoints(
        model=np.array([pick.place for pick in picks.picks]),
        covariance=picks.covariance,
        world=np.column_stack([world, np.zeros(len(world))]),
        group=np.arange(len(world)),
        axes=2,
    )
    click_m = _CLICK_PX * picks.scale.resolution_m
    start, agree = _robust(points, up, click_m, seed)
    adjusted, agree = adjust_agreeing(start, points, agree, up)
    names = [pick.name for pick in picks.picks]
    notes = []
    off = points.off_m(adjusted.fit)
    for name, good, far in zip(names, agree, off, strict=True):
        if not good:
            notes.append(f"pick '{name}' left out: {far:.2f} m off where the others agree")
    used = points.of(agree)
    held, scales = held_out(used, MIN_WIDTH, adjusted.fit, up)
    report: dict[str, Any] = {
        "method": "picks",
        "points": len(used),
        "points_given": len(points),
        **listed(
            [name for name, good in zip(names, agree, strict=True) if good],
            used.off_m(adjusted.fit),
            held,
        ),
        "point_sigma_m": adjusted.scatter_m,
        "up_sigma_deg": float(np.degrees(up.sigma_rad)),
        **similarity_report(adjusted.fit, scales),
    }
    return Registration(adjusted.fit, report, adjusted.uncertainty, notes)


def _robust(points: KnownPoints, up: Upright, click_m: float, seed: int) -> tuple[Alignment, Bools]:
    """The similarity that most picks agree with, and which: the pair with the least median wins.

    In the floor plane a similarity is w = a z + b in complex numbers, which two points determine.
    """
    turn = upright_rotation(up.direction)
    flat = points.model @ turn.T
    z, w = flat[:, 0] + 1j * flat[:, 1], points.world[:, 0] + 1j * points.world[:, 1]
    n = len(z)
    first, second = np.triu_indices(n, 1)
    if len(first) > _PAIRS:
        chosen = np.random.default_rng(seed).choice(len(first), _PAIRS, replace=False)
        first, second = first[chosen], second[chosen]
    between = z[second] - z[first]
    apart = np.abs(between) > 1e-9 * np.abs(z - z.mean()).max()
    first, second, between = first[apart], second[apart], between[apart]
    a = (w[second] - w[first]) / between
    b = w[first] - a * z[first]
    rank = min(n - 1, max(n // 2, 2))  # more than the pair, which fits itself
    off = np.sort(np.abs(a[:, None] * z + b[:, None] - w), axis=1)[:, rank]
    off[np.abs(a) <= 0] = np.inf
    best = int(np.argmin(off))
    gate = GATE_DEVIATION * (1.4826 * (1 + 5 / max(n - 2, 1)) * float(off[best]) + click_m)
    one, other = a[best], b[best]
    inliers = np.zeros(n, dtype=bool)
    for _ in range(10):
        now = np.abs(one * z + other - w) <= gate
        if (now == inliers).all():
            break
        inliers = now
        check_spread(points.world[inliers][:, :2], "picks that agree with each other", MIN_WIDTH)
        dz, dw = z[inliers] - z[inliers].mean(), w[inliers] - w[inliers].mean()
        one = complex(np.vdot(dz, dw) / np.vdot(dz, dz))
        other = complex(w[inliers].mean() - one * z[inliers].mean())
    scale = abs(one)
    if not (np.isfinite(scale) and scale > 0):
        raise MapError(f"registration: the {n} picks do not determine a scale")
    cosine, sine = one.real / scale, one.imag / scale
    yaw = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    shift = np.array([other.real, other.imag, up.height_m - scale * up.level])
    return Alignment(yaw @ turn, shift, scale), inliers
