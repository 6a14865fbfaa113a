"""The steps of extending, each by itself: tracks, points, cones, and what is never seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from corridor_light import CAMERA
from hand_made import NO_KEYFRAMES, model_of

from ground_station.geometry import poses
from ground_station.map import landmarks, store
from ground_station.map_update.extension.extend import never_seen
from ground_station.map_update.extension.tracks import joined, triangulate
from ground_station.mapping.sfm.adjustment import adjust_among_fixed


def test_matches_become_tracks_and_a_track_is_once_in_a_frame():
    offset = np.array([0, 10, 20, 30])
    verified = [
        ((0, 1), np.array([[0, 0], [1, 1], [2, 2]], np.int32)),
        ((1, 2), np.array([[0, 5], [1, 6], [3, 7]], np.int32)),
        # Feature 1 of frame 0 is 8 of frame 2 as well as 6, by way of frame 1.
        ((0, 2), np.array([[1, 8]], np.int32)),
    ]
    tracks = joined(offset, verified)
    found = {}
    for frame, feature, track in zip(
        tracks.frame.tolist(), tracks.feature.tolist(), tracks.track.tolist(), strict=True
    ):
        found.setdefault(track, set()).add((frame, feature))
    assert sorted(map(sorted, found.values())) == [
        [(0, 0), (1, 0), (2, 5)],
        [(0, 1), (1, 1)],
        [(0, 2), (1, 2)],
        [(1, 3), (2, 7)],
    ]
    assert tracks.count == 4 and (np.diff(tracks.track) >= 0).all()


def test_no_matches_are_no_tracks():
    tracks = joined(np.array([0, 5, 9]), [])
    assert tracks.count == 0 and len(tracks.frame) == 0


def _seen(points, wTc, noise_px=0.0, seed=0):
    """A model in which every camera sees every point."""
    pinhole = np.array([CAMERA.fx_px, CAMERA.fy_px, CAMERA.cx_px, CAMERA.cy_px])
    image, point = (part.ravel() for part in np.indices((len(wTc), len(points))))
    pairs = np.stack([image, point], axis=1).tolist()
    local = np.array([poses.transform(poses.inverse(wTc[k]), points[m][None])[0] for k, m in pairs])
    pixel = local[:, :2] / local[:, 2:] * pinhole[:2] + pinhole[2:]
    pixel += noise_px * np.random.default_rng(seed).normal(size=pixel.shape)
    return model_of(CAMERA, wTc, points, image=image, feature=point, point=point, pixel_px=pixel)


def _aside(*steps_m):
    return [poses.pose(np.eye(3), [x, 0.0, 0.0]) for x in steps_m]


def test_points_are_where_their_rays_meet_and_those_without_an_angle_are_not_known():
    points = np.array([[0.3, 0.2, 3.0], [-0.5, 0.1, 5.0], [0.0, 0.0, 2000.0], [1.0, -0.5, 4.0]])
    model = _seen(points, _aside(0.0, 0.3, 0.6, 0.9))
    spoiled = model.pixel_px.copy()
    spoiled[(model.image == 3) & (model.point == 3)] += [300.0, 40.0]
    model = replace(model, pixel_px=spoiled, position=np.full((4, 3), np.nan))
    found, good = triangulate(model, 4.0, 1.5)
    assert good.tolist() == [True, True, False, False]
    assert np.allclose(found.position[:2], points[:2], atol=1e-6)


def test_a_observation_that_is_off_a_little_is_left_out_of_its_point():
    points = np.array([[0.3, 0.2, 3.0]])
    model = _seen(points, _aside(0.0, 0.2, 0.4, 0.6, 0.8, 1.0))
    off = model.pixel_px.copy()
    off[2] += [0.0, 12.0]
    found, good = triangulate(replace(model, pixel_px=off), 4.0, 1.5)
    assert good.all() and np.allclose(found.position, points, atol=1e-6)


def test_what_is_fixed_does_not_move_by_a_bit_and_the_rest_finds_its_place():
    rng = np.random.default_rng(2)
    points = rng.uniform([-1, -1, 3], [2, 1, 6], (60, 3))
    true = _seen(points, _aside(0.0, 0.3, 0.6), 0.1)
    fixed = np.arange(60) < 40
    position, wTc = points.copy(), true.wTc.copy()
    position[~fixed] += rng.normal(0, 0.03, (20, 3))
    wTc[1:] = [T @ poses.exp(rng.normal(0, 0.01, 6)) for T in wTc[1:]]
    model = replace(true, position=position, wTc=wTc)
    images = np.array([True, False, False])
    moved, found = adjust_among_fixed(model, fixed, images, CAMERA, loss_px=1.0, threads=1)
    assert np.array_equal(found[fixed], points[fixed]) and np.array_equal(moved[0], wTc[0])
    assert np.linalg.norm(moved[1:, :3, 3] - true.wTc[1:, :3, 3], axis=1).max() < 0.002
    assert np.median(np.linalg.norm(found - points, axis=1)[~fixed]) < 0.01


@pytest.fixture
def seen_from_the_front():
    """Landmarks seen by three cameras a step apart."""
    points = np.random.default_rng(3).uniform([-0.5, -0.5, 3], [0.5, 0.5, 5], (30, 3))
    model = _seen(points, _aside(-0.2, 0.0, 0.2), 0.3)
    return landmarks.make_landmarks(model, np.ones((90, 4), np.float32))


def test_cones_and_distances_hold_the_old_observations_and_the_new(seen_from_the_front):
    lm = seen_from_the_front
    shown = np.array([4, 4, 9])
    at = np.array([[2.0, 0.3, 1.0], [2.2, 0.3, 0.0], [0.1, 0.0, -6.0]])
    again = landmarks.seen_again(lm, shown, at)
    for name in ("id", "position_m", "covariance_m2", "descriptor", "spread"):
        assert np.array_equal(getattr(again, name), getattr(lm, name))
    others = ~np.isin(np.arange(30), shown)
    for name in ("view_direction", "view_cos", "distance_m", "observations"):
        assert np.array_equal(getattr(again, name)[others], getattr(lm, name)[others])
    assert again.observations[[4, 9]].tolist() == [5, 4]
    old = np.array([[-0.2, 0, 0], [0, 0, 0], [0.2, 0, 0]])
    for m, places in ((4, [*old, *at[:2]]), (9, [*old, at[2]])):
        rays = np.array(places) - lm.position_m[m]
        distance = np.linalg.norm(rays, axis=1)
        cosine = rays @ again.view_direction[m] / distance
        assert cosine.min() >= again.view_cos[m] - 1e-5
        near, far = again.distance_m[m]
        assert near <= distance.min() + 1e-5 and far >= distance.max() - 1e-5
        assert np.isclose(np.linalg.norm(again.view_direction[m]), 1, atol=1e-6)
    assert again.view_cos[4] < lm.view_cos[4] and again.distance_m[9, 1] > 8


def test_what_is_often_in_view_and_never_seen_is_counted(seen_from_the_front):
    lm = seen_from_the_front
    info = store.MapInfo("corridor", "c" * 64, 4, CAMERA)
    map_ = store.Map(info, lm, NO_KEYFRAMES)
    seen = np.arange(0, 30, 2)
    cameras = np.array(_aside(*np.linspace(-0.1, 0.1, 10)))
    assert never_seen(map_, cameras, seen, 10) == {"expected": 30, "never_seen": 15}
    assert never_seen(map_, cameras, seen, 11) == {"expected": 0, "never_seen": 0}
    behind = cameras @ poses.pose(np.diag([-1.0, 1.0, -1.0]), [0, 0, 0])
    assert never_seen(map_, behind, seen, 1) == {"expected": 0, "never_seen": 0}
