"""From a model's arbitrary coordinates to the world's: `register_map`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ground_station.errors import MapError
from ground_station.geometry.alignment import Alignment
from ground_station.geometry.trajectory import Trajectory
from ground_station.map import colmap, store
from ground_station.map.folder import replacing
from ground_station.map.uncertainty import describe
from ground_station.mapping.registration.distances import Distances, by_distances, with_distances
from ground_station.mapping.registration.from_observations import by_observations
from ground_station.mapping.registration.from_picks import by_picks
from ground_station.mapping.registration.from_trajectory import by_trajectory
from ground_station.mapping.registration.observations import PointObservations
from ground_station.mapping.registration.picks import Picks
from ground_station.mapping.registration.registration import Registration


def register_map(
    folder: str | Path,
    *,
    observations: PointObservations | None = None,
    trajectory: Trajectory | None = None,
    picks: Picks | None = None,
    distances: Distances | None = None,
    source: str = "",
    seed: int = 0,
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
    found = find_similarity(
        map_,
        observations=observations,
        trajectory=trajectory,
        picks=picks,
        distances=distances,
        seed=seed,
    )
    fit = found.fit
    moved = transform_map(map_, fit)
    # In coordinates that are not the world's, no place has an error.
    region = moved.landmarks.position_m[: None if found.frame == "world" else 0]
    report = found.report | describe(found.uncertainty, region)
    moved.info.frame, moved.info.units = found.frame, "m"
    moved.info.registration = {"source": source, "seed": seed, **report}
    colmap.transform(reconstruction, fit.scale, fit.rotation, fit.translation)
    quantise = bool(map_.info.built.get("settings", {}).get("quantise", True))
    with replacing(folder) as part:
        colmap.write(reconstruction, part / "sparse")
        store.save_tables(part, moved, quantise=quantise)
    return moved, replace(found, report=report)


def find_similarity(
    map_: store.Map,
    *,
    observations: PointObservations | None = None,
    trajectory: Trajectory | None = None,
    picks: Picks | None = None,
    distances: Distances | None = None,
    seed: int = 0,
) -> Registration:
    """The similarity of what is given; changes nothing."""
    if observations is not None:
        found = by_observations(map_, observations, seed)
    elif trajectory is not None:
        found = by_trajectory(map_, trajectory, seed)
    elif picks is not None:
        found = by_picks(map_.landmarks, picks, seed)
    elif distances is not None:
        return by_distances(map_, distances)
    else:
        raise MapError("registration: observations, a trajectory, picks or distances are needed")
    return with_distances(found, map_, distances) if distances is not None else found


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
        modes=map_.modes,
    )
