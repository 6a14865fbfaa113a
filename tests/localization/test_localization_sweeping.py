"""Where a picture shows mostly one far wall, near landmarks say where the camera is, or nobody."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from synthetic import landmarks_at

from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.localization import sweeping
from ground_station.localization.acquisition import Acquirer
from ground_station.localization.attempt import Conditions, Stopwatch
from ground_station.localization.estimator import make_estimator
from ground_station.localization.matching import Matcher, describe
from ground_station.localization.settings import load_preset

TRUE = np.eye(4)
STEP = np.array([0.0, np.deg2rad(1.5), 0.0, -20.0 * np.tan(np.deg2rad(1.5)), 0.0, 0.0])
"""A turn, and a step aside that hides it from what is 20 m off."""
FAR, NEAR = 300, 60


@pytest.fixture
def hall(room: Any) -> Any:
    """A far wall in the middle of the picture, and a few near landmarks to its sides."""
    rng = np.random.default_rng(3)
    far = np.column_stack(
        [rng.uniform(-3.5, 3.5, FAR), rng.uniform(-3, 3, FAR), np.full(FAR, 20.0)]
    )
    side = rng.choice([-1.0, 1.0], NEAR) * rng.uniform(1.0, 2.0, NEAR)
    near = np.column_stack([side, rng.uniform(-1.5, 1.5, NEAR), rng.uniform(4, 6, NEAR)])
    count = FAR + NEAR
    landmarks = landmarks_at(
        np.concatenate([far, near]),
        room.map.landmarks.descriptor[:count],
        view_cos=np.full(count, -1.0, np.float32),
        distance_m=np.tile([0.1, 100.0], (count, 1)).astype(np.float32),
    )
    return dataclasses.replace(room, map=dataclasses.replace(room.map, landmarks=landmarks))


def located(hall: Any, extractor: Any, seen: np.ndarray) -> tuple[float, float]:
    """How far off a frame of the landmarks `seen` is solved from a wrong find, and its sigma, m."""
    points, descriptors = hall.map.landmarks.position_m, hall.map.landmarks.descriptor
    wrong = TRUE @ poses.exp(STEP)
    chance = np.arange(FAR, FAR + 6)  # near ones that others look like, where they fit it
    pixel = np.concatenate(
        [
            hall.camera.project(poses.transform(poses.inverse(wTc), points[rows]))
            for wTc, rows in ((TRUE, seen), (wrong, chance))
        ]
    )
    pixel += hall.rng.normal(0, 0.5, pixel.shape)
    rows = np.concatenate([seen, chance])
    features = Features(pixel.astype(np.float32), np.ones(len(rows), np.float32), descriptors[rows])
    settings = load_preset("default")
    acquirer = Acquirer(hall.map, Matcher(hall.map, hall.camera, settings), extractor, settings)
    estimator = make_estimator(hall.camera, settings)
    angle = np.deg2rad(5.0)
    estimator.restart(0, wrong, np.diag(np.repeat([angle, 20.0 * angle], 3) ** 2))
    found = acquirer.locate(
        describe(features, hall.camera, Conditions()),
        estimator.predict(0), estimator, Stopwatch(), 15.0,
    )  # fmt: skip
    state = found.solution.state
    assert state is not None
    sigma = float(np.sqrt(np.trace(state.covariance[3:6, 3:6])))
    return float(np.linalg.norm(state.wTc[:3, 3])), sigma


def test_near_landmarks_that_are_seen_hold_the_pose(hall, extractor):
    off, sigma = located(hall, extractor, np.arange(FAR + NEAR))
    assert off < 0.05 and sigma < 0.05


def test_without_them_a_pose_is_as_open_as_the_wall_leaves_it(hall, extractor, monkeypatch):
    """Where chance finds more along it, six by chance do not make a place half a metre off sure."""
    counts = Matcher.counts

    def with_more_elsewhere(self, seen, wTc, nearer_than):
        here, _, *others = counts(self, seen, wTc, nearer_than)
        return [here, 4 * here, *others]

    monkeypatch.setattr(Matcher, "counts", with_more_elsewhere)
    off, sigma = located(hall, extractor, np.arange(FAR))
    assert sigma > 0.1 and off < 4 * sigma


def test_where_no_pose_shows_any_near_landmark_the_find_stays(hall, extractor, monkeypatch):
    monkeypatch.setattr(Matcher, "counts", lambda self, seen, wTc, near: [0] * len(wTc))
    off, sigma = located(hall, extractor, np.arange(FAR))
    assert sigma < 0.05 < off


def test_a_turn_counts_as_the_step_aside_that_it_looks_like():
    sigma = np.diag([1e-4, 0.02, 1e-4, 0.01, 0.1, 0.01]) ** 2
    assert sweeping.weakest(sigma, 20.0) == pytest.approx(np.array([0, 0.02, 0, 0, 0, 0]), abs=1e-6)
    assert abs(sweeping.weakest(sigma, 2.0)[4]) == pytest.approx(0.1)


def test_poses_along_it_lie_to_both_sides_as_far_as_the_reach():
    swept = sweeping.along(TRUE, STEP / 6, moved_px=10.0, radius_px=5.0)
    assert len(swept) == 1 + 2 * 12 and swept[0] is TRUE
    assert swept[-2] == pytest.approx(TRUE @ poses.exp(STEP))
    assert swept[-1] == pytest.approx(TRUE @ poses.exp(-STEP))
    first = np.linalg.norm(poses.log(swept[1])[3:])
    assert first == pytest.approx(np.linalg.norm(STEP[3:]) / 12)
