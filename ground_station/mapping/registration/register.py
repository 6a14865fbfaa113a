"""From a model's arbitrary coordinates to the world's: `register_map`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from ground_station.errors import MapError
from ground_station.geometry.alignment import Alignment
from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import Trajectory
from ground_station.map import colmap, store
from ground_station.map.folder import replacing
from ground_station.map.levelling import transformed
from ground_station.map.store import Map
from ground_station.map.uncertainty import describe
from ground_station.mapping.registration.adjustment import KnownPoints, adjust_agreeing, held_out
from ground_station.mapping.registration.distances import Distances, by_distances, with_distances
from ground_station.mapping.registration.from_picks import by_picks
from ground_station.mapping.registration.from_trajectory import by_trajectory
from ground_station.mapping.registration.observations import (
    PointObservations,
    Triangulated,
    reproject,
    sigma_px,
    triangulate_observations,
)
from ground_station.mapping.registration.picks import Picks
from ground_station.mapping.registration.registration import (
    MIN_POINTS,
    MIN_WIDTH,
    Registration,
    listed,
    rms,
    robust_similarity,
    similarity_report,
)


def by_observations(map_: Map, observations: PointObservations, seed: int) -> Registration:
    """The similarity from observations of known points, triangulated with the map's own poses.

    The points that agree are found first (`robust_similarity`); those are adjusted, weighted by the
    observations' geometry and by what the places scatter (`adjust`). Each thing that was measured,
    a point or a tag, is also held out once."""
    camera, kf = map_.info.camera, map_.keyframes
    found, notes = triangulate_observations(observations, kf.names, kf.wTc, camera)
    what = f"of {len(observations.points)} points could be triangulated"
    if len(found) < MIN_POINTS:
        raise MapError(
            f"registration: {len(found)} {what}; at least {MIN_POINTS} are needed"
            + (f" ({notes[0]})" if notes else "")
        )
    points = _known(found, observations, sigma_px(found))
    noise = np.sqrt(np.trace(points.covariance, axis1=1, axis2=2))
    plain, agree = robust_similarity(points.model, points.world, noise, seed, "points")
    adjusted, agree = adjust_agreeing(plain, points, agree)
    far = points.off_m(adjusted.fit)
    for point, good, off_m in zip(found, agree, far, strict=True):
        if not good:
            notes.append(f"point '{point.name}' left out: {off_m:.3f} m off where the others agree")
    used, names = points.of(agree), [p for p, good in zip(found, agree, strict=True) if good]
    fit = adjusted.fit
    held, scales = held_out(used, MIN_WIDTH)
    report: dict[str, Any] = {
        "method": "observations",
        "points": len(used),
        "points_given": len(observations.points),
        "observations": sum(len(point.ray) for point in names),
        **listed([point.name for point in names], used.off_m(fit), held),
        "reprojection_rms_px": _reprojection_px(fit, names, camera),
        "observation_sigma_px": sigma_px(names),
        "point_sigma_m": adjusted.scatter_m,
        **similarity_report(fit, scales),
    }
    if used.groups < MIN_POINTS:
        notes.append(
            f"only {used.groups} of the tags: how exactly they were measured cannot be told, and "
            "the uncertainty is large; measure three or more"
        )
    return Registration(fit, report, adjusted.uncertainty, notes)


def _known(
    found: Sequence[Triangulated], observations: PointObservations, sigma: float
) -> KnownPoints:
    group = dict(zip(observations.points, observations.group.tolist(), strict=True))
    return KnownPoints(
        model=np.array([point.position for point in found]),
        covariance=sigma**2 * np.array([point.covariance for point in found]),
        world=np.array([point.world_m for point in found]),
        group=np.array([group[point.name] for point in found], np.int64),
    )


def _reprojection_px(fit: Alignment, points: Sequence[Triangulated], camera: Camera) -> float:
    """How far the world's points lie from their observations, RMS, undistorted pixels."""
    off = []
    for point in points:
        X = fit.rotation.T @ (point.world_m - fit.translation) / fit.scale
        residual, _ = reproject(X, point.wTc, point.ray, camera)
        off.append(np.linalg.norm(residual, axis=1))
    flat = np.concatenate(off)
    return rms(flat[np.isfinite(flat)]) if np.isfinite(flat).any() else float("inf")


class Given(TypedDict, total=False):
    """What a map may be registered by; of the first three one is used."""

    observations: PointObservations | None
    trajectory: Trajectory | None
    picks: Picks | None
    distances: Distances | None


def register_map(
    folder: str | Path, *, source: str = "", seed: int = 0, **given: Unpack[Given]
) -> tuple[store.Map, Registration]:
    """Takes a map on disk to world coordinates by observations of known points, a trajectory or
    picks.

    Distances are further measurements of the scale, or by themselves the only ones. Poses,
    landmarks, covariances and the COLMAP model are transformed together and take the old map's
    place at once. `source` is the file's name for map.toml. A registered map may be registered
    again. Raises `MapError` when the points do not determine a similarity.
    """
    folder = Path(folder)
    map_ = store.load(folder)
    reconstruction = colmap.read(folder / "sparse")
    found = find_similarity(map_, seed=seed, **given)
    fit = found.fit
    moved = transformed(map_, fit)
    # In coordinates that are not the world's, no place has an error.
    region = moved.landmarks.position_m[: None if found.frame == "world" else 0]
    report = found.report | describe(found.uncertainty, region)
    moved.info.frame, moved.info.units = found.frame, "m"
    moved.info.registration = {"source": source, "seed": seed, **report}
    colmap.transform(reconstruction, fit.scale, fit.rotation, fit.translation)
    with replacing(folder) as part:
        colmap.write(reconstruction, part / "sparse")
        store.save_tables(part, moved)
    return moved, replace(found, report=report)


def find_similarity(map_: store.Map, *, seed: int = 0, **given: Unpack[Given]) -> Registration:
    """The similarity of what is given; changes nothing."""
    distances = given.get("distances")
    if (observations := given.get("observations")) is not None:
        found = by_observations(map_, observations, seed)
    elif (trajectory := given.get("trajectory")) is not None:
        found = by_trajectory(map_, trajectory, seed)
    elif (picks := given.get("picks")) is not None:
        found = by_picks(map_.landmarks, picks, seed)
    elif distances is not None:
        return by_distances(map_, distances)
    else:
        raise MapError("registration: observations, a trajectory, picks or distances are needed")
    return with_distances(found, map_, distances) if distances is not None else found
