"""A pose goes back to the payload as its autopilot reads it."""

import math
import queue
import time
from typing import Any

import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.replay.live import LiveFrame, LiveResult
from ground_station.service.pose_feed import PoseFeed, pose_message
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.autopilot.frames import rotation
from pi_firmware.autopilot.poses import PoseGate
from pi_firmware.settings import AutopilotSettings, TelemetrySettings
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire import messages
from pi_firmware.wire.clock_offset import Offset

LIMIT_S = 20.0
CAPTURED_NS = 60 * 10**9  # the payload booted a minute ago and believes it is 1970
# A camera that looks along the map's x axis, upright: right is -y, down is -z, forward is x.
AHEAD = poses.pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [1.0, 2.0, 3.0])


def estimate(state: State = State.TRACKING, **fields: Any) -> PoseEstimate:
    values: dict[str, Any] = {"time_ns": 5, "index": 3, "wTc": AHEAD}
    return PoseEstimate(state=state, **(values | fields))


def test_a_solved_frame_is_where_the_autopilot_takes_it() -> None:
    # Standard deviations about and along the camera's right, down and forward.
    deviations = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    covariance = np.diag(deviations**2)
    message = pose_message(
        estimate(covariance=covariance), capture_ns=CAPTURED_NS, sequence=9, now_ns=7
    )
    assert (message.time_ns, message.capture_ns, message.sequence) == (7, CAPTURED_NS, 9)
    gate = PoseGate(AutopilotSettings(uri="off:"))
    taken = gate.take(messages.decode(messages.Pose, messages.encode(message)), CAPTURED_NS + 10**7)
    assert taken is not None and gate.counts.passed == 1
    np.testing.assert_allclose(taken.position_m, [1, -2, -3], atol=1e-12)  # north, east, down
    np.testing.assert_allclose(rotation(*taken.angles_rad), np.eye(3), atol=1e-12)
    # Ahead is north: forward is north, right is east, down is down; turns likewise.
    assert taken.covariance is not None
    expected = np.diag([0.3, 0.1, 0.2, 0.03, 0.01, 0.02]) ** 2
    np.testing.assert_allclose(taken.covariance, expected, atol=1e-12)


def test_a_tangent_step_of_the_estimate_is_one_of_the_message() -> None:
    """The covariance's order and side: a step that the estimate calls x is the message's x."""
    step = np.array([0.0, 0.02, 0.0, 0.3, 0.0, 0.0])
    covariance = np.outer(step, step)
    message = pose_message(estimate(covariance=covariance), capture_ns=1, sequence=0, now_ns=1)
    assert message.covariance is not None
    told = np.array(message.covariance).reshape(6, 6)
    moved = AHEAD @ poses.exp(step)
    found = poses.inverse(AHEAD) @ moved
    deviation = np.sqrt(np.diag(told))
    # About the camera's y by 0.02 rad, and along its x by 0.3 m to the first order.
    assert deviation == pytest.approx([0, 0.02, 0, 0.3, 0, 0])
    assert found[0, 3] == pytest.approx(0.3, abs=1e-3) and found[0, 2] == pytest.approx(0.02, 1e-3)


@pytest.mark.parametrize("state", [State.LOST, State.INITIALIZING, State.DEGRADED])
def test_a_frame_that_was_not_solved_has_no_pose(state: State) -> None:
    message = pose_message(estimate(state, wTc=None), capture_ns=1, sequence=0, now_ns=1)
    assert message.state == state.value
    assert message.position_m is message.quaternion_xyzw is message.covariance is None
    assert PoseGate(AutopilotSettings(uri="off:")).take(message, 1) is None


def test_what_is_not_finite_is_not_told() -> None:
    broken = AHEAD.copy()
    broken[0, 3] = math.nan
    message = pose_message(estimate(wTc=broken), capture_ns=1, sequence=0, now_ns=1)
    assert message.state == "LOST" and message.position_m is None
    vague = estimate(covariance=np.full((6, 6), math.inf))
    message = pose_message(vague, capture_ns=1, sequence=0, now_ns=1)
    assert message.state == "TRACKING" and message.position_m and message.covariance is None
    messages.encode(message)


def test_a_relocalized_frame_is_told_so() -> None:
    message = pose_message(estimate(relocalized=True), capture_ns=1, sequence=0, now_ns=1)
    assert message.relocalized


def test_poses_reach_the_payload_they_are_of() -> None:
    heard: dict[str, queue.Queue[messages.Pose]] = {"one": queue.Queue(), "two": queue.Queue()}
    with TelemetryListener(["tcp/127.0.0.1:0"]) as listener:
        settings = TelemetrySettings(connect=list(listener.endpoints))
        payloads = {name: Telemetry(name, settings) for name in heard}
        for name, telemetry in payloads.items():
            telemetry.on_pose(heard[name].put)
        feed = PoseFeed(listener.session)
        deadline = time.monotonic() + LIMIT_S
        sequence = 0
        # What is said before the payload subscribed is lost, as it should be.
        while heard["one"].empty() and time.monotonic() < deadline:
            feed.publish("one", estimate(), capture_ns=CAPTURED_NS, sequence=sequence)
            sequence += 1
            time.sleep(0.05)
        first = heard["one"].get(timeout=LIMIT_S)
        assert first.state == "TRACKING" and first.capture_ns == CAPTURED_NS
        said = first.sequence
        while said < sequence - 1:  # all that was said before has come
            said = heard["one"].get(timeout=LIMIT_S).sequence
        feed.again("one")  # a payload that waits for it may have missed it
        assert heard["one"].get(timeout=LIMIT_S).sequence == said
        feed.again("two")  # to whom nothing was said yet
        assert heard["two"].empty()
        for telemetry in payloads.values():
            telemetry.close()


def test_latencies_are_by_the_payloads_clock_as_it_was_measured() -> None:
    """A payload in 1970: what came before the first answer is by that one, and both are exact."""
    now_ns = 1_900_000_000 * 10**9
    offset = Offset(offset_ns=CAPTURED_NS - now_ns, uncertainty_ns=400, steps=0)
    later = Offset(offset.offset_ns + 1000, 300, 1)
    frames = [
        LiveFrame(i, CAPTURED_NS, now_ns + 10**6, now_ns + 20 * 10**6, estimate(), at)
        for i, at in enumerate([None, offset, later])
    ]
    result = LiveResult(frames=frames, offset=later)
    assert result.latency_ms() == pytest.approx([20.0, 20.0, 20.001])
    assert result.clock_offset() == {
        "offset_ns": later.offset_ns, "uncertainty_ns": 400, "steps": 1,
    }  # fmt: skip


def test_without_an_answer_both_clocks_are_taken_for_one_and_it_is_told() -> None:
    frames = [LiveFrame(0, 5 * 10**6, 6 * 10**6, 9 * 10**6, estimate())]
    result = LiveResult(frames=frames)
    assert result.latency_ms() == pytest.approx([4.0]) and result.clock_offset() is None
