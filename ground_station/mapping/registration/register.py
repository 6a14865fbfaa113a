"""From a model's arbitrary coordinates to the world's: `register_map`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.errors import GeometryError, MapError
from ground_station.geometry import poses
from ground_station.geometry.alignment import Alignment, align
from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import Trajectory
from ground_station.mapping import store
from ground_station.mapping.folder import replacing
from ground_station.mapping.registration.pose_similarity import (
    Positions,
    joint_similarity,
    orientation_offset,
    position_scatter,
    robust_rotation,
    similarity_on_a_line,
)
from ground_station.mapping.registration.sights import Sights, Triangulated, triangulate_sights
from ground_station.mapping.registration.similarity import (
    MIN_POINTS,
    check_spread,
    refine_similarity,
    robust_similarity,
)
from ground_station.mapping.sfm import colmap

F64 = npt.NDArray[np.float64]

_MAX_DIFF_NS = 10_000_000
"""A trajectory's pose counts for a keyframe within 10 ms, as in the evaluation."""

_MIN_EXTENT, _MAX_EXTENT = 1e-9, 1e9
"""Of a path, in a model's units or metres: beyond, squares leave the numbers' range."""


@dataclass(frozen=True)
class Registration:
    """A similarity and what map.toml says about it; `notes` are lines for a person."""

    fit: Alignment
    report: dict[str, Any]
    notes: list[str] = field(default_factory=list)


def register_map(
    folder: str | Path,
    *,
    sights: Sights | None = None,
    trajectory: Trajectory | None = None,
    source: str = "",
    seed: int = 0,
) -> tuple[store.Map, Registration]:
    """Takes a map on disk to world coordinates by sights of known points or by a trajectory.

    Poses, landmarks, covariances and the COLMAP model are transformed together and take the old
    map's place at once. `source` is the file's name for map.toml. A registered map may be
    registered again. Raises `MapError` when the points do not determine a similarity.
    """
    folder = Path(folder)
    map_ = store.load(folder)
    reconstruction = colmap.read(folder / "sparse")
    if sights is not None:
        found = by_sights(map_, sights, seed)
    elif trajectory is not None:
        found = by_trajectory(map_, trajectory, seed)
    else:
        raise MapError("registration: sights or a trajectory are needed")
    fit = found.fit
    moved = transform_map(map_, fit)
    moved.info.frame, moved.info.units = "world", "m"
    moved.info.registration = {"source": source, "seed": seed, **found.report}
    colmap.transform(reconstruction, fit.scale, fit.rotation, fit.translation)
    quantise = bool(map_.info.built.get("settings", {}).get("quantise", True))
    with replacing(folder) as part:
        colmap.write(reconstruction, part / "sparse")
        store.save_tables(part, moved, quantise=quantise)
    return moved, found


def by_sights(map_: store.Map, sights: Sights, seed: int) -> Registration:
    """The similarity from sights of known points, triangulated with the map's own poses.

    First triangulated and aligned (robustly), then all sights together: the world points'
    reprojection is minimised. Each point is also held out once, and the report has both errors of
    both ways.
    """
    camera, kf = map_.info.camera, map_.keyframes
    points, notes = triangulate_sights(sights, kf.names, kf.wTc, camera)
    what = f"of {len(sights.points)} points could be triangulated"
    if len(points) < MIN_POINTS:
        raise MapError(
            f"registration: {len(points)} {what}; at least {MIN_POINTS} are needed"
            + (f" ({notes[0]})" if notes else "")
        )
    position = np.array([point.position for point in points])
    world = np.array([point.world_m for point in points])
    noise = np.sqrt([np.trace(point.covariance) for point in points])
    plain, inliers = robust_similarity(position, world, noise, seed, "points")
    used = [point for point, good in zip(points, inliers, strict=True) if good]
    for point, good in zip(points, inliers, strict=True):
        if not good:
            off_m = np.linalg.norm(plain.apply(point.position[None])[0] - point.world_m)
            notes.append(f"point '{point.name}' left out: {off_m:.3f} m off where the others agree")
    fit, rms_px = refine_similarity(plain, used, camera)
    held_plain, held, scales = _held_out(used, noise[inliers], camera)
    error, error_plain = _errors(fit, used), _errors(plain, used)
    report: dict[str, Any] = {
        "method": "sights",
        "points": len(used),
        "points_given": len(sights.points),
        "sights": sum(len(point.ray) for point in used),
        "residual_rms_m": _rms(error),
        "residual_max_m": float(error.max()),
        "aligned_only_rms_m": _rms(error_plain),
        "reprojection_rms_px": rms_px,
        "point_names": [point.name for point in used],
        "point_residual_m": [round(float(e), 6) for e in error],
        **_similarity_report(fit, scales),
    }
    if len(held):
        report |= {
            "held_out_rms_m": _rms(held),
            "held_out_max_m": float(held.max()),
            "held_out_aligned_only_rms_m": _rms(held_plain),
            "point_held_out_m": [round(float(e), 6) for e in held],
        }
    return Registration(fit, report, notes)


def by_trajectory(map_: store.Map, trajectory: Trajectory, seed: int) -> Registration:
    """The similarity from the keyframes' poses to a trajectory's at the same times.

    Positions and orientations count each by its own scatter. Orientations that are a constant
    rotation off the camera's (a vehicle's own axes) are left out, with a note. Positions on one
    line leave the roll about it to the orientations. Raises `MapError` for fewer than three poses,
    numbers that are not finite, positions in one place, and positions on one line where the
    orientations cannot be used.
    """
    model, truth = _matched(map_.keyframes, trajectory)
    n, total = len(model), len(map_.keyframes)
    notes = [f"{n} of {total} keyframes have a pose in the trajectory"]
    positions = Positions(model[:, :3, 3], truth[:, :3, 3])
    turned = truth[:, :3, :3] @ np.swapaxes(model[:, :3, :3], 1, 2)
    mean, turned_alike = robust_rotation(turned, seed)
    try:
        check_spread(positions.target, "positions")
        noise = np.zeros(n)
        fit, alike = robust_similarity(positions.source, positions.target, noise, seed, "positions")
        on_line = False
    except (MapError, GeometryError):
        fit, alike = similarity_on_a_line(positions, mean, seed)
        on_line = True
        notes.append("the positions lie on one line: the orientations give the roll about it")
    used = positions.of(alike)
    scatter_m = max(position_scatter(used, fit), used.floor_m())
    offset = orientation_offset(
        fit, used.information(fit, scatter_m), model[:, :3, :3], truth[:, :3, :3], seed
    )
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
    else:
        joint = joint_similarity(used, turned[turned_alike], fit)
        fit, scales = joint.fit, used.jackknife_scales(joint.fit.rotation)
        report |= {
            "orientations": int(turned_alike.sum()),
            "sigma_m": joint.sigma_m,
            "sigma_deg": float(np.degrees(joint.sigma_rad)),
        }
    if not alike.all():
        notes.append(f"{int((~alike).sum())} positions left out: far off where the others agree")
    if not (turned_alike.all() or offset.another_frame):
        notes.append(f"{int((~turned_alike).sum())} orientations left out: far off the others'")
    error = np.linalg.norm(fit.apply(used.source) - used.target, axis=1)
    seen = turned if offset.another_frame else turned[turned_alike]
    angle = np.degrees(poses.rotation_angle(seen @ fit.rotation.T))
    report |= {
        "residual_rms_m": _rms(error),
        "residual_max_m": float(error.max()),
        "residual_rms_deg": _rms(angle),
        "residual_max_deg": float(angle.max()),
        "orientation_offset_deg": offset.angle_deg,
        **_similarity_report(fit, scales),
    }
    return Registration(fit, report, notes)


def _matched(kf: store.Keyframes, trajectory: Trajectory) -> tuple[F64, F64]:
    """Poses (N, 4, 4) of keyframes and the trajectory's at their times."""
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
            f"{_MAX_DIFF_NS / 1e9} s in the trajectory; at least {MIN_POINTS} are needed"
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
    return model, poses.from_quaternion(position, quaternion)


def transform_map(map_: store.Map, fit: Alignment) -> store.Map:
    """The map with poses, positions, covariances, directions and distances in the new frame."""
    lm, kf = map_.landmarks, map_.keyframes
    R, s = fit.rotation, fit.scale
    covariance = s**2 * (R @ lm.covariance_m2.astype(np.float64) @ R.T)
    return store.Map(
        info=store.MapInfo(**vars(map_.info)),
        landmarks=store.Landmarks(
            id=lm.id,
            position_m=fit.apply(lm.position_m),
            covariance_m2=covariance.astype(np.float32),
            descriptor=lm.descriptor,
            spread=lm.spread,
            view_direction=(lm.view_direction @ R.T).astype(np.float32),
            view_cos=lm.view_cos,
            distance_m=(s * lm.distance_m).astype(np.float32),
            observations=lm.observations,
        ),
        keyframes=store.Keyframes(
            names=kf.names,
            time_ns=kf.time_ns,
            wTc=fit.apply_poses(kf.wTc),
            offset=kf.offset,
            landmark=kf.landmark,
            pixel_px=kf.pixel_px,
        ),
        folder=map_.folder,
    )


def _held_out(
    points: Sequence[Triangulated], noise: F64, camera: Camera
) -> tuple[F64, F64, list[float]]:
    """Each point's error, metres, under the similarity of all others: aligned only, and refined.

    And the refined scales, for their jackknife deviation. Empty where the others are too few.
    """
    plain_error, error, scales = [], [], []
    for k, point in enumerate(points):
        others = [p for i, p in enumerate(points) if i != k]
        world = np.array([p.world_m for p in others])
        try:
            check_spread(world, "points")
        except MapError:
            continue
        weights = 1.0 / np.maximum(np.delete(noise, k), np.median(noise) / 10 + 1e-12) ** 2
        plain = align(np.array([p.position for p in others]), world, True, weights)
        fit, _ = refine_similarity(plain, others, camera)
        plain_error.append(_errors(plain, [point])[0])
        error.append(_errors(fit, [point])[0])
        scales.append(fit.scale)
    return np.array(plain_error), np.array(error), scales


def _jackknife_scales(source: F64, target: F64) -> list[float]:
    keep = ~np.eye(len(source), dtype=bool)
    if len(source) <= MIN_POINTS:
        return []
    return [align(source[others], target[others], True).scale for others in keep]


def _errors(fit: Alignment, points: Sequence[Triangulated]) -> F64:
    position = np.array([point.position for point in points])
    world = np.array([point.world_m for point in points])
    return np.asarray(np.linalg.norm(fit.apply(position) - world, axis=1))


def _rms(error: F64) -> float:
    return float(np.sqrt(np.mean(error**2)))


def _similarity_report(fit: Alignment, scales: Sequence[float]) -> dict[str, Any]:
    report: dict[str, Any] = {
        "scale": float(fit.scale),
        "rotation": fit.rotation.tolist(),
        "translation_m": fit.translation.tolist(),
    }
    if len(scales) > MIN_POINTS:
        # Jackknife: Efron and Stein 1981.
        n, log_scales = len(scales), np.log(scales)
        spread = np.sum((log_scales - log_scales.mean()) ** 2)
        report["scale_sigma_percent"] = float(100 * np.sqrt((n - 1) / n * spread))
    return report
