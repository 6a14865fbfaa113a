"""What is derived of a pose, against numbers worked by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.localization.estimate import Counts, Observations, PoseEstimate, State
from ground_station.service import bus_messages
from ground_station.service.bus_messages import EstimateMessage, FrameMessage
from ground_station.service.localizing.derive import (
    Accounts,
    estimate_note,
    heading_deg,
    points_px,
    position_covariance,
    unsolved_note,
    world_velocity,
)

# The camera looks along the world's y axis: its x is the world's x, its y is down.
ALONG_Y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
FRAME = FrameMessage(0, 2, 7, 1_000, 2_000, 3_000, 640, 480, 1, capture_ns=2_500)


def looking(yaw_deg: float, pitch_deg: float = 0.0) -> np.ndarray:
    """A pose at (1, 2, 3) that looks `yaw_deg` from x towards y and `pitch_deg` up."""
    yaw, pitch = np.deg2rad([yaw_deg, pitch_deg])
    z = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    x = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    return poses.pose(np.stack([x, np.cross(z, x), z], axis=1), [1.0, 2.0, 3.0])


def observations(count: int, inliers: int) -> Observations:
    pixel = np.stack([np.arange(count), np.arange(count) + 0.25], axis=1).astype(np.float32)
    inlier = np.arange(count) < inliers
    return Observations(pixel, np.arange(count), np.zeros(count), inlier)


def estimate(**fields: object) -> PoseEstimate:
    values = {"time_ns": 1_000, "index": 7, "state": State.TRACKING, "wTc": looking(90.0)}
    return PoseEstimate(**(values | fields))  # type: ignore[arg-type]


def test_covariance_is_that_of_steps_on_the_tangent() -> None:
    """Against the exponential map itself, with rotation and translation correlated."""
    rng = np.random.default_rng(1)
    root = rng.normal(0, 1e-4, (6, 6))
    wTc = poses.exp([0.3, -1.1, 0.7, 1.0, 2.0, 3.0])
    steps = rng.normal(size=(20_000, 6)) @ root.T
    moved = np.array([(wTc @ poses.exp(step))[:3, 3] for step in steps])
    expected = np.cov(moved.T)
    found = position_covariance(wTc, root @ root.T)
    assert np.abs(found - expected).max() < 0.05 * np.abs(expected).max()


def test_velocity_is_in_world_axes() -> None:
    wTc = poses.pose(ALONG_Y, [0.0, 0.0, 0.0])
    twist = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
    velocity = world_velocity(wTc, twist)
    assert velocity is not None and np.allclose(velocity, [1.0, 3.0, -2.0])


@pytest.mark.parametrize("twist", [None, np.zeros(6), np.full(6, np.nan)])
def test_a_twist_that_is_not_estimated_is_no_velocity_of_zero(twist: np.ndarray | None) -> None:
    assert world_velocity(looking(0.0), twist) is None


@pytest.mark.parametrize("yaw", [0.0, 37.0, 90.0, 179.0, -90.0, -135.0])
@pytest.mark.parametrize("pitch", [-80.0, -30.0, 0.0, 60.0])
def test_heading_is_the_views_direction_on_the_floor(yaw: float, pitch: float) -> None:
    assert heading_deg(looking(yaw, pitch)) == pytest.approx(yaw, abs=1e-6)


def test_heading_does_not_change_when_the_camera_rolls() -> None:
    rolled = looking(37.0, -20.0) @ poses.exp([0, 0, 1.0, 0, 0, 0])
    assert heading_deg(rolled) == pytest.approx(37.0)


@pytest.mark.parametrize("pitch", [90.0, -90.0, 86.0, -86.0])
def test_straight_up_or_down_there_is_no_heading(pitch: float) -> None:
    assert heading_deg(looking(37.0, pitch)) is None


def test_points_are_the_inliers_as_u_v() -> None:
    assert points_px(observations(5, 2)) == [0.0, 0.2, 1.0, 1.2]
    assert points_px(observations(0, 0)) == []


def test_of_many_points_300_are_chosen_evenly() -> None:
    assert len(points_px(observations(300, 300))) == 600
    chosen = points_px(observations(1000, 900))
    u = np.array(chosen[0::2])
    assert len(chosen) == 600
    assert u[0] == 0 and (np.diff(u) == 3).all()  # every third of 900


def test_a_note_has_the_frames_numbers_and_the_poses() -> None:
    covariance = np.diag([1e-4, 1e-4, 1e-4, 1.0, 4.0, 9.0])
    told = estimate_note(
        FRAME,
        estimate(
            covariance=covariance,
            twist=np.array([0, 0, 0, 0.0, 0.0, 2.0]),
            counts=Counts(projected=40, inliers=20),
            observations=observations(3, 2),
            stage_ms={"total": 12.34567},
            tracked=True,
        ),
        Accounts(processed=5, localized=4, skipped=3),
        "atrium",
        9_000,
    )
    assert (told.sequence, told.time_ns, told.clock_ns, told.capture_ns) == (7, 1_000, 2_000, 2_500)
    assert (told.done_ns, told.map, told.state, told.reason) == (9_000, "atrium", "TRACKING", "")
    assert told.position_m == [1.0, 2.0, 3.0] and told.height_m == 3.0
    assert told.quaternion_xyzw is not None
    turned = poses.from_quaternion(told.position_m, told.quaternion_xyzw)
    assert np.allclose(turned, looking(90.0))
    assert told.covariance == covariance.ravel().tolist()
    assert told.position_sigma_m is not None
    assert np.allclose(told.position_sigma_m, [1, 0, 0, 0, 9, 0, 0, 0, 4])
    assert told.velocity_mps is not None and np.allclose(told.velocity_mps, [0, 2, 0])
    assert told.speed_mps == pytest.approx(2.0) and told.heading_deg == pytest.approx(90.0)
    assert (told.inliers, told.expected, told.tracked) == (20, 40, True)
    assert told.points_px == [0.0, 0.2, 1.0, 1.2] and told.stage_ms == {"total": 12.346}
    assert (told.processed, told.localized, told.skipped) == (5, 4, 3)
    json.loads(bus_messages.encode(told), parse_constant=pytest.fail)
    assert bus_messages.decode(EstimateMessage, bus_messages.encode(told)) == told


def test_a_pose_that_is_not_finite_is_lost() -> None:
    wTc = looking(0.0)
    wTc[0, 3] = np.nan
    told = estimate_note(FRAME, estimate(wTc=wTc), Accounts(), "atrium", 0)
    assert told.state == "LOST" and told.reason == "the pose is not finite"
    assert told.position_m is told.quaternion_xyzw is told.height_m is None


def test_a_covariance_that_is_not_finite_is_not_told() -> None:
    told = estimate_note(
        FRAME, estimate(covariance=np.full((6, 6), np.inf)), Accounts(), "atrium", 0
    )
    assert told.position_m is not None
    assert told.covariance is told.position_sigma_m is None


def test_a_frame_without_a_pose_says_why() -> None:
    unsolved = estimate(wTc=None, state=State.DEGRADED, reason="searching")
    told = estimate_note(FRAME, unsolved, Accounts(2, 1, 0), "atrium", 5)
    assert (told.state, told.reason, told.position_m) == ("DEGRADED", "searching", None)
    assert told == unsolved_note(
        FRAME, State.DEGRADED, "searching", Accounts(2, 1, 0), "atrium", 5, unsolved
    )
