"""A map gets better by what flights saw of it, stays where it is, and is never half written."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hand_made import content
from refining import ROOT, SETTINGS, _along, _localized

from ground_station.errors import MapError
from ground_station.geometry import poses
from ground_station.geometry.alignment import align
from ground_station.map import colmap, folder, landmarks, store
from ground_station.map.observations import save_observations
from ground_station.map.refined import Refined
from ground_station.mapping.refinement import refine
from ground_station.mapping.refinement.refine import refine_map
from ground_station.mapping.settings import RefineSettings
from ground_station.mapping.sfm import adjustment


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


def test_the_loss_is_as_wide_as_the_noise_that_the_build_found(world, monkeypatch):
    losses, adjust = [], refine.adjust

    def noted(graph, map_, settings, on_round):
        losses.append(settings.sfm.loss_px)
        return adjust(graph, map_, settings, on_round)

    monkeypatch.setattr(refine, "adjust", noted)
    info = dataclasses.replace(world.map.info, built={"images": 8, "noise_px": 0.3})
    store.save_tables(world.folder, dataclasses.replace(world.map, info=info))
    refine_map(world.folder, [], SETTINGS)
    assert losses == [0.3] != [SETTINGS.sfm.loss_px]


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
    assert (
        loaded.info.refined["last"]["observations"]
        == result.report["observations"]
        == len(kf.landmark)
    )


def test_observations_that_do_not_fit_are_dropped_and_counted(world):
    flight = world.flight()
    rng = np.random.default_rng(1)
    wrong = rng.random(len(flight.landmark)) < 0.1
    pixel = flight.pixel_px.copy()
    pixel[wrong] = rng.uniform([0, 0], [639, 479], (int(wrong.sum()), 2))
    refined, result = refine_map(
        world.folder, [dataclasses.replace(flight, pixel_px=pixel)], SETTINGS
    )
    about = result.report["flights"][0]
    assert 0.06 < 1 - about["observations"] / about["observations_given"] < 0.16
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
    observations = np.diff(first.keyframes.offset)[8:]
    strict = dataclasses.replace(
        SETTINGS, refine=RefineSettings(min_observations=int(np.median(observations)) + 1)
    )
    second, result = refine_map(world.folder, [], strict)
    table = Refined.of(store.load(world.folder))
    assert 0 < result.report["frames_dropped"] == len(first.keyframes) - len(second.keyframes)
    assert table.flights[0]["frames"] == len(second.keyframes) - 8
    third, _ = refine_map(world.folder, [world.flight(seed=5, name="third")], SETTINGS)
    groups = Refined.of(store.load(world.folder)).groups(len(third.keyframes))
    third_names = [name.startswith("third/") for name in third.keyframes.names]
    assert third_names == (groups == 2).tolist()


def test_a_keyframe_and_landmarks_without_observations_are_no_hindrance(world):
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
    old = content(world.folder)
    _, result = refine_map(world.folder, [world.flight()], SETTINGS)
    assert result.kept == world.folder.with_name("room.before")
    assert content(result.kept) == old
    assert len(store.load(result.kept).keyframes) == 8
    assert (world.folder / "floorplan.yaml").is_file()


def test_a_new_folder_leaves_the_map_alone_and_has_its_floor_plan(world, tmp_path):
    old = content(world.folder)
    refined, result = refine_map(world.folder, [world.flight()], SETTINGS, tmp_path / "new")
    assert result.kept is None and refined.info.name == "new"
    assert content(world.folder) == old
    assert (tmp_path / "new" / "floorplan.yaml").is_file()
    assert len(store.load(tmp_path / "new").keyframes) == len(refined.keyframes)


def test_ctrl_c_leaves_the_old_map_whole(world, monkeypatch):
    old = content(world.folder)
    calls = []

    def adjust(*_, **__):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return False

    monkeypatch.setattr(adjustment, "adjust", adjust)
    with pytest.raises(KeyboardInterrupt):
        refine_map(world.folder, [world.flight()], SETTINGS)
    assert content(world.folder) == old
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
    old = content(world.folder)
    script = (
        "import sys, time; from ground_station.mapping.refinement import refine\n"
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
    assert content(world.folder) == old
    refine_map(world.folder, [world.flight()], SETTINGS)  # what was left behind is no hindrance
    assert len(store.load(world.folder).keyframes) > 8
