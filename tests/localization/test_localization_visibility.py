"""The index of landmarks leaves nothing out that the plain projection keeps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.localization.projection import Lens, project
from ground_station.localization.settings import ProjectionSettings
from ground_station.localization.visibility import LandmarkIndex
from ground_station.mapping.store import Landmarks


def _building(rng: np.random.Generator, count: int, side_m: float) -> Landmarks:
    direction = rng.normal(size=(count, 3)).astype(np.float32)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    near = rng.uniform(0.5, 2, count)
    return Landmarks(
        id=np.arange(count),
        position_m=rng.uniform(-0.5, 0.5, (count, 3)) * [side_m, side_m, 8.0],
        covariance_m2=np.zeros((count, 3, 3), np.float32),
        descriptor=np.zeros((count, 1), np.float32),
        spread=np.zeros(count, np.float32),
        view_direction=direction,
        view_cos=np.full(count, 0.3, np.float32),
        distance_m=np.stack([near, near + rng.uniform(1, 6, count)], axis=1).astype(np.float32),
        observations=np.full(count, 3, np.int32),
    )


@pytest.mark.parametrize("cone", [True, False])
@pytest.mark.parametrize(("side_m", "cell_m"), [(10.0, 2.0), (150.0, 2.0), (150.0, 0.7)])
def test_the_landmarks_are_those_of_the_plain_projection(room, cone, side_m, cell_m):
    rng = np.random.default_rng(21)
    landmarks = _building(rng, 40_000, side_m)
    index = LandmarkIndex(landmarks, cell_m)
    lens, settings = Lens(room.camera), ProjectionSettings(viewing_cone=cone)
    seen = 0
    for _ in range(40):
        wTc = poses.exp(
            np.r_[rng.normal(0, 1.5, 3), rng.normal(0, 1, 3) * [side_m / 6, side_m / 6, 2]]
        )
        plain = project(landmarks, wTc, lens, settings)
        among = index.near(wTc, lens, settings)
        indexed = project(landmarks, wTc, lens, settings, among)
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
    lens, settings = Lens(room.camera), ProjectionSettings(viewing_cone=True)
    both = [LandmarkIndex(landmarks) for landmarks in (small, large)]
    for _ in range(10):
        wTc = poses.exp(np.r_[rng.normal(0, 1, 3), rng.normal(0, 1, 3)])
        few, many = (len(index.near(wTc, lens, settings)) for index in both)
        assert few <= many <= 1.3 * few + 50
        assert many < 0.1 * len(large)


def test_an_index_of_nothing_sees_nothing(room):
    index = LandmarkIndex(_building(np.random.default_rng(0), 0, 10.0))
    assert len(index.near(np.eye(4), Lens(room.camera), ProjectionSettings())) == 0
