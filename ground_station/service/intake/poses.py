"""Poses from the bus on their way back to the payload, whose autopilot flies by them."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from typing import Any

from ground_station.localization.estimate import State
from ground_station.service.bus_messages import EstimateMessage
from pi_firmware.wire import keys, messages
from pi_firmware.wire.telemetry import Session


def pose_message(note: EstimateMessage, now_ns: int) -> messages.Pose:
    """An estimate as the payload takes it; `now_ns` is the ground's clock.

    Its capture time is the payload's clock at capture and not the estimate's own time: a payload
    that replays a flight has recorded times there, and the autopilot's side judges a pose's age by
    the payload's clock. The covariance is of the right tangent, rotation first, row by row. What is
    not finite is not told: without a finite pose the frame counts as LOST. Raises `ValueError` or
    `TypeError` for a message whose state or numbers are not as agreed.
    """
    state = State(note.state)
    position = quaternion = covariance = None
    if note.position_m is not None and note.quaternion_xyzw is not None:
        position = _numbers(note.position_m, 3)
        quaternion = _unit(_numbers(note.quaternion_xyzw, 4))
        if not all(map(math.isfinite, (*position, *quaternion))):
            position, quaternion, state = None, None, State.LOST
    if position is not None and note.covariance is not None:
        covariance = _numbers(note.covariance, 36)
        if not all(map(math.isfinite, covariance)):
            covariance = None
    return messages.Pose(
        time_ns=now_ns,
        capture_ns=note.clock_ns,
        sequence=note.sequence,
        state=state.value,
        position_m=position,
        quaternion_xyzw=quaternion,
        covariance=covariance,
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

    def again(self) -> None:
        """Sends each payload its newest once more: one that waits for it may not have had it."""
        for payload_id, message in list(self._newest.items()):
            self.send(payload_id, message)


def _numbers(values: Sequence[float], count: int) -> list[float]:
    numbers = [float(value) for value in values]
    if len(numbers) != count:
        raise ValueError(f"{len(numbers)} numbers, not {count}")
    return numbers


def _unit(quaternion: Sequence[float]) -> list[float]:
    """Of length 1 and with w >= 0; raises `ValueError` for one of no length."""
    length = math.hypot(*quaternion)
    if length == 0.0:
        raise ValueError("a quaternion of length 0")
    scale = math.copysign(1.0 / length, quaternion[3])
    return [scale * value for value in quaternion]
