"""Poses from the bus on their way back to the payload, whose autopilot flies by them."""

from __future__ import annotations

import contextlib
from typing import Any

from ground_station.service.bus_messages import EstimateMessage
from pi_firmware.wire import keys, messages
from pi_firmware.wire.telemetry import Session


def pose_message(note: EstimateMessage, now_ns: int) -> messages.Pose:
    """An estimate as the payload takes it; `now_ns` is the ground's clock.

    Its capture time is the payload's clock at capture and not the estimate's own time: a payload
    that replays a flight has recorded times there, and the autopilot's side judges a pose's age by
    the payload's clock. The covariance is of the right tangent, rotation first, row by row.
    """
    return messages.Pose(
        time_ns=now_ns,
        capture_ns=note.clock_ns,
        sequence=note.sequence,
        state=note.state,
        position_m=note.position_m,
        quaternion_xyzw=note.quaternion_xyzw,
        covariance=note.covariance,
        velocity_mps=note.velocity_mps,
        turn_radps=note.turn_radps,
        quality=min(1.0, note.inliers / note.expected) if note.expected > 0 else None,
        relocalized=note.relocalized,
    )


class PoseFeed:
    """Publishes poses to the payloads whose frames they are of, over an open session."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._publishers: dict[str, Any] = {}
        self._newest: dict[str, messages.Pose] = {}

    def send(self, payload_id: str, message: messages.Pose) -> None:
        """Sends a pose, solved or not. One that cannot go is dropped."""
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

    def newest(self, payload_id: str) -> messages.Pose | None:
        """What a payload was told last."""
        return self._newest.get(payload_id)

    def again(self) -> None:
        """Sends each payload its newest once more: one that waits for it may not have had it."""
        for payload_id, message in list(self._newest.items()):
            self.send(payload_id, message)
