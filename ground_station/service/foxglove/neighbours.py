"""Where the other blimps are as one of them sees it: relative poses with covariance."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.service.bus_messages import EstimateMessage
from ground_station.service.foxglove import conversion
from ground_station.service.foxglove.conversion import Solved

OLD_S = 1.0
"""A pose is carried on for so long by the velocity it came with; an older one is left out."""


@dataclass(frozen=True)
class Neighbour:
    """Another blimp's camera in the axes of one's own, x forward, y left, z up, at one's own time.

    `age_s` is how far its pose was carried on to that time; `distance_sigma_m` is None where
    either pose came without a covariance.
    """

    payload_id: str
    pose: Solved
    age_s: float
    distance_m: float
    distance_sigma_m: float | None


def neighbours(
    payload_id: str, own: EstimateMessage, others: Mapping[str, EstimateMessage]
) -> Iterator[Neighbour]:
    """Those of `others` that have a pose in the same coordinates within a second of `own`, by name.

    With right tangents a and b of both poses the relative one, inverse(wTa)·wTb, moves by
    b - Ad(bTa)·a (Barfoot 2017, section 7.1.5). The errors of two cameras are taken as
    independent: what the map is off for both alike counts twice. The velocity's own error is left
    out, and the stations' clocks are taken as one.
    """
    here = _pose(own)
    if here is None:
        return
    stamp_ns = conversion.stamp_ns(own)
    for name in sorted(others.keys() - {payload_id}):
        note = others[name]
        there, age_s = _pose(note), 1e-9 * (stamp_ns - conversion.stamp_ns(note))
        apart = (note.coordinates or note.map) != (own.coordinates or own.map)
        if there is None or apart or abs(age_s) > OLD_S:
            continue
        aTb = conversion.OPTICAL_IN_CAMERA @ poses.inverse(here) @ _carried(there, note, age_s)
        distance_m, covariance, sigma_m = math.hypot(*aTb[:3, 3]), None, None
        if own.covariance is not None and note.covariance is not None:
            ad = poses.adjoint(poses.inverse(aTb) @ conversion.OPTICAL_IN_CAMERA)
            tangent = ad @ np.reshape(own.covariance, (6, 6)) @ ad.T
            covariance = conversion.ros_covariance(
                aTb, tangent + np.reshape(note.covariance, (6, 6))
            )
            if distance_m > 0:
                towards = aTb[:3, 3] / distance_m
                sigma_m = math.sqrt(max(0.0, float(towards @ covariance[:3, :3] @ towards)))
        pose = Solved(conversion.body_pose(aTb), covariance)
        yield Neighbour(name, pose, age_s, distance_m, sigma_m)


def _pose(note: EstimateMessage) -> F64 | None:
    """wTc (4, 4) of the optical axes, of a pose that may be relied on."""
    if note.state not in ("TRACKING", "DEGRADED"):
        return None
    if note.position_m is None or note.quaternion_xyzw is None:
        return None
    return poses.from_quaternion(note.position_m, note.quaternion_xyzw)


def _carried(wTc: F64, note: EstimateMessage, s: float) -> F64:
    """A pose (4, 4) after `s` seconds of its velocity (world axes) and turn (camera's axes)."""
    if note.velocity_mps is None or note.turn_radps is None:
        return wTc
    moved = wTc @ poses.exp([*(s * np.array(note.turn_radps)), 0.0, 0.0, 0.0])
    moved[:3, 3] = wTc[:3, 3] + s * np.array(note.velocity_mps)
    return np.asarray(moved)
