"""What is told of a flight: latencies by the payload's clock, and each frame accounted for."""

import numpy as np
import pytest

from ground_station.localization.estimate import PoseEstimate, State
from ground_station.replay.live import LiveFrame, LiveResult
from ground_station.service.bus_messages import FrameMessage, PayloadMessage
from ground_station.service.localizing.derive import Accounts, estimate_note, estimate_of

CAPTURED_NS = 60 * 10**9  # the payload booted a minute ago and believes it is 1970
NOW_NS = 1_900_000_000 * 10**9
LOST = PoseEstimate(time_ns=5, index=3, state=State.LOST)


def test_latencies_are_by_the_payloads_clock_as_it_was_measured() -> None:
    """A payload in 1970: what came before the first answer is by that one, and both are exact."""
    frames = [
        LiveFrame(i, CAPTURED_NS, NOW_NS + 10**6, NOW_NS + 20 * 10**6, LOST, capture_ns)
        for i, capture_ns in enumerate([None, NOW_NS, NOW_NS - 1000])
    ]
    assert LiveResult(frames=frames).latency_ms() == pytest.approx([20.0, 20.0, 20.001])


def test_without_an_answer_both_clocks_are_taken_for_one() -> None:
    frames = [LiveFrame(0, 5 * 10**6, 6 * 10**6, 9 * 10**6, LOST)]
    assert LiveResult(frames=frames).latency_ms() == pytest.approx([4.0])


def test_frames_are_accounted_for_by_each_who_saw_them() -> None:
    told = {"captured": 9, "gated": 1, "discarded": 1, "sent": 7, "received": 5}
    result = LiveResult(
        frames=[LiveFrame(k, k, k, k, LOST) for k in range(3)],
        payload=PayloadMessage(True, 0, frames=told, ended=True),
        dropped=2,
    )
    assert result.complete
    assert result.accounts() == told | {"lost": 2, "dropped": 2, "localized": 0}


def test_a_payload_that_never_told_is_accounted_for_by_what_came() -> None:
    result = LiveResult(frames=[LiveFrame(0, 0, 0, 0, LOST)], dropped=1)
    accounts = result.accounts()
    assert accounts["captured"] == accounts["sent"] == accounts["received"] == 2
    assert not result.complete


def test_an_estimate_comes_back_from_its_message_as_it_was() -> None:
    wTc = np.eye(4)
    wTc[:3, 3] = [1.0, -2.0, 0.3]
    estimate = PoseEstimate(
        time_ns=5, index=3, state=State.TRACKING, reason="r", wTc=wTc,
        covariance=np.diag([1.0, 2, 3, 4, 5, 6]), stage_ms={"total": 7.5}, relocalized=True,
    )  # fmt: skip
    frame = FrameMessage(0, 2, 9, 5, 6, 7, 640, 480, 1)
    told = estimate_of(estimate_note(frame, estimate, Accounts(), "atrium", 8), 3)
    for name in ("time_ns", "index", "state", "reason", "stage_ms", "relocalized", "tracked"):
        assert getattr(told, name) == getattr(estimate, name)
    assert told.wTc is not None and told.covariance is not None
    np.testing.assert_array_equal(told.wTc, wTc)
    np.testing.assert_array_equal(told.covariance, estimate.covariance)
    lost = estimate_of(estimate_note(frame, LOST, Accounts(), "atrium", 8), 3)
    assert lost.wTc is None and lost.covariance is None and lost.state is State.LOST
