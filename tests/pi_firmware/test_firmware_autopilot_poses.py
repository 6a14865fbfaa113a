"""Poses in the autopilot's frames against hand-worked ones, and which of them are sent."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from pi_firmware.autopilot.poses import Mounting, PoseGate, rotation, vehicle_pose
from pi_firmware.settings import AutopilotSettings
from pi_firmware.wire import messages

MS = 1_000_000
HALF = math.sqrt(0.5)
# The camera looks along the map's x axis, upright: its x is -y of the map, its y is -z, its z is x.
ALONG_X = (-0.5, 0.5, -0.5, 0.5)
# It looks along the map's y axis: its x is x of the map, its y is -z, its z is y.
ALONG_Y = (-HALF, 0.0, 0.0, HALF)
# It looks down, the top of its picture towards the map's x axis: x is -y, y is -x, z is -z.
DOWN = (-HALF, HALF, 0.0, 0.0)


def mounted(**settings: Any) -> Mounting:
    return Mounting(AutopilotSettings(**settings))


@pytest.mark.parametrize(
    ("quaternion", "mounting", "position", "degrees"),
    [
        # The map's x is north: y is west, z up. Ahead along x is north and level.
        (ALONG_X, mounted(), (1, -2, -3), (0, 0, 0)),
        # Along y is west.
        (ALONG_Y, mounted(), (1, -2, -3), (0, 0, -90)),
        # The map's x is east: y is north.
        (ALONG_X, mounted(world_heading_deg=90), (2, 1, -3), (0, 0, 90)),
        (ALONG_Y, mounted(world_heading_deg=90), (2, 1, -3), (0, 0, 0)),
        # A camera mounted looking down, in a level vehicle that heads north.
        (DOWN, mounted(mount_pitch_deg=-90), (1, -2, -3), (0, 0, 0)),
        # A camera mounted looking to the right sees north: the vehicle heads west.
        (ALONG_X, mounted(mount_yaw_deg=90), (1, -2, -3), (0, 0, -90)),
        # Mounted tilted down by 30 degrees and level in the world: the nose is up by 30.
        (ALONG_X, mounted(mount_pitch_deg=-30), (1, -2, -3), (0, 30, 0)),
        # Mounted upside down and upright in the world: the vehicle is on its back.
        (ALONG_X, mounted(mount_roll_deg=180), (1, -2, -3), (-180, 0, 0)),
        # The camera sits 0.5 m before, 0.1 right of and 0.2 below the centre; the vehicle heads
        # west, where forward is west, right is north and down is down.
        (ALONG_Y, mounted(mount_m=[0.5, 0.1, 0.2]), (0.9, -1.5, -3.2), (0, 0, -90)),
    ],
)
def test_hand_worked_poses(
    quaternion: tuple[float, ...],
    mounting: Mounting,
    position: tuple[float, ...],
    degrees: tuple[float, ...],
) -> None:
    pose = vehicle_pose((1.0, 2.0, 3.0), quaternion, None, mounting)
    np.testing.assert_allclose(pose.position_m, position, atol=1e-12)
    wanted = rotation(*np.radians(degrees))
    np.testing.assert_allclose(rotation(*pose.angles_rad), wanted, atol=1e-12)


def test_velocity_is_the_vehicles_centres_in_its_own_axes() -> None:
    """The camera sits 0.5 m ahead of a centre that rests and yaws to the right: it moves right."""
    mounting = mounted(mount_m=[0.5, 0.0, 0.0], world_heading_deg=90)
    moves_right, yaws_right = (0.5 * 0.4, 0.0, 0.0), (0.0, 0.4, 0.0)  # it looks along the map's y
    pose = vehicle_pose((1.0, 2.0, 3.0), ALONG_Y, None, mounting, moves_right, yaws_right)
    assert pose.velocity_mps is not None and pose.turn_radps is not None
    np.testing.assert_allclose(pose.velocity_mps, 0, atol=1e-12)
    np.testing.assert_allclose(pose.turn_radps, (0, 0, 0.4), atol=1e-12)
    ahead = vehicle_pose((1.0, 2.0, 3.0), ALONG_Y, None, mounting, (0.0, 0.7, 0.1), (0, 0, 0))
    assert ahead.velocity_mps is not None
    np.testing.assert_allclose(ahead.velocity_mps, (0.7, 0, -0.1), atol=1e-12)
    down = vehicle_pose((1.0, 2.0, 3.0), DOWN, None, mounted(mount_pitch_deg=-60))
    w, x, y, z = down.quaternion_wxyz()
    np.testing.assert_allclose(
        [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
        rotation(*down.angles_rad)[:, 0],
        atol=1e-12,
    )


def test_an_unknown_covariance_is_nan_in_its_first_number() -> None:
    pose = vehicle_pose((0, 0, 0), ALONG_X, None, mounted())
    triangle = pose.upper_triangle()
    assert len(triangle) == 21 and math.isnan(triangle[0])


def test_covariance_of_a_level_camera_is_turned_by_hand() -> None:
    """Ahead is north: the camera's forward is north, right east, down down; turns likewise."""
    diagonal = np.diag([1.0, 2, 3, 4, 5, 6])  # about right, down, forward; along the same
    pose = vehicle_pose((0, 0, 0), ALONG_X, diagonal, mounted())
    assert pose.covariance is not None
    np.testing.assert_allclose(np.diag(pose.covariance), [6, 4, 5, 3, 1, 2], atol=1e-12)
    triangle = pose.upper_triangle()
    assert [triangle[i] for i in (0, 6, 11, 15, 18, 20)] == pytest.approx([6, 4, 5, 3, 1, 2])


def test_covariance_is_what_small_turns_and_shifts_make_of_the_pose() -> None:
    mounting = mounted(
        mount_roll_deg=10, mount_pitch_deg=-35, mount_yaw_deg=20, mount_m=[0.4, -0.1, 0.3],
        world_heading_deg=70,
    )  # fmt: skip
    rng = np.random.default_rng(3)
    wRc = rotation(0.3, -0.4, 1.1) @ rotation(*np.radians([-90, 0, -90]))
    position = np.array([1.0, -2.0, 1.5])

    def quaternion(R: np.ndarray) -> tuple[float, ...]:
        w = math.sqrt(max(1 + np.trace(R), 0.0)) / 2
        v = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w)
        return (*v, w)

    def state(xi: np.ndarray) -> np.ndarray:
        turned = wRc @ _turn(xi[:3])
        pose = vehicle_pose(position + wRc @ xi[3:], quaternion(turned), None, mounting)
        return np.concatenate([pose.position_m, pose.angles_rad])

    step = 1e-6
    columns = [(state(step * e) - state(-step * e)) / (2 * step) for e in np.eye(6)]
    jacobian = np.array(columns).T
    root = rng.normal(size=(6, 6))
    covariance = root @ root.T
    pose = vehicle_pose(position, quaternion(wRc), covariance, mounting)
    assert pose.covariance is not None
    np.testing.assert_allclose(pose.covariance, jacobian @ covariance @ jacobian.T, rtol=1e-5)


def _turn(omega: np.ndarray) -> np.ndarray:
    x, y, z = omega
    return np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def pose(capture_ns: int, x: float = 0.0, **changes: object) -> messages.Pose:
    made = messages.Pose(
        time_ns=1,
        capture_ns=capture_ns,
        sequence=0,
        state="TRACKING",
        position_m=[x, 0.0, 1.0],
        quaternion_xyzw=list(ALONG_X),
    )
    return dataclasses.replace(made, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("state", ["LOST", "INITIALIZING", "lost", ""])
def test_unsupported_poses_are_not_sent(state: str) -> None:
    gate = PoseGate(AutopilotSettings())
    assert gate.take(pose(100 * MS, state=state), 100 * MS) is None
    assert gate.take(pose(100 * MS, state="DEGRADED", position_m=None), 100 * MS) is None
    assert gate.counts.lost == 2


@pytest.mark.parametrize("age_ms", [801, 60_000, -101, -3_600_000])
def test_old_poses_and_those_of_another_clock_are_not_sent(age_ms: int) -> None:
    gate = PoseGate(AutopilotSettings(max_age_s=0.8))
    now_ns = 10**18
    assert gate.take(pose(now_ns - age_ms * MS), now_ns) is None
    assert gate.counts.stale == 1
    assert gate.take(pose(now_ns - 800 * MS), now_ns) is not None


def test_a_pose_out_of_order_is_not_sent_and_a_clock_set_back_is_survived() -> None:
    gate = PoseGate(AutopilotSettings())
    now_ns = 10**18
    assert gate.take(pose(now_ns), now_ns) is not None
    assert gate.take(pose(now_ns), now_ns) is None
    assert gate.take(pose(now_ns - 33 * MS), now_ns) is None
    back_ns = now_ns - 3600 * 10**9
    assert gate.take(pose(back_ns), back_ns) is not None


@pytest.mark.parametrize(
    "changes",
    [
        {"quaternion_xyzw": [0.0, 0.0, 0.0, 0.0]},
        {"quaternion_xyzw": [0.0, 0.0, 1.0]},
        {"quaternion_xyzw": None},
        {"position_m": [0.0, 0.0]},
        {"position_m": [1e9, 0.0, 0.0]},
        {"covariance": [0.0] * 35},
        {"covariance": [-1.0] * 36},
        {"covariance": [1e300] * 36},
        {"velocity_mps": [0.0, 0.0]},
        {"velocity_mps": [1e9, 0.0, 0.0]},
        {"turn_radps": []},
    ],
)
def test_what_is_no_pose_is_refused(changes: dict[str, object]) -> None:
    gate = PoseGate(AutopilotSettings())
    assert gate.take(pose(5, **changes), 5) is None
    assert gate.counts.refused == 1


def test_the_reset_counter_counts_relocalizations_returns_and_jumps() -> None:
    gate = PoseGate(AutopilotSettings(jump_m=0.5, jump_deg=20))
    at = iter(range(0, 10**12, 33 * MS))

    def take(x: float = 0.0, **changes: object) -> int:
        now_ns = next(at)
        gate.take(pose(now_ns, x, **changes), now_ns)
        return gate.reset_counter

    assert take(relocalized=True) == 0  # the first is no reset
    assert take(0.05) == 0
    assert take(0.05, relocalized=True) == 1
    assert take(0.05, state="DEGRADED", position_m=None) == 1
    assert take(0.06) == 1  # a frame without a pose is no reset
    assert take(0.06, state="LOST", position_m=None) == 1
    assert take(0.07) == 2
    assert take(0.08) == 2
    assert take(1.0) == 3
    assert take(1.01, quaternion_xyzw=list(ALONG_Y)) == 4
    gate.reset_counter = 255
    assert take(9.0) == 0
