"""Positions and orientations of a trajectory register a map together, each by its own scatter."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hand_made import keyframes_of
from scipy.spatial.transform import Rotation

from ground_station.errors import BlimpError, MapError
from ground_station.geometry import poses
from ground_station.geometry.alignment import Alignment, align
from ground_station.geometry.trajectory import Trajectory, read_tum
from ground_station.mapping.registration import pose_similarity
from ground_station.mapping.registration.from_trajectory import by_trajectory

STEP_NS = 500_000_000
DATA = Path(__file__).parents[3] / "../shared/data/redkitchen"

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data/redkitchen is not there")


def walk(count: int = 30, sideways_m: float = 0.3, seed: int = 0) -> np.ndarray:
    """True camera poses (N, 4, 4) along 3 m with some metres to the side, looking about."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, count)
    position = np.stack(
        [3 * t, sideways_m * np.sin(5 * t), 1.5 + sideways_m * np.cos(7 * t)], axis=1
    )
    look = Rotation.from_euler("zyx", rng.uniform(-25, 25, (count, 3)), degrees=True)
    forward = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return poses.pose((look * forward).as_matrix(), position)


def random_similarity(seed: int) -> Alignment:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    return Alignment(rotation, rng.normal(size=3) * 4, float(np.exp(rng.normal())))


def model_of(wTc: np.ndarray, fit: Alignment) -> SimpleNamespace:
    """The map whose registration is `fit`: the true poses in the model's coordinates."""
    R = fit.rotation.T
    position = (wTc[:, :3, 3] - fit.translation) @ fit.rotation / fit.scale
    return SimpleNamespace(
        keyframes=keyframes_of(poses.pose(R @ wTc[:, :3, :3], position), STEP_NS)
    )


def trajectory_of(wTc: np.ndarray, sigma_m=0.0, sigma_deg=0.0, seed=0, offset=None) -> Trajectory:
    """The poses with noise along each axis, and with orientations turned by `offset` (3, 3)."""
    rng = np.random.default_rng(seed)
    noise = Rotation.from_rotvec(np.radians(sigma_deg) * rng.normal(size=(len(wTc), 3)))
    rotation = noise.as_matrix() @ wTc[:, :3, :3] @ (np.eye(3) if offset is None else offset)
    position = wTc[:, :3, 3] + sigma_m * rng.normal(size=(len(wTc), 3))
    return Trajectory.from_poses(np.arange(len(wTc)) * STEP_NS, poses.pose(rotation, position))


def off_deg(fit: Alignment, truth: Alignment) -> float:
    return float(np.degrees(poses.rotation_angle(fit.rotation @ truth.rotation.T)))


def positions_only(map_: SimpleNamespace, trajectory: Trajectory) -> Alignment:
    return align(map_.keyframes.wTc[:, :3, 3], trajectory.position_m, True)


def joint_only(map_: SimpleNamespace, trajectory: Trajectory) -> pose_similarity.JointFit:
    """The joint fit of all poses, without the search for wrong ones."""
    model = map_.keyframes.wTc
    positions = pose_similarity.Positions(model[:, :3, 3], trajectory.position_m)
    turned = trajectory.wTc[:, :3, :3] @ np.swapaxes(model[:, :3, :3], 1, 2)
    return pose_similarity.joint_similarity(positions, turned, positions_only(map_, trajectory))


def turned_by(degrees: float) -> np.ndarray:
    axis = np.array([0.6, -0.7, 0.4])
    return Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()


@pytest.mark.parametrize("seed", range(5))
def test_perfect_poses_give_the_similarity_from_any_frame(seed):
    truth = random_similarity(seed)
    wTc = walk(seed=seed)
    found = by_trajectory(model_of(wTc, truth), trajectory_of(wTc), 0)
    assert off_deg(found.fit, truth) < 1e-6
    assert found.fit.scale == pytest.approx(truth.scale, rel=1e-9)
    assert np.allclose(found.fit.translation, truth.translation, atol=1e-8)
    assert found.report["points"] == found.report["orientations"] == 30


def test_orientations_better_the_rotation_and_both_scatters_are_found():
    wTc = walk(40)
    joint, alone, sigma = [], [], []
    for seed in range(40):
        truth = random_similarity(seed)
        map_, trajectory = model_of(wTc, truth), trajectory_of(wTc, 0.03, 0.3, seed)
        found = joint_only(map_, trajectory)
        joint.append(off_deg(found.fit, truth))
        alone.append(off_deg(positions_only(map_, trajectory), truth))
        sigma.append([found.sigma_m, np.degrees(found.sigma_rad)])
    rms = np.sqrt(np.mean(np.square([joint, alone]), axis=1))
    assert rms[0] < rms[1] / 3
    # Forty orientations of 0.3 deg along each of three axes.
    assert rms[0] == pytest.approx(0.3 * np.sqrt(3 / 40), rel=0.25)
    assert np.mean(sigma, axis=0) == pytest.approx([0.03, 0.3], rel=0.05)


def test_rough_orientations_do_not_spoil_good_positions():
    wTc = walk(40)
    joint, alone = [], []
    for seed in range(40):
        truth = random_similarity(seed)
        map_, trajectory = model_of(wTc, truth), trajectory_of(wTc, 0.002, 4.0, seed)
        joint.append(off_deg(joint_only(map_, trajectory).fit, truth))
        alone.append(off_deg(positions_only(map_, trajectory), truth))
    assert np.sqrt(np.mean(np.square(joint))) < 1.05 * np.sqrt(np.mean(np.square(alone)))


def test_the_joint_fit_is_where_the_weighted_squares_are_least():
    wTc, truth = walk(20), random_similarity(3)
    map_, trajectory = model_of(wTc, truth), trajectory_of(wTc, 0.02, 0.5, 4)
    model = map_.keyframes.wTc
    positions = pose_similarity.Positions(model[:, :3, 3], trajectory.position_m)
    turned = trajectory.wTc[:, :3, :3] @ np.swapaxes(model[:, :3, :3], 1, 2)
    found = joint_only(map_, trajectory)

    def cost(fit: Alignment) -> float:
        error = fit.apply(positions.source) - positions.target
        angle = poses.rotation_angle(turned @ fit.rotation.T)
        return np.sum(error**2) / found.sigma_m**2 + np.sum(angle**2) / found.sigma_rad**2

    fit, least = found.fit, cost(found.fit)
    # The components are what 3 * 40 residuals less seven parameters leave.
    assert least == pytest.approx(3 * 40 - 7, rel=1e-6)
    for k in range(3):
        for step in (-1, 1):
            turn = Rotation.from_rotvec(step * 3e-4 * np.eye(3)[k]).as_matrix()
            mean = positions.target.mean(axis=0)
            moved = turn @ (fit.translation - mean) + mean
            assert cost(Alignment(turn @ fit.rotation, moved, fit.scale)) > least
            shifted = fit.translation + step * 1e-3 * np.eye(3)[k]
            assert cost(Alignment(fit.rotation, shifted, fit.scale)) > least
    for factor in (0.999, 1.001):
        assert cost(Alignment(fit.rotation, fit.translation, factor * fit.scale)) > least


def test_wrong_poses_are_left_out_position_and_orientation_each_for_itself():
    wTc, truth = walk(30), random_similarity(6)
    clean = trajectory_of(wTc, 0.01, 0.2, 7)
    position, rotation = clean.position_m.copy(), clean.wTc[:, :3, :3].copy()
    position[[3, 11]] += [[2.0, -1.0, 0.5], [-0.6, 0.8, 3.0]]
    rotation[[11, 20, 21]] = rotation[[11, 20, 21]] @ turned_by(40.0)
    trajectory = Trajectory.from_poses(clean.time_ns, poses.pose(rotation, position))
    found = by_trajectory(model_of(wTc, truth), trajectory, 0)
    assert found.report["points"] == 28 and found.report["points_given"] == 30
    assert found.report["orientations"] == 27
    assert off_deg(found.fit, truth) < 0.2
    assert found.report["residual_max_m"] < 0.06 and found.report["residual_max_deg"] < 1.5
    assert any(note.startswith("2 positions left out") for note in found.notes)
    assert any(note.startswith("3 orientations left out") for note in found.notes)


@pytest.mark.parametrize(
    ("degrees", "sideways_m"), [(2.0, 0.3), (5.0, 1.0), (25.0, 0.3), (120.0, 1.0), (180.0, 0.3)]
)
def test_a_vehicles_own_axes_are_recognised_and_positions_alone_decide(degrees, sideways_m):
    wTc, truth = walk(40, sideways_m), random_similarity(9)
    trajectory = trajectory_of(wTc, 0.01, 0.2, 5, turned_by(degrees))
    map_ = model_of(wTc, truth)
    found = by_trajectory(map_, trajectory, 0)
    expected = positions_only(map_, trajectory)
    assert off_deg(found.fit, expected) < 1e-6
    assert found.report["orientations"] == 0
    assert found.report["orientation_offset_deg"] == pytest.approx(degrees, abs=0.5)
    assert found.report["residual_rms_deg"] == pytest.approx(degrees, abs=2.0)
    said = [note for note in found.notes if "only its positions are used" in note]
    assert len(said) == 1 and f"{found.report['orientation_offset_deg']:.1f} deg" in said[0]


def test_orientations_that_were_never_measured_are_left_out():
    wTc, truth = walk(40), random_similarity(2)
    still = poses.pose(np.broadcast_to(np.eye(3), (40, 3, 3)), trajectory_of(wTc, 0.01).position_m)
    map_, trajectory = model_of(wTc, truth), Trajectory.from_poses(np.arange(40) * STEP_NS, still)
    found = by_trajectory(map_, trajectory, 0)
    assert off_deg(found.fit, positions_only(map_, trajectory)) < 1e-6
    assert found.report["orientations"] == 0


def test_an_offset_that_scatter_explains_is_none():
    """Nearly straight and noisy: the positions know the roll to some degrees only."""
    wTc = walk(12, 0.06)
    used, alone, joint = 0, [], []
    for seed in range(12):
        truth = random_similarity(seed)
        map_, trajectory = model_of(wTc, truth), trajectory_of(wTc, 0.02, 0.3, seed)
        found = by_trajectory(map_, trajectory, 0)
        used += found.report["orientations"] > 0
        alone.append(off_deg(positions_only(map_, trajectory), truth))
        joint.append(off_deg(found.fit, truth))
    assert np.median(alone) > 3.0
    assert used >= 11 and np.median(joint) < 0.3


def test_a_small_offset_is_no_other_frame():
    wTc, truth = walk(40), random_similarity(9)
    found = by_trajectory(
        model_of(wTc, truth), trajectory_of(wTc, 0.005, 0.1, 5, turned_by(0.4)), 0
    )
    assert found.report["orientations"] == 40
    assert off_deg(found.fit, truth) < 0.6


def straight(count: int = 25) -> np.ndarray:
    return walk(count, 0.0)


def test_on_a_straight_line_the_orientations_give_the_roll():
    wTc, truth = straight(), random_similarity(4)
    clean = trajectory_of(wTc, 0.002, 0.2, 3)
    found = by_trajectory(model_of(wTc, truth), clean, 0)
    assert off_deg(found.fit, truth) < 0.2
    assert found.fit.scale == pytest.approx(truth.scale, rel=2e-3)
    assert any("on one line" in note for note in found.notes)
    # One pose off the line must not make a plane of it.
    position = clean.position_m.copy()
    position[8] += [0.0, 1.5, 0.4]
    wild = Trajectory(clean.time_ns, position, clean.quaternion_xyzw)
    found = by_trajectory(model_of(wTc, truth), wild, 0)
    assert off_deg(found.fit, truth) < 0.2 and found.report["points"] == 24


def test_on_a_straight_line_orientations_of_another_frame_leave_the_roll_open():
    wTc, truth = straight(), random_similarity(4)
    trajectory = trajectory_of(wTc, 0.002, 0.2, 3, turned_by(20.0))
    with pytest.raises(MapError, match=r"on one line.* deg off the camera's") as caught:
        by_trajectory(model_of(wTc, truth), trajectory, 0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("where", ["map", "trajectory", "both"])
def test_positions_in_one_place_are_refused(where):
    wTc, truth = walk(), random_similarity(4)
    map_, trajectory = model_of(wTc, truth), trajectory_of(wTc)
    if where != "trajectory":
        map_.keyframes.wTc[:, :3, 3] = 1.0
    if where != "map":
        trajectory.position_m[:] = 2.0
    with pytest.raises(BlimpError, match="one place") as caught:
        by_trajectory(map_, trajectory, 0)
    assert "\n" not in str(caught.value)


def test_three_poses_are_enough_and_two_are_not():
    wTc, truth = walk(3), random_similarity(1)
    found = by_trajectory(model_of(wTc, truth), trajectory_of(wTc, 1e-3, 0.05), 0)
    assert off_deg(found.fit, truth) < 0.3
    with pytest.raises(MapError, match=r"2 of 2 keyframes .* at least 3"):
        by_trajectory(model_of(wTc[:2], truth), trajectory_of(wTc), 0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
@pytest.mark.parametrize("part", ["position_m", "quaternion_xyzw", "map"])
def test_numbers_that_are_not_finite_are_refused_in_one_line(part, value):
    wTc, truth = walk(), random_similarity(1)
    map_, trajectory = model_of(wTc, truth), trajectory_of(wTc)
    array = map_.keyframes.wTc if part == "map" else getattr(trajectory, part)
    array[(5, 0) if part != "map" else (5, 0, 3)] = value
    with pytest.raises(
        MapError, match=r"at 2\.5.* not finite|'frame-000005' is not finite"
    ) as caught:
        by_trajectory(map_, trajectory, 0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("rotation", [np.zeros((3, 3)), np.diag([1.0, 1.0, -1.0]), 2 * np.eye(3)])
def test_a_maps_pose_that_is_no_rigid_motion_is_refused_by_name(rotation):
    map_ = model_of(walk(), random_similarity(1))
    map_.keyframes.wTc[4, :3, :3] = rotation
    with pytest.raises(MapError, match=r"'frame-000004' is not finite or no rigid motion"):
        by_trajectory(map_, trajectory_of(walk()), 0)


def test_numbers_by_chance_are_refused_with_one_line():
    rng = np.random.default_rng(0)
    rotation = Rotation.random(30, random_state=0).as_matrix()
    chance = poses.pose(rotation, rng.normal(size=(30, 3)))
    trajectory = Trajectory.from_poses(np.arange(30) * STEP_NS, chance)
    with pytest.raises(BlimpError) as caught:
        by_trajectory(model_of(walk(), random_similarity(1)), trajectory, 0)
    assert "\n" not in str(caught.value)


def test_a_map_that_is_inside_out_is_refused_and_a_poor_trajectory_is_taken():
    rng = np.random.default_rng(3)
    wTc = walk()
    wTc[:, :3, 3] = rng.normal(size=(len(wTc), 3))
    map_, middle = model_of(wTc, random_similarity(3)), wTc[:, :3, 3].mean(axis=0)
    spread_m = np.sqrt(np.mean((wTc[:, :3, 3] - middle) ** 2))
    poor = by_trajectory(map_, trajectory_of(wTc, sigma_m=0.07 * spread_m), 0)
    assert poor.report["sigma_m"] == pytest.approx(0.07 * spread_m, rel=0.3)
    mirrored = wTc.copy()
    mirrored[:, :3, 3] = 2 * middle - wTc[:, :3, 3]
    turned = trajectory_of(mirrored, offset=turned_by(175.0))
    with pytest.raises(MapError, match="the map has not the shape of the trajectory"):
        by_trajectory(map_, turned, 0)


def test_a_zero_quaternion_and_an_empty_trajectory_are_refused():
    wTc, truth = walk(), random_similarity(1)
    trajectory = trajectory_of(wTc)
    trajectory.quaternion_xyzw[7] = 0.0
    with pytest.raises(MapError, match=r"at 3\.500000 s .* quaternion that is not of length 1"):
        by_trajectory(model_of(wTc, truth), trajectory, 0)
    none = Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 4)))
    with pytest.raises(MapError, match="no poses"):
        by_trajectory(model_of(wTc, truth), none, 0)


def test_times_at_the_ends_of_the_number_range_and_out_of_order_are_matched_rightly():
    wTc, truth = walk(), random_similarity(1)
    clean = trajectory_of(wTc)
    order = np.random.default_rng(0).permutation(32)
    time = np.concatenate([clean.time_ns, [-(2**63), 2**63 - 1]])
    far = np.full((2, 3), 1e9)
    shuffled = Trajectory(
        time[order],
        np.concatenate([clean.position_m, far])[order],
        np.concatenate([clean.quaternion_xyzw, clean.quaternion_xyzw[:2]])[order],
    )
    found = by_trajectory(model_of(wTc, truth), shuffled, 0)
    assert found.report["points_given"] == 30 and off_deg(found.fit, truth) < 1e-6


@needs_data
def test_depth_camera_poses_of_a_kitchen_do_not_turn_a_map_of_the_colour_camera():
    """KinectFusion's orientations are the depth camera's, some degrees off the colour camera's."""
    colour, depth = (read_tum(DATA / f"{name}groundtruth.txt") for name in ("pseudo_", ""))
    half = colour.time_ns < 500 / 30 * 1e9
    map_ = SimpleNamespace(keyframes=keyframes_of(colour.wTc[half], STEP_NS))
    map_.keyframes.time_ns[:] = colour.time_ns[half]
    found = by_trajectory(map_, depth, 0)
    assert found.report["orientations"] == 0
    assert 2 < found.report["orientation_offset_deg"] < 8
    assert any("only its positions are used" in note for note in found.notes)
