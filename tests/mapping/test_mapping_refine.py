"""A map gets better by what flights saw of it, stays where it is, and is never half written."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from ground_station.errors import MapError
from ground_station.geometry import poses
from ground_station.geometry.alignment import align
from ground_station.mapping import colmap, folder, landmarks, shutter, store
from ground_station.mapping.chosen import choose_frames, thin
from ground_station.mapping.observations import (
    FlightObservations,
    landmarks_sha256,
    load_observations,
    save_observations,
)
from ground_station.mapping.refine import refine_map
from ground_station.mapping.refined import Refined
from ground_station.mapping.settings import MappingSettings, RefineSettings

ROOT = Path(__file__).parents[2]
SETTINGS = MappingSettings(threads=2)


def look_at(position, target):
    """wTc of a camera at `position` that looks at `target`, z up in the world."""
    forward = np.asarray(target, float) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return poses.pose(np.stack([right, np.cross(forward, right), forward], axis=1), position)


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
        rows = [_seen(self.points, T, camera, rng, noise_px) for T in wTc]
        return FlightObservations(
            name=name,
            map="room",
            landmarks_sha256=landmarks_sha256(self.map.landmarks),
            camera=camera,
            time_ns=np.round(t_s * 1e9).astype(np.int64),
            wTc=wTc,
            offset=np.cumsum([0, *(len(index) for index, _ in rows)]),
            landmark=self.map.landmarks.id[np.concatenate([index for index, _ in rows])],
            pixel_px=np.concatenate([pixel for _, pixel in rows]).astype(np.float32),
        )

    def errors_m(self, map_: store.Map) -> np.ndarray:
        """Of the landmarks."""
        kept = np.isin(self.map.landmarks.id, map_.landmarks.id)
        return np.linalg.norm(map_.landmarks.position_m - self.points[kept], axis=1)


def _localized(flight: FlightObservations, map_: store.Map) -> FlightObservations:
    """The flight with the poses that its sights have in the map, errors of the map included."""
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


@pytest.fixture(scope="module")
def _world(tmp_path_factory) -> World:
    """Eight keyframes of a room, taken close together: what is far is badly known along the view.

    The map is the optimum of its own sights, in the world's coordinates.
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
    seen = np.bincount(np.concatenate([index for index, _ in rows]), minlength=count) >= 6
    points, new = points[seen], np.cumsum(seen) - 1
    rows = [(new[index[seen[index]]], pixel[seen[index]]) for index, pixel in rows]
    index = np.concatenate([index for index, _ in rows])
    pixel = np.concatenate([pixel for _, pixel in rows])
    image = np.repeat(np.arange(len(rows)), [len(i) for i, _ in rows])
    model = colmap.Model(
        names=[f"frame-{k:06d}" for k in range(8)],
        image_id=np.arange(8) + 1,
        wTc=wTc,
        point_id=np.arange(len(points)) * 3 + 5,
        position=points,
        image=image,
        feature=np.zeros(len(image), np.int64),
        point=index,
        pixel_px=camera.undistort_to_pinhole(pixel),
        pinhole=np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]),
    )
    reconstruction = colmap.from_arrays(model, camera)
    colmap.adjust(reconstruction, loss_px=1.0, refine_camera=False, threads=1)
    found, position = colmap.positions(reconstruction, model)
    fit = align(position, points, True)  # registered by what it saw
    model = dataclasses.replace(model, wTc=fit.apply_poses(found), position=fit.apply(position))
    descriptor = np.abs(rng.normal(size=(len(points), 32))).astype(np.float32)
    descriptor /= np.linalg.norm(descriptor, axis=1, keepdims=True)
    info = store.MapInfo("scene", "0" * 64, 32, camera, "room", "world", "m")
    info.built, info.registration = {"images": 8}, {"method": "sights", "points": 12}
    map_ = store.Map(
        info,
        landmarks.make_landmarks(model, np.ones((len(image), 32), np.float32)),
        store.Keyframes(
            model.names,
            np.arange(8) * 400_000_000,
            model.wTc,
            np.searchsorted(image, np.arange(9)),
            index.astype(np.int32),
            pixel.astype(np.float32),
        ),
    )
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


def test_a_flight_makes_landmarks_and_poses_better(world):
    flight = _localized(world.flight(), world.map)
    refined, result = refine_map(world.folder, [flight], SETTINGS)
    before, after = world.errors_m(world.map), world.errors_m(refined)
    seen = np.isin(refined.landmarks.id, flight.landmark)
    assert seen.mean() > 0.5
    kept = np.isin(world.map.landmarks.id, refined.landmarks.id)
    assert np.median(after[seen]) < 0.6 * np.median(before[kept][seen])
    mine = [k for k, name in enumerate(refined.keyframes.names) if name.startswith("flight/")]
    chosen = np.isin(flight.time_ns, refined.keyframes.time_ns[mine])
    truth = np.concatenate([world.wTc, _along(flight.time_ns[chosen] / 1e9)])[:, :3, 3]
    old = np.concatenate([world.map.keyframes.wTc, flight.wTc[chosen]])[:, :3, 3]
    new = refined.keyframes.wTc[:, :3, 3]
    was, now = (  # the datum is the old map's, with its errors: what counts is the shape
        np.linalg.norm(align(way, truth, True).apply(way) - truth, axis=1) for way in (old, new)
    )
    assert len(mine) >= 5 and np.median(now) < 0.6 * np.median(was)
    assert result.report["flights"][0]["frames"] == len(mine)


def test_a_registration_stays_where_it_was(world):
    """Also after a flight whose poses are all off the same way."""
    flight = world.flight()
    moved = flight.wTc.copy()
    moved[:, :3, 3] += [0.02, 0.0, 0.01]
    refined, _ = refine_map(world.folder, [dataclasses.replace(flight, wTc=moved)], SETTINGS)
    old, new = world.map.landmarks, refined.landmarks
    kept = np.isin(old.id, new.id)
    weight = 1 / np.trace(old.covariance_m2[kept], axis1=1, axis2=2)
    drift = align(new.position_m, old.position_m[kept], True, weight)
    centre = np.average(old.position_m[kept], axis=0, weights=weight)
    assert np.linalg.norm(drift.apply(centre[None])[0] - centre) < 0.005
    assert abs(drift.scale - 1) < 0.002
    assert np.degrees(poses.rotation_angle(drift.rotation)) < 0.1
    loaded = store.load(world.folder)
    assert loaded.info.registered and loaded.info.registration == world.map.info.registration
    assert loaded.info.built == world.map.info.built


def test_an_unregistered_map_keeps_its_own_coordinates_and_scale(world):
    info = dataclasses.replace(world.map.info, frame="sfm", units="arbitrary", registration={})
    store.save_tables(world.folder, dataclasses.replace(world.map, info=info))
    refined, result = refine_map(world.folder, [world.flight()], SETTINGS)
    assert not refined.info.registered and result.report["keyframes"]["moved_unit"] == "arbitrary"
    # One solution, whatever the name of its coordinates.
    assert np.median(world.errors_m(refined)) < np.median(world.errors_m(world.map))


def test_everything_in_the_folder_fits_together(world):
    _, result = refine_map(world.folder, [world.flight()], SETTINGS)
    loaded = store.load(world.folder)
    lm, kf = loaded.landmarks, loaded.keyframes
    model = colmap.to_arrays(colmap.read(world.folder / "sparse"))
    assert model.names == kf.names and len(colmap.read(world.folder / "sparse").cameras) == 1
    assert np.array_equal(model.point_id, lm.id)
    assert np.allclose(model.position, lm.position_m, atol=1e-9)
    assert np.allclose(model.wTc, kf.wTc, atol=1e-9)
    order = np.lexsort((model.point, model.image))
    image = np.repeat(np.arange(len(kf)), np.diff(kf.offset))
    mine = np.lexsort((kf.landmark, image))
    assert np.array_equal(model.point[order], kf.landmark[mine])
    pinhole = loaded.info.camera.undistort_to_pinhole(kf.pixel_px[mine])
    assert np.allclose(model.pixel_px[order], pinhole, atol=2e-3)
    again = landmarks.make_landmarks(model, np.zeros((len(model.point), 0), np.float32))
    for name in ("observations", "distance_m", "view_direction", "view_cos"):
        assert np.allclose(getattr(again, name), getattr(lm, name), atol=1e-4)
    assert lm.observations.sum() > world.map.landmarks.observations.sum()
    kept = np.isin(world.map.landmarks.id, lm.id)
    old = np.asarray(world.map.landmarks.descriptor, np.float32)
    assert np.allclose(np.asarray(lm.descriptor, np.float32), old[kept])
    before = np.trace(world.map.landmarks.covariance_m2[kept], axis1=1, axis2=2)
    after = np.trace(lm.covariance_m2, axis1=1, axis2=2)
    assert np.median(after) < np.median(before)
    assert loaded.info.refined["flights"][0]["name"] == "flight"
    assert loaded.info.refined["last"]["sights"] == result.report["sights"] == len(kf.landmark)


def test_sights_that_do_not_fit_are_dropped_and_counted(world):
    flight = world.flight()
    rng = np.random.default_rng(1)
    wrong = rng.random(len(flight.landmark)) < 0.1
    pixel = flight.pixel_px.copy()
    pixel[wrong] = rng.uniform([0, 0], [639, 479], (int(wrong.sum()), 2))
    refined, result = refine_map(
        world.folder, [dataclasses.replace(flight, pixel_px=pixel)], SETTINGS
    )
    about = result.report["flights"][0]
    assert 0.06 < 1 - about["sights"] / about["sights_given"] < 0.16
    assert np.median(world.errors_m(refined)) < np.median(world.errors_m(world.map))


def test_a_second_flight_joins_the_first_and_the_same_one_is_refused(world):
    first, second = world.flight(), world.flight(seed=5, name="second")
    refine_map(world.folder, [first], SETTINGS)
    with pytest.raises(MapError, match="'flight' is in the map already"):
        refine_map(world.folder, [first], SETTINGS)
    # Localized in the map before the first was added: the landmarks are the same.
    refined, _ = refine_map(world.folder, [second], SETTINGS)
    table = Refined.of(store.load(world.folder))
    assert [f["name"] for f in table.flights] == ["flight", "second"] and table.runs == 2
    groups = table.groups(len(refined.keyframes))
    prefix = ["frame-", "flight/", "second/"]
    assert all(
        name.startswith(prefix[g])
        for name, g in zip(refined.keyframes.names, groups.tolist(), strict=True)
    )
    kept = sorted(path.name for path in world.folder.parent.iterdir())
    assert kept == ["room", "room.before", "room.before-2"]


def test_frames_of_an_earlier_flight_that_go_are_no_longer_counted(world):
    first, _ = refine_map(world.folder, [world.flight()], SETTINGS)
    sights = np.diff(first.keyframes.offset)[8:]
    strict = dataclasses.replace(
        SETTINGS, refine=RefineSettings(min_sights=int(np.median(sights)) + 1)
    )
    second, result = refine_map(world.folder, [], strict)
    table = Refined.of(store.load(world.folder))
    assert 0 < result.report["frames_dropped"] == len(first.keyframes) - len(second.keyframes)
    assert table.flights[0]["frames"] == len(second.keyframes) - 8
    third, _ = refine_map(world.folder, [world.flight(seed=5, name="third")], SETTINGS)
    groups = Refined.of(store.load(world.folder)).groups(len(third.keyframes))
    third_names = [name.startswith("third/") for name in third.keyframes.names]
    assert third_names == (groups == 2).tolist()


def test_a_keyframe_and_landmarks_without_sights_are_no_hindrance(world):
    kf = world.map.keyframes
    offset = np.append(kf.offset, kf.offset[-1])
    more = dataclasses.replace(
        kf,
        names=[*kf.names, "blank"],
        time_ns=np.append(kf.time_ns, 10**10),
        wTc=np.concatenate([kf.wTc, kf.wTc[:1]]),
        offset=offset,
    )
    store.save_tables(world.folder, dataclasses.replace(world.map, keyframes=more))
    refined, _ = refine_map(world.folder, [world.flight()], SETTINGS)
    assert refined.keyframes.names[8] == "blank" and np.diff(refined.keyframes.offset)[8] == 0
    assert len(colmap.to_arrays(colmap.read(world.folder / "sparse")).names) > 9


def test_the_old_map_is_kept_whole_and_other_files_stay(world):
    old = {p.name: p.read_bytes() for p in world.folder.iterdir() if p.is_file()}
    _, result = refine_map(world.folder, [world.flight()], SETTINGS)
    assert result.kept == world.folder.with_name("room.before")
    assert {p.name: p.read_bytes() for p in result.kept.iterdir() if p.is_file()} == old
    assert len(store.load(result.kept).keyframes) == 8 and (result.kept / "sparse").is_dir()
    assert (world.folder / "floorplan.yaml").is_file()


def test_a_new_folder_leaves_the_map_alone_and_has_its_floor_plan(world, tmp_path):
    old = {p.name: p.read_bytes() for p in world.folder.iterdir() if p.is_file()}
    refined, result = refine_map(world.folder, [world.flight()], SETTINGS, tmp_path / "new")
    assert result.kept is None and refined.info.name == "new"
    assert {p.name: p.read_bytes() for p in world.folder.iterdir() if p.is_file()} == old
    assert (tmp_path / "new" / "floorplan.yaml").is_file()
    assert len(store.load(tmp_path / "new").keyframes) == len(refined.keyframes)


def test_ctrl_c_leaves_the_old_map_whole(world, monkeypatch):
    old = {p.name: p.read_bytes() for p in world.folder.iterdir() if p.is_file()}
    calls = []

    def adjust(*_, **__):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return False

    monkeypatch.setattr(colmap, "adjust", adjust)
    with pytest.raises(KeyboardInterrupt):
        refine_map(world.folder, [world.flight()], SETTINGS)
    assert {p.name: p.read_bytes() for p in world.folder.iterdir() if p.is_file()} == old
    assert [p.name for p in world.folder.parent.iterdir()] == ["room"]


@pytest.mark.parametrize("exchange", [True, False])
def test_a_map_is_there_whenever_the_program_is_killed(world, exchange, monkeypatch):
    """Killed at every step of the replacement, with the system's exchange and without it."""
    monkeypatch.setattr(folder, "_exchange", folder._exchange if exchange else lambda *_: False)
    rename, seen = Path.rename, []

    def watched(self, target):
        seen.append((world.folder / "map.toml").is_file())
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", watched)
    refine_map(world.folder, [world.flight()], SETTINGS)
    # Without the exchange the name is free for a moment, and the map beside it.
    assert all(seen) if exchange else seen.count(False) == 1
    assert len(store.load(world.folder).keyframes) > 8
    assert len(store.load(world.folder.with_name("room.before")).keyframes) == 8


def test_a_program_killed_while_it_adjusts_leaves_the_old_map(world, tmp_path):
    save_observations(tmp_path / "f.safetensors", world.flight())
    old = {p.name: p.read_bytes() for p in world.folder.iterdir() if p.is_file()}
    script = (
        "import sys, time; from ground_station.mapping import refine\n"
        "def wait(*_): print('writing', flush=True); time.sleep(60)\n"
        "refine.store.save_tables = lambda *_, **__: wait()\n"
        "from ground_station import cli; cli.main(sys.argv[1:])\n"
    )
    args = ["map", "refine", str(world.folder), str(tmp_path / "f.safetensors")]
    process = subprocess.Popen(
        [sys.executable, "-c", script, *args], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert process.stdout is not None and process.stdout.readline() == "writing\n"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert {p.name: p.read_bytes() for p in world.folder.iterdir() if p.is_file()} == old
    refine_map(world.folder, [world.flight()], SETTINGS)  # what was left behind is no hindrance
    assert len(store.load(world.folder).keyframes) > 8


# What is refused


def test_sights_of_another_map_are_refused_by_name(world):
    flight = dataclasses.replace(world.flight(), landmarks_sha256="1" * 64, map="cellar")
    with pytest.raises(MapError, match=r"'flight' was localized in another map \('cellar'\)"):
        refine_map(world.folder, [flight], SETTINGS)
    assert [p.name for p in world.folder.parent.iterdir()] == ["room"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: {"wTc": f.wTc @ poses.exp([0, 0.3, 0, 0, 0, 0])}, "misfit: 22"),
        (lambda f: {"wTc": _far(f.wTc)}, "few sights: 24"),
        (lambda f: {"landmark": f.landmark + 100_000}, "few sights: 24"),
        (lambda f: {"time_ns": f.time_ns * 100}, "no velocity: 24"),
    ],
)
def test_a_flight_that_does_not_fit_is_refused_with_the_reason(world, change, words):
    flight = world.flight()
    camera = dataclasses.replace(flight.camera, readout_s=0.02)
    flight = dataclasses.replace(flight, camera=camera, **change(flight))
    with pytest.raises(MapError, match=words) as caught:
        refine_map(world.folder, [flight], SETTINGS)
    assert "\n" not in str(caught.value) and "'flight'" in str(caught.value)


def _far(wTc):
    moved = wTc.copy()
    moved[:, :3, 3] = 1e300
    return moved


def test_an_empty_flight_and_a_map_without_sights_are_refused(world):
    empty = dataclasses.replace(
        world.flight(),
        time_ns=np.empty(0, np.int64),
        wTc=np.empty((0, 4, 4)),
        offset=np.zeros(1, np.int64),
        landmark=np.empty(0, np.int64),
        pixel_px=np.empty((0, 2), np.float32),
    )
    save_observations(world.folder.with_name("empty"), empty)
    empty = load_observations(world.folder.with_name("empty"))
    with pytest.raises(MapError, match="no frame that could be added"):
        refine_map(world.folder, [empty], SETTINGS)
    none = store.Keyframes(
        [], empty.time_ns, empty.wTc, empty.offset, np.empty(0, np.int32), empty.pixel_px
    )
    store.save_tables(world.folder, dataclasses.replace(world.map, keyframes=none))
    with pytest.raises(MapError, match="no keyframes' sights"):
        refine_map(world.folder, [], SETTINGS)


@pytest.mark.parametrize(
    "table",
    [
        {"flights": [{"name": "x", "frames": 99}]},
        {"flights": [{"name": "x", "frames": -1}]},
        {"flights": [{"name": 3, "frames": 1}]},
        {"flights": "many"},
        {"runs": "one"},
        {"pixels_at": "noon"},
        {"landmarks_sha256": 3},
    ],
)
def test_a_map_whose_table_is_wrong_is_refused(world, table):
    store.save_tables(
        world.folder,
        dataclasses.replace(world.map, info=dataclasses.replace(world.map.info, refined=table)),
    )
    with pytest.raises(MapError, match="the table 'refined'"):
        refine_map(world.folder, [], SETTINGS)


# Rolling shutter, and which frames are taken


def test_twists_are_those_of_the_motion():
    xi = np.array([0.1, -0.3, 0.2, 0.5, -0.1, 0.9])
    t_s = np.array([0.0, 0.03, 0.07, 0.1, 0.13, 0.17, 0.9])
    wTc = np.array([poses.exp([0, 0, 1, 2, 3, 4]) @ poses.exp(xi * t) for t in t_s])
    found = shutter.twists(np.round(t_s * 1e9).astype(np.int64), wTc, 0.05, 0.2)
    assert np.allclose(found[1:5], xi, atol=1e-6)
    assert np.isnan(found[[0, 5, 6]]).all()  # the last before a gap has no other side


def test_a_moving_frames_pixels_go_where_a_global_shutter_saw_them(world):
    rng = np.random.default_rng(0)
    camera = dataclasses.replace(world.map.info.camera, readout_s=0.02)
    t_s, speed = 1.0, 3.0
    wTc = _along(np.array([t_s]), speed)[0]
    index, rolling = _seen(world.points, wTc, camera, rng, 0.0, speed, t_s)
    around = np.array([t_s - 0.02, t_s, t_s + 0.02])
    twist = shutter.twists((around * 1e9).astype(np.int64), _along(around, speed), 0.03, 0.1)[1]
    local = poses.transform(poses.inverse(wTc), world.points[index])
    shift = shutter.shift_px(
        local, np.tile(twist, (len(local), 1)), shutter.row_times_s(rolling[:, 1], camera), camera
    )
    exact = camera.undistort_to_pinhole(camera.project(local))
    off = np.linalg.norm(camera.undistort_to_pinhole(rolling) - exact, axis=1)
    mended = np.linalg.norm(camera.undistort_to_pinhole(rolling) - shift - exact, axis=1)
    assert off.max() > 1.0 and mended.max() < 0.05


def test_a_maps_own_shutter_is_undone_once_and_not_where_there_was_none(world):
    """Keyframes taken at 3 m/s, 40 ms apart, with 20 ms of readout; without a flight."""
    rng = np.random.default_rng(2)
    camera = dataclasses.replace(world.map.info.camera, readout_s=0.02)
    t_s, speed = 0.04 * np.arange(16), 3.0
    wTc = _to_and_fro(t_s, speed)
    rows = [
        _seen(world.points, T, camera, rng, 0.1, speed, t, _to_and_fro)
        for T, t in zip(wTc, t_s.tolist(), strict=True)
    ]
    keyframes = store.Keyframes(
        [f"k{k}" for k in range(len(t_s))],
        np.round(t_s * 1e9).astype(np.int64),
        wTc,
        np.cumsum([0, *(len(index) for index, _ in rows)]),
        np.concatenate([index for index, _ in rows]).astype(np.int32),
        np.concatenate([pixel for _, pixel in rows]).astype(np.float32),
    )
    info = dataclasses.replace(world.map.info, camera=camera)
    store.save_tables(world.folder, dataclasses.replace(world.map, info=info, keyframes=keyframes))
    first, result = refine_map(world.folder, [], SETTINGS)
    shutter_report = result.report["rolling_shutter"]
    assert shutter_report["undone"] and shutter_report["keyframes"] == 14
    assert shutter_report["sigma_without_px"] < 0.7 * shutter_report["sigma_with_px"]
    assert Refined.of(first).pixels_at == "frame"
    second, again = refine_map(world.folder, [], SETTINGS)
    assert again.report["rolling_shutter"] == {"keyframes": 0, "undone": True}
    assert np.abs(second.keyframes.pixel_px - first.keyframes.pixel_px).max() < 1e-3
    # Sights that a global shutter took are not spoilt by a readout that the camera file claims.
    rows = [_seen(world.points, T, camera, rng, 0.1) for T in wTc]
    keyframes = dataclasses.replace(
        keyframes,
        offset=np.cumsum([0, *(len(index) for index, _ in rows)]),
        landmark=np.concatenate([index for index, _ in rows]).astype(np.int32),
        pixel_px=np.concatenate([pixel for _, pixel in rows]).astype(np.float32),
    )
    store.save_tables(world.folder, dataclasses.replace(world.map, info=info, keyframes=keyframes))
    _, result = refine_map(world.folder, [], SETTINGS)
    assert not result.report["rolling_shutter"]["undone"]


def test_frames_are_thinned_by_what_changed(world):
    flight, settings = world.flight(60, rate_hz=30.0), RefineSettings()
    chosen = choose_frames(flight, world.map, settings)
    assert 2 <= len(chosen) <= 8
    assert np.diff(chosen.time_ns).min() >= settings.min_interval_s * 1e9
    assert chosen.left["view unchanged"] == 60 - len(chosen) - chosen.left["no velocity"]
    still = dataclasses.replace(flight, wTc=np.tile(flight.wTc[:1], (60, 1, 1)))
    assert len(choose_frames(still, world.map, dataclasses.replace(settings, max_misfit_px=99))) < 2
    fewer = thin([chosen, chosen], 4)
    assert sum(map(len, fewer)) <= 4
    assert all(set(f.frame.tolist()) == set(range(len(f))) for f in fewer)


def test_a_frame_too_fast_for_its_readout_is_left_out(world):
    camera = dataclasses.replace(world.map.info.camera, readout_s=0.02)
    flight = dataclasses.replace(world.flight(30, rate_hz=30.0), camera=camera)
    slow = choose_frames(flight, world.map, RefineSettings())
    hurried = dataclasses.replace(flight, time_ns=flight.time_ns // 60)
    fast = choose_frames(hurried, world.map, RefineSettings(min_interval_s=0.0))
    assert len(slow) >= 2 and len(fast) == 0 and fast.left["too fast"] > 20


# The file


def test_observations_come_back_as_they_were(world, tmp_path):
    flight = world.flight()
    save_observations(tmp_path / "f.safetensors", flight)
    again = load_observations(tmp_path / "f.safetensors")
    for field in dataclasses.fields(flight):
        assert np.array_equal(getattr(again, field.name), getattr(flight, field.name))
    moved = dataclasses.replace(
        world.map.landmarks, position_m=world.map.landmarks.position_m + 1.0
    )
    assert landmarks_sha256(moved) == flight.landmarks_sha256
    other = dataclasses.replace(world.map.landmarks, id=world.map.landmarks.id + 1)
    assert landmarks_sha256(other) != flight.landmarks_sha256


def test_a_file_cut_anywhere_is_refused(world, tmp_path):
    path = tmp_path / "f.safetensors"
    save_observations(path, world.flight())
    whole = path.read_bytes()
    for length in [0, 1, 7, 8, 9, 100, len(whole) // 2, len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(MapError, match="no whole file of observations") as caught:
            load_observations(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: {"time_ns": f.time_ns[::-1].copy()}, "not in order of time"),
        (lambda f: {"time_ns": f.time_ns[:-1]}, "do not fit each other"),
        (lambda f: {"time_ns": f.time_ns + 2**62}, "out of range"),
        (lambda f: {"time_ns": f.time_ns.astype(np.float64)}, "'time_ns' must be int64"),
        (lambda f: {"wTc": f.wTc * np.nan}, "not finite"),
        (lambda f: {"wTc": f.wTc * 1.1}, "no rigid motion"),
        (lambda f: {"wTc": f.wTc[:, :3]}, r"'wTc' must be float64 \(N, 4, 4\)"),
        (lambda f: {"offset": f.offset[::-1].copy()}, "do not fit each other"),
        (lambda f: {"offset": f.offset - 1}, "do not fit each other"),
        (lambda f: {"pixel_px": f.pixel_px + 700}, "outside of the camera's 640x480"),
        (lambda f: {"pixel_px": f.pixel_px[:-1]}, "do not fit each other"),
        (lambda f: {"name": "two\nlines"}, "printable"),
        (lambda f: {"name": ""}, "printable"),
    ],
)
def test_hostile_files_are_refused_with_one_line(world, tmp_path, change, words):
    flight = world.flight()
    save_observations(tmp_path / "f.safetensors", dataclasses.replace(flight, **change(flight)))
    with pytest.raises(MapError, match=words) as caught:
        load_observations(tmp_path / "f.safetensors")
    assert "\n" not in str(caught.value) and "f.safetensors" in str(caught.value)


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        ({"format": "2"}, "format '2'; this program reads 1"),
        ({"kind": "other"}, "no whole file of observations"),
        ({"camera": "{"}, "camera in its metadata"),
        ({"camera": "[1]"}, "camera"),
        ({"camera": '{"fx_px": -1}'}, "fx_px"),
        ({"camera": '{"surprise": 1}'}, "surprise"),
    ],
)
def test_hostile_metadata_is_refused_with_one_line(world, tmp_path, metadata, words):
    from safetensors import safe_open
    from safetensors.numpy import save

    path = tmp_path / "f.safetensors"
    save_observations(path, world.flight())
    with safe_open(path, framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        told = dict(file.metadata())
    path.write_bytes(save(arrays, told | metadata))
    with pytest.raises(MapError, match=words) as caught:
        load_observations(path)
    assert "\n" not in str(caught.value)


def test_a_trajectory_given_by_mistake_gets_one_line_that_says_what_to_do(world, tmp_path, capsys):
    from ground_station import cli

    (tmp_path / "est.txt").write_text("# timestamp tx ty tz qx qy qz qw\n0.0 0 0 0 0 0 0 1\n")
    assert cli.main(["map", "refine", str(world.folder), str(tmp_path / "est.txt")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and "est.txt" in lines[0] and "--observations" in lines[0]


def test_the_command_tells_what_it_did(world, tmp_path, capsys):
    from ground_station import cli

    save_observations(tmp_path / "f.safetensors", world.flight())
    args = ["map", "refine", str(world.folder), str(tmp_path / "f.safetensors")]
    assert cli.main([*args, "--json", str(tmp_path / "r.json")]) == 0
    shown, report = capsys.readouterr().out, json.loads((tmp_path / "r.json").read_text())
    assert "flight flight" in shown and "room.before" in shown and "registering again" in shown
    flight = report["flights"][0]
    assert flight["median_px"] < flight["median_before_px"] and report["sights_dropped"] >= 0
    assert cli.main(["map", "info", str(world.folder)]) == 0
    assert f"flight ({flight['frames']} frames)" in capsys.readouterr().out
    for out in (world.folder, tmp_path / "absent" / "new"):
        assert cli.main([*args, "--out", str(out)]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
