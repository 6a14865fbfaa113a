"""Notes from the bus, taken only when they are what they say: a field may hold any JSON value."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.geometry import poses
from ground_station.service.bus_messages import EstimateMessage, EventMessage, FrameMessage
from ground_station.service.foxglove import conversion

Array = npt.NDArray[np.float64]

LAST_NS = (1 << 32) * 1_000_000_000 - 1
"""Foxglove's stamps have 32 bits of seconds."""
_LARGEST = 1e12
_POINTS = 600  # numbers: 300 pixels


@dataclass(frozen=True)
class Solved:
    """A pose as it goes out: `wTc` (4, 4) of the body axes; `covariance` (6, 6) in ROS's order."""

    wTc: Array
    covariance: Array | None

    @property
    def position_m(self) -> list[float]:
        """x, y, z."""
        values: list[float] = self.wTc[:3, 3].tolist()
        return values

    @property
    def quaternion_xyzw(self) -> list[float]:
        """x, y, z, w."""
        values: list[float] = poses.to_quaternion(self.wTc).tolist()
        return values


def stamp_ns(note: FrameMessage | EstimateMessage) -> int:
    """When its picture was taken, on this machine's clock; arrival or solution while unknown."""
    later_ns = note.arrival_ns if isinstance(note, FrameMessage) else note.done_ns
    for found_ns in (note.capture_ns, later_ns):
        if found_ns is not None and is_time(found_ns):
            return found_ns
    return time.time_ns()


def is_time(value: object) -> bool:
    """Whether it can be a stamp."""
    return type(value) is int and 0 <= value <= LAST_NS


def is_event(note: EventMessage) -> bool:
    """Whether it is text throughout: it is kept, and told to all who come later."""
    words = (note.source, note.level, note.name, note.text)
    return all(isinstance(word, str) for word in words)


def solved(note: EstimateMessage) -> Solved | None:
    """The note's pose; None when it has none, or one that cannot be."""
    position, quaternion = numbers(note.position_m, 3), numbers(note.quaternion_xyzw, 4)
    if position is None or quaternion is None or not 0.5 < np.linalg.norm(quaternion) < 2:
        return None
    wTo = poses.from_quaternion(position, quaternion)
    covariance = numbers(note.covariance, 36)
    if covariance is not None:
        covariance = conversion.ros_covariance(wTo, covariance)
        if np.diag(covariance).min() < 0:
            covariance = None
    return Solved(conversion.body_pose(wTo), covariance)


def points(note: EstimateMessage) -> list[tuple[float, float]]:
    """The tracked landmarks' pixels u, v; none when they cannot be."""
    flat = note.points_px
    if not isinstance(flat, list) or len(flat) % 2 or not all(map(_finite, flat)):
        return []
    flat = flat[:_POINTS]
    return list(zip(flat[::2], flat[1::2], strict=True))


def numbers(value: object, count: int) -> Array | None:
    """`count` finite numbers as an array; None for anything else."""
    if not isinstance(value, list) or len(value) != count or not all(map(_finite, value)):
        return None
    return np.array(value, dtype=np.float64)


def _finite(value: object) -> bool:
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and abs(value) < _LARGEST
        and math.isfinite(value)
    )
