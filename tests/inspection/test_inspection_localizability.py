"""What a camera would see of a map, and how well that fixes its pose."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from rooms_map import SIDE_M, looking, made_of, two_rooms, wall

from ground_station.errors import MapError
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.inspection import prediction
from ground_station.inspection.localizability import localizability
from ground_station.inspection.prediction import MOST, NEEDED, SIGMA_PX, Predictor, View, Visibility
from ground_station.localization.settings import load_preset
from ground_station.map.floorplan import FloorPlan
from ground_station.map.levelling import levelled


@pytest.fixture(scope="module")
def rooms():
    return two_rooms()


def test_what_the_localizer_needs_is_what_its_preset_says():
    preset = load_preset("default")
    assert preset.pose.sigma_px == SIGMA_PX
    assert preset.tracking.keyframe_min_points == NEEDED
    assert preset.pose.max_observations == MOST


def test_a_landmark_behind_a_wall_is_not_counted(rooms):
    visibility = Visibility(rooms)
    for room, x in ((0, 2.0), (1, SIDE_M + 2.0)):
        chance = visibility.chance([x, 3.0, 1.5])
        mine, other = np.split(chance, 2)[:: 1 if room == 0 else -1]
        looked_at = mine[mine > 0.5]
        assert len(looked_at) > 100  # nine keyframes saw the middle of this wall from near here
        assert other.max() < 0.15


def test_chances_follow_how_often_a_landmark_was_found():
    rng = np.random.default_rng(1)
    position = wall(rng, SIDE_M, 200)
    wTc = np.array([looking([2.0, 3.0, 1.5], 0.0)] * 10)
    local = poses.transform(poses.inverse(wTc[0]), position)
    shown = np.flatnonzero(View(THESIS_CAMERA).inside(local))
    often, seldom = shown[::2], shown[1::2]
    map_ = made_of(position, wTc, [shown if k < 2 else often for k in range(10)])
    chance = Visibility(map_).chance([2.0, 3.0, 1.5])
    assert np.allclose(chance[often], 10 / 11) and np.allclose(chance[seldom], 2 / 11)
    aside = Visibility(map_).chance([SIDE_M - 0.5, 0.1, 1.5])
    far = np.linalg.norm(position[shown] - [SIDE_M, 5.5, 1.5], axis=1) < 1.0
    assert aside[shown[far]].max() < 0.15  # nobody looked so obliquely, however often


def test_deviations_are_what_noise_does_to_a_pose():
    """Poses solved by OpenCV from noisy pixels of noisy landmarks scatter as predicted."""
    rng = np.random.default_rng(2)
    truth = looking([2.0, 3.0, 1.5], 12.0)
    ahead = np.column_stack([rng.uniform(-0.44, 0.44, (80, 2)), np.ones(80)])
    position = poses.transform(truth, ahead * rng.uniform(2, 7, (80, 1)))
    map_ = made_of(position, np.array([truth] * 60), [np.arange(80)] * 60)
    predicted = Predictor(map_).places(truth[None, :3, 3], truth[None, :3, :3])
    assert predicted.count[0, 0] == pytest.approx(80 * 60 / 61)
    K, sigma_m = THESIS_CAMERA.matrix, float(np.sqrt(map_.landmarks.covariance_m2[0, 0, 0]))
    cTw = poses.inverse(truth)
    turn, shift = cv2.Rodrigues(cTw[:3, :3])[0], cTw[:3, 3:].copy()
    found = []
    for _ in range(400):
        moved = position + sigma_m * rng.normal(size=position.shape)
        local = poses.transform(cTw, position)
        pixel = local[:, :2] / local[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
        pixel += SIGMA_PX * rng.normal(size=pixel.shape)
        r, t = cv2.solvePnPRefineLM(moved, pixel, K, None, turn.copy(), shift.copy())
        T = poses.inverse(poses.pose(cv2.Rodrigues(r)[0], t[:, 0]))
        found.append((T[:3, 3] - truth[:3, 3], poses.log(poses.inverse(truth) @ T)[:3]))
    moved_m, turned = (np.array(values) for values in zip(*found, strict=True))
    scatter_m = np.sqrt((moved_m**2).sum(axis=1).mean())
    scatter_deg = np.degrees(np.sqrt((turned**2).sum(axis=1).mean()))
    # OpenCV weighs all points alike, the prediction by their distances: a little less is possible.
    assert predicted.sigma_m[0, 0] == pytest.approx(scatter_m, rel=0.15)
    assert predicted.sigma_deg[0, 0] == pytest.approx(scatter_deg, rel=0.15)


def test_the_grid_says_where_a_camera_gets_lost(rooms):
    found = localizability(rooms, headings=4)
    p = found.prediction
    assert p.lost.shape == (len(found.place), 4)
    ahead = found.heading_deg.tolist().index(0.0)
    back = found.heading_deg.tolist().index(180.0)
    middle = (np.abs(found.place[:, 1] - 3) < 1) & (np.abs(found.place[:, 0] % SIDE_M - 2) < 1.2)
    assert middle.sum() > 5
    assert not p.lost[middle, ahead].any() and p.lost[:, back].all()
    assert (p.sigma_m[middle, ahead] < 0.1).all()
    summary = found.summary()
    assert summary["places_lost_in_some_heading"] == 1.0 and 0.5 < summary["share_lost"] < 1
    assert found.place[middle, 2] == pytest.approx(1.5)


def test_a_floor_plan_bounds_the_places(rooms):
    image = np.full((60, 120), 205, np.uint8)
    image[:, :60] = 254  # the first room only
    whole = localizability(rooms, headings=1)
    half = localizability(rooms, FloorPlan(image, 0.1, (0.0, 0.0, 0.0)), headings=1)
    assert half.place[:, 0].max() < SIDE_M + half.cell_m < whole.place[:, 0].max()
    elsewhere = localizability(rooms, FloorPlan(image, 0.1, (99.0, 99.0, 0.0)), headings=1)
    assert len(elsewhere.place) == len(whole.place)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"headings": 0}, "--headings is 0; allowed: 1 to 36"),
        ({"cell_m": 0.0}, "--cell-m is 0.0"),
        ({"cell_m": float("nan")}, "--cell-m is nan"),
        ({"cell_m": 1e-6}, "20000 cells at most"),
        ({"height_m": float("inf")}, "--height-m is inf"),
    ],
)
def test_what_is_out_of_range_gets_one_line(rooms, how, words):
    with pytest.raises(MapError, match=words) as caught:
        localizability(rooms, **how)
    assert "\n" not in str(caught.value)


def test_a_map_without_a_world_is_turned_upright(rooms):
    tilt = poses.exp([0.4, -0.9, 0.3, 5.0, 1.0, -2.0])
    kf, lm = rooms.keyframes, rooms.landmarks
    tilted = dataclasses.replace(
        rooms,
        info=dataclasses.replace(rooms.info, frame="sfm", units="arbitrary"),
        landmarks=dataclasses.replace(lm, position_m=poses.transform(tilt, lm.position_m)),
        keyframes=dataclasses.replace(kf, wTc=tilt @ kf.wTc),
    )
    upright = levelled(tilted)
    assert np.allclose(upright.keyframes.wTc[:, 2, 1], -1)  # the camera's y axis points down
    places = (upright.landmarks.position_m, lm.position_m)
    apart = [np.linalg.norm(p - p[0], axis=1) for p in places]
    assert np.allclose(*apart)
    shares = [localizability(m).summary()["share_lost"] for m in (rooms, upright)]
    assert abs(shares[0] - shares[1]) < 0.1  # another grid, the same building
    assert levelled(rooms) is rooms


def test_a_large_map_is_thinned_to_the_same_answer(rooms, monkeypatch):
    whole = Visibility(rooms)
    monkeypatch.setattr(prediction, "MOST_LANDMARKS", 200)
    monkeypatch.setattr(prediction, "MOST_KEYFRAMES", 9)
    few = Visibility(rooms)
    assert len(few.rows) == 200 and few.weight == 3
    place = [2.0, 3.0, 1.5]
    assert few.weight * few.chance(place).sum() == pytest.approx(whole.chance(place).sum(), rel=0.2)


def test_a_map_of_one_line_has_a_row_of_places(rooms):
    flat = dataclasses.replace(
        rooms,
        landmarks=dataclasses.replace(
            rooms.landmarks, position_m=rooms.landmarks.position_m * [1, 0, 1] + [0, 3, 0]
        ),
        keyframes=dataclasses.replace(rooms.keyframes, wTc=rooms.keyframes.wTc.copy()),
    )
    flat.keyframes.wTc[:, 1, 3] = 3.0
    found = localizability(flat, headings=1)
    assert found.shape[1] == 1 and 10 < found.shape[0] <= 600
