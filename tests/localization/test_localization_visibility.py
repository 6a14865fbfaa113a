"""The index of landmarks leaves nothing out that the plain projection keeps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic import keyframes_of, landmarks_at, unit_rows

from ground_station.geometry import poses
from ground_station.localization.settings import ProjectionSettings
from ground_station.localization.visibility import Covisibility, LandmarkIndex, project
from ground_station.map.store import Landmarks


def _building(rng: np.random.Generator, count: int, side_m: float) -> Landmarks:
    direction, near = unit_rows(rng, count, 3), rng.uniform(0.5, 2, count)
    return landmarks_at(
        rng.uniform(-0.5, 0.5, (count, 3)) * [side_m, side_m, 8.0],
        np.zeros((count, 1), np.float32),
        view_direction=direction,
        view_cos=np.full(count, 0.3, np.float32),
        distance_m=np.stack([near, near + rng.uniform(1, 6, count)], axis=1).astype(np.float32),
    )


@pytest.mark.parametrize("cone", [True, False])
@pytest.mark.parametrize("side_m", [10.0, 150.0])
def test_the_landmarks_are_those_of_the_plain_projection(room, cone, side_m):
    rng = np.random.default_rng(21)
    landmarks = _building(rng, 40_000, side_m)
    index = LandmarkIndex(landmarks)
    camera, settings = room.camera, ProjectionSettings(viewing_cone=cone)
    seen = 0
    for _ in range(40):
        wTc = poses.exp(
            np.r_[rng.normal(0, 1.5, 3), rng.normal(0, 1, 3) * [side_m / 6, side_m / 6, 2]]
        )
        plain = project(landmarks, wTc, camera, settings)
        among = index.near(wTc, camera, settings)
        indexed = project(landmarks, wTc, camera, settings, among)
        assert indexed.landmark.tolist() == plain.landmark.tolist()
        assert np.allclose(indexed.pinhole_px, plain.pinhole_px, atol=1e-9)
        seen += len(plain.landmark)
    assert seen > 200


def test_a_frame_looks_at_no_more_landmarks_when_the_building_grows(room):
    rng = np.random.default_rng(22)
    small = _building(rng, 10_000, 60.0)
    beyond = _building(rng, 90_000, 190.0)
    outside = np.flatnonzero(np.abs(beyond.position_m[:, :2]).max(axis=1) > 30.0)
    large = Landmarks(
        **{
            field.name: np.concatenate(
                [getattr(small, field.name), getattr(beyond, field.name)[outside]]
            )
            for field in dataclasses.fields(Landmarks)
        }
    )
    camera, settings = room.camera, ProjectionSettings(viewing_cone=True)
    both = [LandmarkIndex(landmarks) for landmarks in (small, large)]
    for _ in range(10):
        wTc = poses.exp(np.r_[rng.normal(0, 1, 3), rng.normal(0, 1, 3)])
        few, many = (len(index.near(wTc, camera, settings)) for index in both)
        assert few <= many <= 1.3 * few + 50
        assert many < 0.1 * len(large)


def test_an_index_of_nothing_sees_nothing(room):
    index = LandmarkIndex(_building(np.random.default_rng(0), 0, 10.0))
    assert len(index.near(np.eye(4), room.camera, ProjectionSettings())) == 0


def _keyframes(position_m, seen):
    """Keyframes at positions (K, 3) that all look along z, and the landmarks that each saw."""
    return keyframes_of(poses.pose(np.tile(np.eye(3), (len(seen), 1, 1)), position_m), seen)


def test_behind_the_wall_is_what_no_covisible_keyframe_saw():
    # Two rooms side by side: keyframes of one saw landmarks 0..99, of the other 100..199.
    here, there = np.arange(100), np.arange(100, 200)
    place = [[0, 0, 0], [1, 0, 0], [9, 0, 0], [10, 0, 0]]
    index = Covisibility(220, _keyframes(place, [here, here[:80], there, there[20:]]))
    everything = np.arange(220)
    assert index.covisible(here[:30], np.eye(4), everything).tolist() == here.tolist()
    assert index.covisible(np.empty(0, np.intp), np.eye(4), everything).tolist() == here.tolist()
    # Landmarks of the other room, seen through the door, bring its keyframes in; one does not.
    seen = np.r_[here[:30], there[:10]]
    assert index.covisible(seen, np.eye(4), everything).tolist() == list(range(200))
    seen = np.r_[here[:30], there[:1]]
    assert index.covisible(seen, np.eye(4), everything).tolist() == here.tolist()
    assert index.covisible(here[:30], np.eye(4), there).tolist() == there.tolist()  # too few left


def test_where_no_keyframe_is_near_or_shares_anything_nothing_is_left_out():
    index = Covisibility(300, _keyframes([[0, 0, 0]], [np.arange(100)]))
    backwards = poses.exp([0, np.pi, 0, 0, 0, 0])
    far = poses.exp([0, 0, 0, 50.0, 0, 0])
    everything, unseen = np.arange(300), np.arange(200, 230)
    for wTc in (backwards, far):
        assert index.covisible(unseen, wTc, everything).tolist() == everything.tolist()


def test_a_map_without_keyframes_leaves_nothing_out(room):
    index = Covisibility(len(room.map.landmarks), room.map.keyframes)
    everything = np.arange(len(room.map.landmarks))
    found = index.covisible(everything[:20], np.eye(4), everything)
    assert found.tolist() == everything.tolist()
