"""Flights join a map: what it did not know comes in, what it knew stays where it was."""

from __future__ import annotations

import dataclasses

import numpy as np
from corridor_light import MAPPED_M, RATE_HZ, SETTINGS, extended, unit

from ground_station.geometry import poses
from ground_station.localization.settings import load_preset
from ground_station.map import colmap, store
from ground_station.map.folder import content_id
from ground_station.map.refined import Refined
from ground_station.map_update.extension.extend import extend_map
from ground_station.map_update.extension.localizing import localize
from ground_station.mapping.refinement.refine import refine_map


def _localized(world, map_, name):
    return localize(world.flights[name], map_, load_preset("default"), rate_hz=RATE_HZ)


def test_nothing_that_was_there_moves_or_changes_its_look(by_sunset):
    old, new, _ = by_sunset
    count = len(old.landmarks)
    for name in ("id", "position_m", "covariance_m2", "spread"):
        assert np.array_equal(getattr(new.landmarks, name)[:count], getattr(old.landmarks, name))
    rows = new.landmarks.descriptor.values[:count]
    assert np.array_equal(rows, old.landmarks.descriptor.values)
    kf, observations = old.keyframes, len(old.keyframes.landmark)
    assert new.keyframes.names[: len(kf)] == kf.names
    for name, end in (("wTc", len(kf)), ("time_ns", len(kf)), ("offset", len(kf) + 1)):
        assert np.array_equal(getattr(new.keyframes, name)[:end], getattr(kf, name))
    for name in ("landmark", "pixel_px"):
        assert np.array_equal(getattr(new.keyframes, name)[:observations], getattr(kf, name))
    assert new.info.registration == old.info.registration and new.info.frame == "world"
    assert (new.landmarks.observations[:count] >= old.landmarks.observations).all()
    assert new.landmarks.observations.sum() == len(new.keyframes.landmark)


def test_what_looks_otherwiseby_sunset_gets_that_look_as_a_mode(by_sunset, _corridor_world):
    world, (_, new, result) = _corridor_world, by_sunset
    point = world.points_of(new)
    modes = new.modes
    assert modes is not None and len(modes) == result.report["modes"][1]
    of = point[modes.landmark]
    right = world.corridor.turns[of]
    assert right.mean() > 0.97
    cosine = np.sum(modes.descriptor[:] * world.corridor.sunset[of], axis=1)
    assert np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1)))) < 8.0
    # Of the landmarks that turned and that the flight passed, nearly all.
    x_m = world.corridor.points[point, 0]
    passed = world.corridor.turns[point] & (x_m > 2.0) & (x_m < 5.5)
    passed &= np.arange(len(point)) < result.report["landmarks"][0]
    assert np.isin(np.flatnonzero(passed), modes.landmark).mean() > 0.8
    assert len(np.unique(modes.landmark)) == len(modes)  # one look each


def test_what_is_seenby_sunset_only_becomes_landmarks_once(by_sunset, _corridor_world):
    world, (old, new, _) = _corridor_world, by_sunset
    count = len(old.landmarks)
    point = world.points_of(new)
    added = new.landmarks.position_m[count:]
    off_m = np.linalg.norm(added - world.corridor.points[point[count:]], axis=1)
    assert len(added) > 30 and np.median(off_m) < 0.02
    # The others are at the ends, where too few keyframes of the map saw them.
    assert world.corridor.late[point[count:]].mean() > 0.7
    # No point is there twice, neither among the new ones nor beside an old one.
    assert len(np.unique(point[count:])) >= 0.97 * len(added)
    assert np.isin(point[count:], point[:count]).mean() < 0.03
    assert len(np.unique(new.landmarks.id)) == len(new.landmarks)


def test_another_sunset_flight_is_localized_better_and_a_noon_flight_as_before(
    by_sunset, corridor_world
):
    old, new, _ = by_sunset
    observations = {}
    for name in ("again", "noon"):
        for when, map_ in (("before", old), ("after", new)):
            flight = _localized(corridor_world, map_, name)
            truth = corridor_world.truth[name]
            at = np.round(flight.seen.time_ns / 1e9 * RATE_HZ).astype(int)
            off_m = np.linalg.norm(flight.seen.wTc[:, :3, 3] - truth[at, :3, 3], axis=1)
            assert np.median(off_m) < 0.03
            assert len(flight.seen) >= 0.8 * len(truth)
            observations[name, when] = np.mean(np.diff(flight.seen.offset))
    assert observations["again", "after"] > 1.5 * observations["again", "before"]
    assert observations["noon", "after"] >= 0.97 * observations["noon", "before"]


def test_everything_in_the_folder_fits_together(by_sunset):
    old, new, result = by_sunset
    model = colmap.to_arrays(colmap.read(new.folder / "sparse"))
    assert model.names == new.keyframes.names
    assert np.array_equal(model.point_id, new.landmarks.id)
    assert np.allclose(model.wTc, new.keyframes.wTc, atol=1e-9)
    assert np.allclose(model.position, new.landmarks.position_m, atol=1e-9)
    assert len(model.point) == len(new.keyframes.landmark)
    assert (new.folder / "floorplan.yaml").is_file()
    run = new.info.extended["runs"][-1]
    assert run["flights"][0]["input"] == "sunset" and run["time"].endswith("+00:00")
    assert run["bytes"] == result.report["bytes"] and run["bytes"][1] > run["bytes"][0] > 0
    assert run["keyframes"][1] == len(new.keyframes)
    assert run["of"] == content_id(old.folder) != content_id(new.folder)
    groups = Refined.of(new).groups(len(new.keyframes))
    assert (groups == 1).sum() == run["flights"][0]["frames"]


def test_new_frames_see_their_landmarks_where_they_are(by_sunset, _corridor_world):
    old, new, _ = by_sunset
    kf, count = new.keyframes, len(old.keyframes)
    camera = new.info.camera
    for k in range(count, len(kf)):
        rows = slice(kf.offset[k], kf.offset[k + 1])
        points = new.landmarks.position_m[kf.landmark[rows]]
        seen = camera.project(poses.transform(poses.inverse(kf.wTc[k]), points))
        off = np.linalg.norm(seen - kf.pixel_px[rows], axis=1)
        assert off.max() < 3.0 and np.median(off) < 0.8
    truth = _corridor_world.truth["sunset"]
    at = np.round(kf.time_ns[count:] / 1e9 * RATE_HZ).astype(int)
    off_m = np.linalg.norm(kf.wTc[count:, :3, 3] - truth[at, :3, 3], axis=1)
    assert np.median(off_m) < 0.01 and off_m.max() < 0.05


def test_a_flight_into_another_wing_is_chained_to_the_map(corridor_world, tmp_path):
    world = corridor_world
    old, new, result = extended(world, tmp_path / "both", world.flights["wing"])
    flight = result.report["flights"][0]
    assert flight["frames_not_localized"] >= 5
    kf, count = new.keyframes, len(old.keyframes)
    at = np.round(kf.time_ns[count:] / 1e9 * RATE_HZ).astype(int)
    truth = world.truth["wing"][at]
    assert truth[-1, 0, 3] > 12.5 > MAPPED_M + 4
    off_m = np.linalg.norm(kf.wTc[count:, :3, 3] - truth[:, :3, 3], axis=1)
    assert off_m.max() < 0.15
    added = new.landmarks.position_m[len(old.landmarks) :]
    off_m = np.linalg.norm(
        added - world.corridor.points[world.points_of(new)[len(old.landmarks) :]], axis=1
    )
    assert (added[:, 0] > MAPPED_M + 3).sum() > 100 and np.median(off_m) < 0.06
    # It looks the same there: nothing gets a second look.
    assert result.report["modes"][1] <= 0.03 * len(old.landmarks)
    # And now the wing is part of the map.
    assert len(_localized(world, new, "elsewhere").seen) >= 5


def test_what_a_map_was_extended_by_survives_refining(by_sunset, tmp_path):
    _, new, _ = by_sunset
    refined, _ = refine_map(new.folder, (), SETTINGS, out=tmp_path / "refined")
    again = store.load(tmp_path / "refined")
    assert refined.modes is not None and again.modes is not None
    kept = np.isin(new.landmarks.id, again.landmarks.id)
    modes = new.modes.among(kept)
    assert np.array_equal(again.modes.landmark, modes.landmark)
    assert np.array_equal(
        again.landmarks.id[again.modes.landmark], new.landmarks.id[kept][modes.landmark]
    )
    assert np.allclose(unit(again.modes.descriptor[:]), modes.descriptor[:], atol=1e-6)


def test_a_landmark_has_no_more_modes_than_it_may(corridor_world, short_flight, tmp_path):
    none = dataclasses.replace(SETTINGS, extend=dataclasses.replace(SETTINGS.extend, max_modes=0))
    out = tmp_path / "none"
    _, result = extend_map(corridor_world.folder, [short_flight], none, out=out, rate_hz=RATE_HZ)
    assert store.load(out).modes is None and result.report["modes"] == [0, 0]
    assert result.report["landmarks_without_room"] > 30


def test_a_second_flight_joins_what_the_first_one_left(by_sunset, corridor_world, tmp_path):
    _, one, _ = by_sunset
    out = tmp_path / "second"
    extend_map(one.folder, [corridor_world.flights["noon"]], SETTINGS, out=out, rate_hz=RATE_HZ)
    both = store.load(out)
    runs = both.info.extended["runs"]
    assert [run["flights"][0]["name"] for run in runs] == ["sunset", "noon"]
    assert runs[1]["landmarks"][0] == runs[0]["landmarks"][1] == len(one.landmarks)
    # A noon flight teaches a noon map's landmarks no other looks, only what sunset added, and takes
    # none of those it has.
    taught = np.setdiff1d(both.modes.landmark, one.modes.landmark)
    assert (taught >= runs[0]["landmarks"][0]).all()
    assert np.isin(one.modes.landmark, both.modes.landmark).all()
    assert len(both.landmarks) <= 1.03 * len(one.landmarks)
