"""The simulated campus: as large as asked, gone through twice, nothing seen through walls."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.simulator.campus import CAMERA, campus


@pytest.fixture(scope="module")
def made():
    return campus(400, 3)


def test_it_grows_with_the_images_and_is_the_same_for_a_seed(made):
    assert len(made.wTc) == len(made.time_ns) == 400
    again = campus(400, 3)
    assert np.array_equal(made.points, again.points) and np.array_equal(made.wTc, again.wTc)
    first, second = next(made.features()), next(again.features())
    assert np.array_equal(first.keypoints_px, second.keypoints_px)
    assert np.array_equal(first.descriptors, second.descriptors)
    assert not np.array_equal(campus(1600, 4).wTc, campus(1600, 3).wTc)
    assert len(campus(1600, 3).points) > 2 * len(made.points)


def test_the_camera_moves_in_small_steps_and_stays_inside(made):
    centres = made.wTc[:, :3, 3]
    assert np.linalg.norm(np.diff(centres, axis=0), axis=1).max() < 0.5
    turned = poses.rotation_angle(poses.inverse(made.wTc[:-1])[:, :3, :3] @ made.wTc[1:, :3, :3])
    assert np.degrees(turned).max() < 10
    assert np.allclose(np.linalg.det(made.wTc[:, :3, :3]), 1)
    cell = ((centres[:, :2] - made.corner) / 0.25).astype(int)
    assert made.free[cell[:, 0], cell[:, 1]].all()


def test_the_way_comes_back_to_where_it_was(made):
    centres = made.wTc[:, :3, 3]
    far = np.abs(np.subtract.outer(np.arange(400), np.arange(400))) > 60
    near = np.linalg.norm(centres[:, None] - centres, axis=2) < 1.0
    assert (far & near).any(axis=1).mean() > 0.1


def test_features_are_what_the_pose_sees_and_nothing_behind_a_wall(made):
    counts = []
    for k, features in enumerate(made.features()):
        counts.append(len(features))
        if k % 40:
            continue
        assert np.allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)
        cTw = poses.inverse(made.wTc[k])
        local = poses.transform(cTw, made.points)
        front = local[:, 2] > 0.3
        pixels = local[front, :2] / local[front, 2:] * CAMERA.fx_px + [CAMERA.cx_px, CAMERA.cy_px]
        place = np.flatnonzero(front)
        off = np.linalg.norm(pixels[:, None] - features.keypoints_px, axis=2)
        look = made.looks[place] @ features.descriptors.T
        true = place[np.where(off < 2.0, look, -1.0).argmax(axis=0)]
        assert (np.where(off < 2.0, look, -1.0).max(axis=0) > 0.8).all()
        # Half way to the point there is no wall.
        middle = (made.points[true, :2] + made.wTc[k, :2, 3]) / 2
        cell = ((middle - made.corner) / 0.25).astype(int)
        assert made.free[cell[:, 0], cell[:, 1]].all()
    assert np.median(counts) > 100 and min(counts) > 20
