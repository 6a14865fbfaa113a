"""Poses from the bus on their way to the payload, whose autopilot flies by them."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np

from ground_station.localization.estimate import State
from ground_station.service.bus_messages import EstimateMessage
from ground_station.service.pose_feed import PoseFeed, told_covariance
from pi_firmware.wire import messages


def pose_message(note: EstimateMessage, now_ns: int) -> messages.Pose:
    """What a payload is told of a message, as `pose_feed.pose_message` tells an estimate.

    Raises `ValueError` or `TypeError` for a message whose state or numbers are not as agreed.
    """
    state = State(note.state)
    position = quaternion = covariance = None
    if note.position_m is not None and note.quaternion_xyzw is not None:
        position = _numbers(note.position_m, 3)
        quaternion = _unit(_numbers(note.quaternion_xyzw, 4))
        if not all(map(math.isfinite, (*position, *quaternion))):
            position, quaternion, state = None, None, State.LOST
    if position is not None and note.covariance is not None:
        covariance = told_covariance(np.array(_numbers(note.covariance, 36)).reshape(6, 6))
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


def publish(feed: PoseFeed, payload_id: str, note: EstimateMessage) -> None:
    """Sends one estimate; raises as `pose_message`."""
    feed.send(payload_id, pose_message(note, time.time_ns()))


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
