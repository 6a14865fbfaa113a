"""Entropy, motion, projection, association, settings: against other implementations or by hand."""

from __future__ import annotations

import dataclasses
import itertools
import tomllib
from importlib import resources

import cv2
import gtsam
import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.localization.estimator import PoseEstimator, constant_velocity
from ground_station.localization.kinematics import Kinematics, Solution, no_solution
from ground_station.localization.settings import (
    LocalizerSettings,
    MotionSettings,
    ProjectionSettings,
    load_preset,
)
from ground_station.localization.visibility import project
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError


def test_constant_velocity_makes_the_last_step_once_more():
    before = poses.pose(np.eye(3), [1.0, 0.0, 0.0])
    last = poses.pose(np.eye(3), [1.5, 0.0, 0.0])
    assert np.allclose(constant_velocity(before, last, 1.0)[:3, 3], [2.0, 0, 0])
    assert np.allclose(constant_velocity(before, last, 3.0)[:3, 3], [3.0, 0, 0])
    # A quarter turn about z while going 1 m along the camera's own x: a square is driven.
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    step = poses.pose(turn, [1.0, 0, 0])
    first = np.eye(4)
    second = first @ step
    third = constant_velocity(first, second, 1.0)
    assert np.allclose(third, poses.pose(turn @ turn, [1.0, 1.0, 0]), atol=1e-12)
    assert np.allclose(third, second @ np.linalg.inv(first) @ second, atol=1e-12)


def _alone(**motion) -> PoseEstimator:
    return PoseEstimator(THESIS_CAMERA, LocalizerSettings(motion=MotionSettings(**motion)))


def _solved(time_ns: int, wTc: np.ndarray) -> Solution:
    state = Kinematics(time_ns, wTc, np.zeros(6), np.zeros((12, 12)))
    return dataclasses.replace(no_solution(0, ""), state=state)


def _along_x(metres: float) -> np.ndarray:
    return poses.pose(np.eye(3), [metres, 0, 0])


def test_predictions_stay_rotations_over_a_long_flight():
    estimator = _alone()
    wTc = poses.exp([0.3, -0.2, 0.1, 1.0, 2.0, 3.0])
    estimator.restart(0, wTc)
    estimator.update(_solved(33, wTc @ poses.exp([0.01, 0.02, -0.01, 0.02, 0.0, 0.01])))
    for k in range(2, 2000):
        predicted = estimator.predict(33 * k).wTc
        estimator.update(_solved(33 * k, predicted))
    assert np.abs(predicted[:3, :3] @ predicted[:3, :3].T - np.eye(3)).max() < 1e-12


def test_a_late_frame_stretches_the_prediction_until_it_is_held():
    estimator, static = _alone(coast_s=0.2), _alone(coast_s=0.2, model="static")
    for each in (estimator, static):
        each.restart(0, np.eye(4))
        each.update(_solved(100_000_000, _along_x(0.1)))
    for time_ns, x_m in ((200_000_000, 0.2), (250_000_000, 0.25), (9_000_000_000, 0.3)):
        assert estimator.predict(time_ns).wTc[0, 3] == pytest.approx(x_m)
    assert static.predict(200_000_000).wTc[0, 3] == pytest.approx(0.1)


def test_steps_too_far_apart_give_no_velocity():
    estimator = _alone(max_step_s=0.5)
    estimator.restart(0, np.eye(4))
    estimator.update(_solved(600_000_000, _along_x(1.0)))
    assert estimator.predict(700_000_000).wTc[0, 3] == pytest.approx(1.0)


def test_projection_agrees_with_gtsam_and_opencv(room):
    _, path = room.path(1)
    camera, wTc = room.camera, path[0]
    seen = project(room.map.landmarks, wTc, camera, ProjectionSettings())
    assert len(seen.landmark) > 100
    K = gtsam.Cal3_S2(camera.fx_px, camera.fy_px, 0, camera.cx_px, camera.cy_px)
    pinhole = gtsam.PinholeCameraCal3_S2(gtsam.Pose3(wTc), K)
    points = room.map.landmarks.position_m
    theirs = np.array([pinhole.project(points[i]) for i in seen.landmark])
    assert np.abs(theirs - seen.pinhole_px).max() < 1e-8
    cTw = np.linalg.inv(wTc)
    in_front = (points @ cTw[:3, :3].T + cTw[:3, 3])[:, 2] > 0.05
    distorted, _ = cv2.projectPoints(
        points, cv2.Rodrigues(cTw[:3, :3])[0], cTw[:3, 3], camera.matrix, camera.distortion
    )
    x, y = distorted.reshape(-1, 2).T
    inside = in_front & (x >= -0.5) & (y >= -0.5) & (x < 639.5) & (y < 479.5)
    kept = np.zeros(len(points), bool)
    kept[seen.landmark] = True
    assert not (kept & ~inside).any()
    # What OpenCV puts inside and we drop lies past the lens's fold, outside of any real image.
    normalized = (points @ cTw[:3, :3].T + cTw[:3, 3])[inside & ~kept]
    radius = np.linalg.norm(normalized[:, :2] / normalized[:, 2:], axis=1)
    assert (radius > camera.max_radius).all()


def test_landmarks_looked_at_from_outside_their_cones_are_dropped(room):
    wTc = room.path(1)[1][0]
    camera, landmarks = room.camera, room.map.landmarks
    landmarks.view_cos[:] = np.cos(np.deg2rad(10.0))
    turned = landmarks.view_direction + room.rng.normal(0, 0.3, (len(landmarks), 3))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    landmarks.view_direction[:] = turned
    everything = project(landmarks, wTc, camera, ProjectionSettings())
    cone = ProjectionSettings(viewing_cone=True, cone_margin_deg=10, max_distance_ratio=100)
    seen = project(landmarks, wTc, camera, cone)
    rays = wTc[:3, 3] - landmarks.position_m
    cosine = np.einsum("ij,ij->i", rays, landmarks.view_direction)
    cosine /= np.linalg.norm(rays, axis=1)
    wanted = [i for i in everything.landmark if cosine[i] >= np.cos(np.deg2rad(20.0))]
    assert 0 < len(wanted) < len(everything.landmark)
    assert seen.landmark.tolist() == wanted


def _keys(kind, prefix=""):
    for field in dataclasses.fields(kind):
        inner = field.default_factory
        if isinstance(inner, type) and dataclasses.is_dataclass(inner):
            yield from _keys(inner, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name


def _flat(document, prefix=""):
    for name, value in document.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name


def test_the_shipped_default_names_every_key_with_its_comment():
    file = resources.files("ground_station.localization") / "presets" / "default.toml"
    text = file.read_text()
    assert sorted(_flat(tomllib.loads(text))) == sorted(_keys(LocalizerSettings))
    for above, line in itertools.pairwise(text.splitlines()):
        if " = " in line and not line.startswith("#"):
            assert above.startswith("# "), line


def test_the_thesis_preset_has_the_values_of_the_thesis():
    thesis = load_preset("thesis")
    assert thesis.gate.min_entropy_bits == 7.0
    assert thesis.motion.model == "constant_velocity"
    assert thesis.association.max_descriptor_distance == 0.7
    pose = thesis.pose
    assert (pose.solver, pose.sigma_px, pose.huber_k) == ("graph", 5.0, 1.345)
    assert pose.landmark_sigma_m == 0.01
    assert not thesis.recovery.relocalize
    assert thesis.gate.min_contrast == 0.0 == load_preset("default").gate.min_entropy_bits


def test_a_bad_preset_or_value_is_refused_by_name():
    with pytest.raises(ConfigError, match="there is no 'fast'"):
        load_preset("fast")
    with pytest.raises(ConfigError, match=r"association\.radius_px.*1 to 500 px"):
        config.from_mapping({"association": {"radius_px": 0.5}}, LocalizerSettings)
