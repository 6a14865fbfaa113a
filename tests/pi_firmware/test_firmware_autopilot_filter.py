"""What the autopilot is told, through a filter such as it has: it agrees with itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
from odometry_filter import OdometryFilter
from pymavlink.dialects.v20 import common as mavlink
from scipy.spatial.transform import Rotation

from pi_firmware.autopilot.line import as_mavlink
from pi_firmware.autopilot.poses import PoseGate
from pi_firmware.settings import AutopilotSettings
from pi_firmware.wire import messages

PERIOD_S, FRAMES = 0.1, 300
SIGMA = np.repeat([0.01, 0.02], 3)
"""Of a pose's rotation about each of the camera's axes, rad, and of its place along them, m."""
MOUNTED = {"mount_m": [0.4, -0.1, 0.2], "mount_pitch_deg": -20.0, "world_heading_deg": 65.0}
AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""The camera's axes in the map's, where it looks along the map's x."""


def flown(t: float) -> tuple[np.ndarray, Rotation]:
    """Where the camera is after so many seconds, and how it is turned: a round that rises, tilts
    and looks half ahead."""
    angle = 0.25 * t
    place = np.array([3 * np.cos(angle), 2 * np.sin(angle), 2 + 0.5 * np.sin(2 * angle)])
    yaw = angle + 2.2 + 0.3 * np.sin(0.5 * t)
    tilt = Rotation.from_euler("ZYX", [yaw, 0.1 * np.sin(0.7 * t), 0.08 * np.cos(0.9 * t)])
    return place, tilt * Rotation.from_matrix(AHEAD)


def told(settings: AutopilotSettings) -> list[mavlink.MAVLink_odometry_message]:
    """What the line carries of such a flight, with noise of the covariance that it tells."""
    gate, rng = PoseGate(settings), np.random.default_rng(5)
    coder, ends = mavlink.MAVLink(None), mavlink.MAVLink(None)
    heard = []
    for k in range(FRAMES):
        t, step = k * PERIOD_S, 1e-4
        (place, turn), (before, was), (after, becomes) = (flown(t + d) for d in (0, -step, step))
        noise = rng.normal(0, SIGMA)
        capture_ns = 10**9 + round(t * 1e9)
        message = messages.Pose(
            time_ns=capture_ns, capture_ns=capture_ns, sequence=k, state="TRACKING",
            position_m=(place + turn.apply(noise[3:])).tolist(),
            quaternion_xyzw=(turn * Rotation.from_rotvec(noise[:3])).as_quat().tolist(),
            covariance=np.diag(SIGMA**2).ravel().tolist(),
            velocity_mps=((after - before) / (2 * step) + rng.normal(0, 0.1, 3)).tolist(),
            turn_radps=((was.inv() * becomes).as_rotvec() / (2 * step)).tolist(),
        )  # fmt: skip
        pose = gate.take(message, capture_ns)
        assert pose is not None
        data = as_mavlink(capture_ns // 1000, pose, 0.5, gate.reset_counter).pack(coder)
        heard += ends.parse_buffer(data)
    return heard


@pytest.mark.parametrize("mounted", [{}, MOUNTED])
def test_a_filter_finds_its_innovations_as_large_as_it_is_told(mounted: dict[str, object]) -> None:
    heard, pilot = told(AutopilotSettings(**mounted)), OdometryFilter()
    missed = [pilot.take(message) for message in heard][20:]
    # Nine degrees of freedom; what it allows for accelerations is more than there are.
    assert 5.5 < np.mean(missed) < 9.5 and np.quantile(missed, 0.99) < 21.7
    assert {message.reset_counter for message in heard} == {0}


def _north(message: mavlink.MAVLink_odometry_message) -> None:
    """Its velocity along north, east and down, as of another frame."""
    w, x, y, z = message.q
    turn = Rotation.from_quat([x, y, z, w])
    message.vx, message.vy, message.vz = turn.apply([message.vx, message.vy, message.vz])


def _left(message: mavlink.MAVLink_odometry_message) -> None:
    message.vy = -message.vy


def _angles_first(message: mavlink.MAVLink_odometry_message) -> None:
    told = np.zeros((6, 6))
    told[np.triu_indices(6)] = message.pose_covariance
    told = np.roll(told + np.triu(told, 1).T, (3, 3), (0, 1))
    message.pose_covariance = [*told[np.triu_indices(6)]]


@pytest.mark.parametrize("wrongly", [_north, _left, _angles_first])
def test_it_would_tell_wrong_axes(wrongly) -> None:
    heard, pilot = told(AutopilotSettings(**MOUNTED)), OdometryFilter()
    for message in heard:
        wrongly(message)
    missed = [pilot.take(message) for message in heard][20:]
    assert not 5.5 < np.mean(missed) < 9.5
    assert math.isfinite(np.mean(missed))
