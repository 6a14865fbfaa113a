"""The similarity from a trajectory that has poses at the keyframes' times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ground_station.arrays import F64, I64, Bools
from ground_station.errors import GeometryError, MapError
from ground_station.geometry import poses
from ground_station.geometry.alignment import Alignment, align
from ground_station.geometry.trajectory import Trajectory
from ground_station.map.store import Keyframes, Map
from ground_station.map.uncertainty import Uncertainty, jacobian
from ground_station.mapping.registration import agreement
from ground_station.mapping.registration.pose_similarity import (
    Offset,
    Positions,
    joint_similarity,
    orientation_offset,
    position_scatter,
    robust_rotation,
    similarity_on_a_line,
)
from ground_station.mapping.registration.registration import (
    MIN_POINTS,
    Registration,
    check_spread,
    rms,
    robust_similarity,
    similarity_report,
)

_MAX_DIFF_NS = 10_000_000
"""A trajectory's pose counts for a keyframe within 10 ms, as in the evaluation."""

_MIN_EXTENT, _MAX_EXTENT = 1e-9, 1e9
"""Of a path, in a model's units or metres: beyond, squares leave the numbers' range."""


def by_trajectory(map_: Map, trajectory: Trajectory, seed: int) -> Registration:
    """The similarity from the keyframes' poses to a trajectory's at the same times.

    Positions and orientations count each by its own scatter. Orientations that are a constant
    rotation off the camera's (a vehicle's own axes) are left out, with a note. Positions on one
    line leave the roll about it to the orientations. Raises `MapError` for fewer than three poses,
    numbers that are not finite, positions in one place, positions on one line where the
    orientations cannot be used, and a trajectory that `agreement` finds to be of another flight,
    damaged, or too short for the map.
    """
    chosen, model, truth = _matched(map_.keyframes, trajectory)
    n, total = len(model), len(map_.keyframes)
    notes = [f"{n} of {total} keyframes have a pose in the trajectory"]
    time_ns = map_.keyframes.time_ns[chosen]
    if odd := agreement.too_fast(time_ns, truth[:, :3, 3]):
        raise MapError(f"registration: {odd}")
    started = _start(model, truth, seed)
    _check_agrees(started, time_ns, trajectory, seed)
    used, fit, offset = started.used, started.fit, started.offset
    alike, turned, turned_alike = started.alike, started.turned, started.turned_alike
    scatter_m, on_line = started.scatter_m, started.on_line
    if started.bent:
        notes.append(
            f"the map is bent, or the trajectory: {started.bent} positions lie far off where the "
            f"others agree; all are used, and scatter {scatter_m:.2g} m an axis"
        )
    if on_line:
        notes.append("the positions lie on one line: the orientations give the roll about it")
    report: dict[str, Any] = {"method": "trajectory", "points": len(used.source), "points_given": n}
    if offset.another_frame:
        if on_line:
            raise MapError(
                f"registration: the {n} positions lie on one line, and the trajectory's "
                f"orientations, {offset.angle_deg:.1f} deg off the camera's, do not give the roll"
            )
        notes.append(
            f"the trajectory's orientations are {offset.angle_deg:.1f} deg off the camera's "
            f"(scatter {offset.scatter_deg:.1f} deg): only its positions are used"
        )
        scales = _jackknife_scales(used.source, used.target)
        report |= {"orientations": 0, "sigma_m": scatter_m}
        known = _uncertainty(used, fit, scatter_m, 0, 1.0)
    else:
        joint = joint_similarity(used, turned[turned_alike], fit)
        fit, scales = joint.fit, used.jackknife_scales(joint.fit.rotation)
        count = int(turned_alike.sum())
        known = _uncertainty(used, fit, joint.sigma_m, count, joint.sigma_rad)
        report |= {
            "orientations": count,
            "sigma_m": joint.sigma_m,
            "sigma_deg": float(np.degrees(joint.sigma_rad)),
        }
    if odd := agreement.extrapolates(known, fit.apply(map_.keyframes.wTc[:, :3, 3])):
        raise MapError(f"registration: {odd}")
    if not alike.all():
        notes.append(f"{int((~alike).sum())} positions left out: far off where the others agree")
    if not (turned_alike.all() or offset.another_frame):
        notes.append(f"{int((~turned_alike).sum())} orientations left out: far off the others'")
    error = np.linalg.norm(fit.apply(used.source) - used.target, axis=1)
    seen = turned if offset.another_frame else turned[turned_alike]
    angle = np.degrees(poses.rotation_angle(seen @ fit.rotation.T))
    report |= {
        "residual_rms_m": rms(error),
        "residual_max_m": float(error.max()),
        "residual_rms_deg": rms(angle),
        "residual_max_deg": float(angle.max()),
        "orientation_offset_deg": offset.angle_deg,
        **similarity_report(fit, scales),
    }
    return Registration(fit, report, known, notes)


@dataclass(frozen=True)
class _Start(agreement.Fitted):
    """The similarity by positions, which of them agree, and what the orientations say to it."""

    fit: Alignment
    alike: Bools
    on_line: bool
    turned: F64
    turned_alike: Bools
    bent: int
    """Positions that lie far off where the others agree, and are used all the same."""


def _start(model: F64, truth: F64, seed: int) -> _Start:
    """Of matched poses (N, 4, 4); raises `MapError` where they leave the similarity open."""
    positions = Positions(model[:, :3, 3], truth[:, :3, 3])
    turned = truth[:, :3, :3] @ np.swapaxes(model[:, :3, :3], 1, 2)
    mean, turned_alike = robust_rotation(turned, seed)
    try:
        check_spread(positions.target, "positions")
        noise = np.zeros(len(model))
        fit, alike = robust_similarity(positions.source, positions.target, noise, seed, "positions")
        on_line = False
    except (MapError, GeometryError):
        fit, alike = similarity_on_a_line(positions, mean, seed)
        on_line = True
    bent = 0
    if not agreement.most_agree(alike) and (whole := _whole(positions)):
        bent = int((~alike).sum())
        fit, alike, on_line = whole, np.ones(len(model), dtype=bool), False
    used = positions.of(alike)
    scatter_m = max(position_scatter(used, fit), used.floor_m())
    offset = _offset(used, fit, scatter_m, model, truth, seed)
    return _Start(
        used, scatter_m, offset, model, truth, fit, alike, on_line, turned, turned_alike, bent
    )


def _whole(positions: Positions) -> Alignment | None:
    """The similarity by all positions, where they leave as little as those of one flight do.

    The places of a bent map are off by little and all of them, and where half of its way is
    straight, the other half is off by many times what that half scatters.
    """
    try:
        check_spread(positions.target, "positions")
        fit = align(positions.source, positions.target, True)
    except (MapError, GeometryError):
        return None
    fitting = position_scatter(positions, fit) <= agreement.MOST_SCATTER * positions.spread_m()
    return fit if fitting else None


def _offset(
    used: Positions, fit: Alignment, scatter_m: float, model: F64, truth: F64, seed: int
) -> Offset:
    information = used.information(fit, scatter_m)
    return orientation_offset(fit, information, model[:, :3, :3], truth[:, :3, :3], seed)


def _check_agrees(found: _Start, time_ns: I64, trajectory: Trajectory, seed: int) -> None:
    """Raises `MapError` for a trajectory that is not this flight's, with the mistake it looks like.

    Structure from motion can also end inside out, with all images registered and small residuals.
    """
    model, truth = found.model, found.truth
    reason = agreement.disagreement(found)
    hint = agreement.mirrored(found)
    if not hint:
        hint = agreement.late(found.used.source, time_ns[found.alike], trajectory)
    if reason and not hint:
        for words, corrected in agreement.mistakes(truth):
            if np.array_equal(corrected[:, :3, 3], truth[:, :3, 3]) and not found.on_line:
                offset = _offset(found.used, found.fit, found.scatter_m, model, corrected, seed)
                other = replace(found, offset=offset, truth=corrected)
            else:
                try:
                    other = _start(model, corrected, seed)
                except MapError:
                    continue
            if not agreement.disagreement(other):
                hint = words
                break
    if reason or hint:
        reason = reason or (
            f"the trajectory scatters {found.scatter_m:.3g} m an axis about the keyframes, more "
            "than twice what it need"
        )
        hint = hint or (
            "the trajectory is of another flight or damaged, or the map is bent: give the "
            "trajectory of the video that the map was built from, or register by --pairs or --page"
        )
        raise MapError(f"registration: {reason}; {hint}")


def _matched(kf: Keyframes, trajectory: Trajectory) -> tuple[Bools, F64, F64]:
    """Which keyframes (K,) have a pose in the trajectory, theirs (N, 4, 4) and the trajectory's."""
    if not len(trajectory):
        raise MapError("registration: the trajectory has no poses")
    order = np.argsort(trajectory.time_ns, kind="stable")
    sorted_ns = trajectory.time_ns[order]
    right = np.clip(np.searchsorted(sorted_ns, kf.time_ns), 0, len(order) - 1)
    left = np.maximum(right - 1, 0)
    # In floats: the difference of two times out of a hostile file need not be an integer of 64 bit.
    ahead, behind = (
        np.abs(sorted_ns[i].astype(np.float64) - kf.time_ns.astype(np.float64))
        for i in (right, left)
    )
    nearest = order[np.where(behind <= ahead, left, right)]
    close = np.minimum(ahead, behind) <= _MAX_DIFF_NS
    if close.sum() < MIN_POINTS:
        raise MapError(
            f"registration: {int(close.sum())} of {len(kf)} keyframes have a pose within "
            f"{_MAX_DIFF_NS / 1e9} s in the trajectory; at least {MIN_POINTS} are needed: its "
            f"times are {_between(trajectory.time_ns)}, the map's {_between(kf.time_ns)}"
        )
    position = trajectory.position_m[nearest[close]]
    quaternion = trajectory.quaternion_xyzw[nearest[close]]
    # Compared this way round, what is not a number fails, too.
    good = (np.abs(position) < _MAX_EXTENT).all(axis=1)
    good &= (np.abs(quaternion) < 2).all(axis=1) & (np.abs(quaternion).max(axis=1) > 1e-6)
    if not good.all():
        time_s = trajectory.time_ns[nearest[close]][~good][0] / 1e9
        raise MapError(
            f"registration: the trajectory's pose at {time_s:.6f} s is not finite, is further than "
            f"{_MAX_EXTENT:.0e} m or has a quaternion that is not of length 1"
        )
    model = kf.wTc[close]
    good = np.asarray((np.abs(model) < _MAX_EXTENT).all(axis=(1, 2)))
    R = np.where(good[:, None, None], model[:, :3, :3], 0.0)
    good &= np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2)) < 1e-3
    good &= np.linalg.det(R) > 0
    if not good.all():
        name = np.array(kf.names)[close][~good][0]
        raise MapError(f"registration: the map's pose of '{name}' is not finite or no rigid motion")
    for which, centre in (("map", model[:, :3, 3]), ("trajectory", position)):
        if np.ptp(centre, axis=0).max() < _MIN_EXTENT:
            raise MapError(
                f"registration: the {len(centre)} positions of the {which} lie in one place"
            )
    return close, model, poses.from_quaternion(position, quaternion)


def _between(time_ns: I64) -> str:
    return f"{time_ns.min() / 1e9:.3f} to {time_ns.max() / 1e9:.3f} s"


def _uncertainty(
    positions: Positions, fit: Alignment, sigma_m: float, rotations: int, sigma_rad: float
) -> Uncertainty:
    """The similarity's covariance; every pose counts as independent, which a drift is not."""
    placed = fit.apply(positions.source)
    centre = placed.mean(axis=0)
    J = jacobian(placed - centre)
    normal = np.einsum("nki,nkj->ij", J, J) / sigma_m**2
    if rotations:
        normal[:3, :3] += rotations / sigma_rad**2 * np.eye(3)
    freedom = max(3 * len(placed) - 7, 1)
    return Uncertainty(np.linalg.pinv(normal, hermitian=True), centre, freedom)


def _jackknife_scales(source: F64, target: F64) -> list[float]:
    keep = ~np.eye(len(source), dtype=bool)
    if len(source) <= MIN_POINTS:
        return []
    return [align(source[others], target[others], True).scale for others in keep]
