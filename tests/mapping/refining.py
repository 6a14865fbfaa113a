"""A room of known points, its map with errors, and flights that see it: what refining needs."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from built_scene import look_at
from hand_made import by_frame, keyframes_of, observed

from ground_station.geometry import poses
from ground_station.geometry.alignment import align
from ground_station.map import colmap, landmarks, store
from ground_station.map.observations import FlightObservations, landmarks_sha256
from ground_station.mapping.refinement import shutter
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm import adjustment

ROOT = Path(__file__).parents[2]
SETTINGS = MappingSettings(threads=2)


def _along(t_s: np.ndarray, speed_m_s: float = 0.8) -> np.ndarray:
    """wTc (N, 4, 4) of a camera that passes the far corner of the room sideways."""
    return np.array(
        [look_at([2.0 + speed_m_s * t, 3.2 - 0.3 * t, 1.4 + 0.1 * t], [7.6, 5.4, 1.1]) for t in t_s]
    )


def _to_and_fro(t_s: np.ndarray, speed_m_s: float = 3.0) -> np.ndarray:
    """wTc (N, 4, 4) of one that swings: steady motion would shear all frames the same way, which
    is a sheared room as well."""
    swing = speed_m_s * 0.1 * np.sin(np.asarray(t_s) / 0.1)
    return np.array([look_at([2.2 + x, 3.0 - x, 1.4], [7.6, 5.4, 1.1]) for x in swing])


def _seen(scene_points, wTc, camera, rng, noise_px=0.3, speed_m_s=0.0, t_s=None, way=_along):
    """Indices and distorted pixels of the points in one frame; with a speed, row by row."""

    def project(at):
        local = poses.transform(poses.inverse(at), scene_points)
        with np.errstate(invalid="ignore"):
            flat = np.linalg.norm(local[:, :2], axis=1) / local[:, 2]
        pixel = camera.project(local)
        pixel[(local[:, 2] < 0.5) | (flat > 0.75)] = np.nan
        return pixel

    pixel = project(wTc)
    if speed_m_s:
        for _ in range(4):  # a row's time depends on the row that a point falls on
            row_s = shutter.row_times_s(np.nan_to_num(pixel[:, 1], nan=240.0), camera)
            at = way(t_s + row_s, speed_m_s)
            pixel = np.array([project(T)[k] for k, T in enumerate(at)])
    pixel = pixel + noise_px * rng.normal(size=pixel.shape)
    size = [camera.width_px - 1, camera.height_px - 1]
    with np.errstate(invalid="ignore"):
        inside = np.flatnonzero(((pixel >= 0) & (pixel <= size)).all(axis=1))
    return inside, pixel[inside]


@dataclasses.dataclass
class World:
    """A registered map whose landmarks and keyframes are off, and what is true."""

    folder: Path
    map: store.Map
    points: np.ndarray
    wTc: np.ndarray

    def flight(self, frames=24, *, seed=11, name="flight", noise_px=0.3, rate_hz=6.0):
        """A flight along other ways than the keyframes', with its true poses."""
        rng, camera = np.random.default_rng(seed), self.map.info.camera
        t_s = np.arange(frames) / rate_hz
        wTc = _along(t_s)
        seen = by_frame([_seen(self.points, T, camera, rng, noise_px) for T in wTc])
        return FlightObservations(
            name=name,
            map="room",
            landmarks_sha256=landmarks_sha256(self.map.landmarks),
            camera=camera,
            time_ns=np.round(t_s * 1e9).astype(np.int64),
            wTc=wTc,
            **seen | {"landmark": self.map.landmarks.id[seen["landmark"]]},
        )

    def errors_m(self, map_: store.Map) -> np.ndarray:
        """Of the landmarks."""
        kept = np.isin(self.map.landmarks.id, map_.landmarks.id)
        return np.linalg.norm(map_.landmarks.position_m - self.points[kept], axis=1)


def _localized(flight: FlightObservations, map_: store.Map) -> FlightObservations:
    """The flight with the poses that its pixels have in the map, the map's errors included."""
    camera, found = map_.info.camera, []
    place = np.searchsorted(map_.landmarks.id, flight.landmark)
    for k in range(len(flight)):
        rows = slice(flight.offset[k], flight.offset[k + 1])
        ok, turn, move = cv2.solvePnP(
            map_.landmarks.position_m[place[rows]],
            flight.pixel_px[rows].astype(np.float64),
            camera.matrix,
            camera.distortion,
            flags=cv2.SOLVEPNP_SQPNP,
        )
        assert ok
        found.append(poses.inverse(poses.pose(cv2.Rodrigues(turn)[0], move.ravel())))
    return dataclasses.replace(flight, wTc=np.array(found))


@pytest.fixture(scope="session")
def _world(tmp_path_factory) -> World:
    """Eight keyframes of a room, taken close together: what is far is badly known along the view.

    The map is the optimum of its own observations, in the world's coordinates.
    """
    rng = np.random.default_rng(4)
    count = 260
    size = np.array([8.0, 6.0, 3.0])
    points = rng.uniform(0, 1, (count, 3)) * size
    wall = rng.integers(0, 3, count)
    points[np.arange(count), wall] = np.where(rng.random(count) < 0.3, 0.0, size[wall])
    from ground_station.geometry.camera import THESIS_CAMERA

    camera = dataclasses.replace(THESIS_CAMERA, readout_s=0.0)
    wTc = np.array(
        [
            look_at([1.0 + 0.05 * k, 1.5 + 0.08 * k, 1.5 + 0.05 * (k % 3)], [7.5, 5.5, 1.2])
            for k in range(8)
        ]
    )
    rows = [_seen(points, T, camera, rng) for T in wTc]
    model, used = observed(camera, wTc, points, rows, least=6)
    points, pixel = model.position, np.concatenate([pixel for _, pixel in rows])[used]
    reconstruction = colmap.from_arrays(model, camera)
    adjustment.adjust(reconstruction, loss_px=1.0, threads=1)
    found, position = colmap.positions(reconstruction, model)
    fit = align(position, points, True)  # registered by what it saw
    model = dataclasses.replace(model, wTc=fit.apply_poses(found), position=fit.apply(position))
    descriptor = np.abs(rng.normal(size=(len(points), 32))).astype(np.float32)
    descriptor /= np.linalg.norm(descriptor, axis=1, keepdims=True)
    info = store.MapInfo("scene", "0" * 64, 32, camera, "room", "world", "m")
    info.built, info.registration = {"images": 8}, {"method": "observations", "points": 12}
    map_ = store.Map(
        info,
        landmarks.make_landmarks(model, np.ones((len(model.image), 32), np.float32)),
        keyframes_of(
            model.wTc, 400_000_000,
            offset=np.searchsorted(model.image, np.arange(9)),
            landmark=model.point.astype(np.int32), pixel_px=pixel.astype(np.float32),
        ),
    )  # fmt: skip
    map_.landmarks.descriptor = descriptor
    path = tmp_path_factory.mktemp("world") / "room"
    path.mkdir()
    colmap.write(colmap.from_arrays(model, camera), path / "sparse")
    store.save_tables(path, map_)
    (path / "floorplan.yaml").write_text("resolution: 0.05\n")
    return World(path, store.load(path), points, wTc)


@pytest.fixture
def world(_world, tmp_path) -> World:
    """The same, in a folder of its own."""
    shutil.copytree(_world.folder, tmp_path / "room")
    return World(tmp_path / "room", store.load(tmp_path / "room"), _world.points, _world.wTc)
