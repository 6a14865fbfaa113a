"""Notes of poses on their way to a payload: told as the estimates that they are of, or refused."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.service import pose_feed
from ground_station.service.bus_messages import EstimateMessage, FrameMessage
from ground_station.service.intake.poses import pose_message
from ground_station.service.localizing.derive import Accounts, estimate_note
from pi_firmware.wire import messages

NOW_NS = 77
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


@pytest.mark.parametrize("wTc", [ESTIMATE.wTc, None])
def test_a_note_is_told_as_its_estimate(wTc: Any) -> None:
    estimate = replace(ESTIMATE, wTc=wTc, relocalized=wTc is not None)
    note = estimate_note(FRAME, estimate, Accounts(), "atrium", 8)
    told = pose_message(note, NOW_NS)
    expected = pose_feed.pose_message(
        estimate, capture_ns=FRAME.clock_ns, sequence=FRAME.sequence, now_ns=NOW_NS
    )
    assert replace(told, quaternion_xyzw=None) == replace(expected, quaternion_xyzw=None)
    if wTc is not None:
        assert told.quaternion_xyzw == pytest.approx(expected.quaternion_xyzw, abs=1e-12)
    assert messages.decode(messages.Pose, messages.encode(told)) == told


def test_a_quaternion_is_told_of_length_one_and_with_w_from_zero() -> None:
    assert NOTE.quaternion_xyzw is not None
    turned = [-2.0 * value for value in NOTE.quaternion_xyzw]
    told = pose_message(replace(NOTE, quaternion_xyzw=turned), NOW_NS)
    assert told.quaternion_xyzw == pytest.approx(NOTE.quaternion_xyzw)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_finite_is_told_as_lost_or_left_out(value: float) -> None:
    told = pose_message(replace(NOTE, position_m=[0.0, value, 0.0]), NOW_NS)
    assert told.state == "LOST" and told.position_m is told.covariance is None
    told = pose_message(replace(NOTE, covariance=[value] * 36), NOW_NS)
    assert told.state == "TRACKING" and told.position_m and told.covariance is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"state": "FINE"},
        {"position_m": [1.0, 2.0]},
        {"position_m": 3},
        {"position_m": ["a", 1.0, 2.0]},
        {"quaternion_xyzw": [0.0] * 4},
        {"covariance": [1.0] * 35},
    ],
)
def test_a_note_that_is_not_as_agreed_is_refused(wrong: dict[str, Any]) -> None:
    note: EstimateMessage = replace(NOTE, **wrong)
    with pytest.raises((ValueError, TypeError)):
        pose_message(note, NOW_NS)
