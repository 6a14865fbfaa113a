"""Notes of poses on their way to a payload: told as the estimates that they are of, or refused."""

from __future__ import annotations

import queue
import time
from dataclasses import replace

import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.service import bus_messages
from ground_station.service.bus_messages import EstimateMessage, FrameMessage
from ground_station.service.intake.poses import PoseFeed, pose_message
from ground_station.service.localizing.derive import Accounts, estimate_note
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.autopilot.poses import PoseGate, rotation
from pi_firmware.settings import AutopilotSettings, TelemetrySettings
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire import keys, messages

NOW_NS = 77
LIMIT_S = 20.0
# A camera that looks along the map's x axis, upright: right is -y, down is -z, forward is x.
AHEAD = poses.pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [1.0, 2.0, 3.0])
FRAME = FrameMessage(0, 2, 9, 5, 6, 7, 640, 480, 1)
ESTIMATE = PoseEstimate(
    time_ns=5,
    index=9,
    state=State.TRACKING,
    wTc=poses.pose(poses.exp([0.3, -2.0, 1.1, 0, 0, 0])[:3, :3], [1.0, 2.0, 3.0]),
    covariance=np.diag([1.0, 2, 3, 4, 5, 6]) * 1e-4,
    relocalized=True,
)
NOTE = estimate_note(FRAME, ESTIMATE, Accounts(), "atrium", 8)


def told(estimate: PoseEstimate) -> messages.Pose:
    """An estimate on the whole way from the localizer to the payload."""
    note = estimate_note(FRAME, estimate, Accounts(), "atrium", 8)
    note = bus_messages.decode(EstimateMessage, bus_messages.encode(note))
    return messages.decode(messages.Pose, messages.encode(pose_message(note, NOW_NS)))


def test_a_solved_frame_is_where_the_autopilot_takes_it() -> None:
    # Standard deviations about and along the camera's right, down and forward.
    deviations = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    twist = np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.7])
    message = told(replace(ESTIMATE, wTc=AHEAD, covariance=np.diag(deviations**2), twist=twist))
    assert (message.time_ns, message.capture_ns, message.sequence) == (NOW_NS, 6, 9)
    assert message.relocalized
    gate = PoseGate(AutopilotSettings(uri="off:"))
    taken = gate.take(message, FRAME.clock_ns + 10**7)
    assert taken is not None
    np.testing.assert_allclose(taken.position_m, [1, -2, -3], atol=1e-12)  # north, east, down
    np.testing.assert_allclose(rotation(*taken.angles_rad), np.eye(3), atol=1e-12)
    assert taken.velocity_mps is not None and taken.turn_radps is not None
    np.testing.assert_allclose(taken.velocity_mps, [0.7, 0, 0], atol=1e-12)  # forward
    np.testing.assert_allclose(taken.turn_radps, [0, 0, 0.1], atol=1e-12)  # to the right
    # Ahead is north: forward is north, right is east, down is down; turns likewise.
    assert taken.covariance is not None
    expected = np.diag([0.3, 0.1, 0.2, 0.03, 0.01, 0.02]) ** 2
    np.testing.assert_allclose(taken.covariance, expected, atol=1e-12)


def test_a_tangent_step_of_the_estimate_is_one_of_the_message() -> None:
    """The covariance's order and side: a step that the estimate calls x is the message's x."""
    step = np.array([0.0, 0.02, 0.0, 0.3, 0.0, 0.0])
    message = told(replace(ESTIMATE, wTc=AHEAD, covariance=np.outer(step, step)))
    assert message.covariance is not None
    found = poses.inverse(AHEAD) @ AHEAD @ poses.exp(step)
    deviation = np.sqrt(np.diag(np.array(message.covariance).reshape(6, 6)))
    # About the camera's y by 0.02 rad, and along its x by 0.3 m to the first order.
    assert deviation == pytest.approx([0, 0.02, 0, 0.3, 0, 0])
    assert found[0, 3] == pytest.approx(0.3, abs=1e-3) and found[0, 2] == pytest.approx(0.02, 1e-3)


@pytest.mark.parametrize("state", [State.LOST, State.INITIALIZING, State.DEGRADED])
def test_a_frame_that_was_not_solved_has_no_pose(state: State) -> None:
    message = told(replace(ESTIMATE, state=state, wTc=None, relocalized=False))
    assert message.state == state.value
    assert message.position_m is message.quaternion_xyzw is message.covariance is None
    assert PoseGate(AutopilotSettings(uri="off:")).take(message, 1) is None


def test_poses_reach_the_payload_they_are_of() -> None:
    heard: dict[str, queue.Queue[messages.Pose]] = {"one": queue.Queue(), "two": queue.Queue()}
    with TelemetryListener(["tcp/127.0.0.1:0"]) as listener:
        settings = TelemetrySettings(connect=list(listener.endpoints))
        payloads = {name: Telemetry(name, settings) for name in heard}
        for name, telemetry in payloads.items():
            telemetry.on(keys.POSE, messages.Pose, heard[name].put)
        feed = PoseFeed(listener.session)
        deadline = time.monotonic() + LIMIT_S
        sequence = 0
        # What is said before the payload subscribed is lost, as it should be.
        while heard["one"].empty() and time.monotonic() < deadline:
            feed.send("one", pose_message(replace(NOTE, sequence=sequence), NOW_NS))
            sequence += 1
            time.sleep(0.05)
        said = heard["one"].get(timeout=LIMIT_S).sequence
        while said < sequence - 1:  # all that was said before has come
            said = heard["one"].get(timeout=LIMIT_S).sequence
        feed.again()  # a payload that waits for it may have missed it
        assert heard["one"].get(timeout=LIMIT_S).sequence == said
        assert heard["two"].empty()  # to whom nothing was said yet
        for telemetry in payloads.values():
            telemetry.close()
