"""Poses on their way back to the payload, whose autopilot flies by them."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.localization.estimate import PoseEstimate, State
from pi_firmware.wire import keys, messages
from pi_firmware.wire.telemetry import Session


def pose_message(
    estimate: PoseEstimate, *, capture_ns: int, sequence: int, now_ns: int
) -> messages.Pose:
    """An estimate as the payload takes it; `capture_ns` is on the payload's clock at capture.

    Not the estimate's own time: a payload that replays a flight has recorded times there, and the
    autopilot's side judges a pose's age by the payload's clock. `now_ns` is the ground's. The
    covariance is the estimate's, of the right tangent and rotation first, row by row. What is not
    finite is not told: without a finite pose the frame counts as LOST.
    """
    from ground_station.geometry.poses import to_quaternion  # scipy: not for who only forwards

    wTc = estimate.wTc
    state = estimate.state
    if wTc is not None and not np.isfinite(wTc).all():
        wTc, state = None, State.LOST
    return messages.Pose(
        time_ns=now_ns,
        capture_ns=capture_ns,
        sequence=sequence,
        state=state.value,
        position_m=None if wTc is None else wTc[:3, 3].tolist(),
        quaternion_xyzw=None if wTc is None else to_quaternion(wTc).tolist(),
        covariance=None if wTc is None else told_covariance(estimate.covariance),
        relocalized=estimate.relocalized,
    )


def told_covariance(covariance: npt.NDArray[np.float64] | None) -> list[float] | None:
    """A covariance (6, 6) row by row; None where it is not finite."""
    if covariance is None or not np.isfinite(covariance).all():
        return None
    values: list[float] = covariance.ravel().tolist()
    return values


class PoseFeed:
    """Publishes estimates to the payloads whose frames they are of, over an open session."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._publishers: dict[str, Any] = {}
        self._newest: dict[str, messages.Pose] = {}

    def publish(
        self, payload_id: str, estimate: PoseEstimate, *, capture_ns: int, sequence: int
    ) -> None:
        """Sends one estimate, solved or not; see `pose_message`. One that cannot go is dropped."""
        self.send(
            payload_id,
            pose_message(estimate, capture_ns=capture_ns, sequence=sequence, now_ns=time.time_ns()),
        )

    def send(self, payload_id: str, message: messages.Pose) -> None:
        """Sends a pose as it is to be told. One that cannot go is dropped."""
        import zenoh

        self._newest[payload_id] = message
        if payload_id not in self._publishers:
            # At once, or not at all: the next frame has a newer one.
            self._publishers[payload_id] = self._session.zenoh.declare_publisher(
                keys.key(payload_id, keys.POSE),
                congestion_control=zenoh.CongestionControl.DROP,
                express=True,
            )
        with contextlib.suppress(zenoh.ZError):
            self._publishers[payload_id].put(messages.encode(message))

    def again(self, payload_id: str) -> None:
        """Sends the newest once more, for a payload that waits for it and may not have had it."""
        if payload_id in self._newest:
            self.send(payload_id, self._newest[payload_id])
