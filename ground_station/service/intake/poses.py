"""Poses from the bus on their way to the payload, whose autopilot flies by them."""

from __future__ import annotations

import numpy as np

from ground_station.geometry import poses
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.service.notes import EstimateNote
from ground_station.service.pose_feed import PoseFeed


def estimate_of(note: EstimateNote) -> PoseEstimate:
    """The estimate that a note tells of, as far as the payload is told.

    Raises `ValueError` for a note whose state or numbers are not as agreed.
    """
    wTc = covariance = None
    if note.position_m is not None and note.quaternion_xyzw is not None:
        position = np.asarray(note.position_m, float).reshape(3)
        wTc = poses.from_quaternion(position, np.asarray(note.quaternion_xyzw, float).reshape(4))
    if note.covariance is not None:
        covariance = np.asarray(note.covariance, float).reshape(6, 6)
    return PoseEstimate(
        time_ns=note.time_ns,
        index=note.sequence,
        state=State(note.state),
        reason=note.reason,
        wTc=wTc,
        covariance=covariance,
        relocalized=note.relocalized,
    )


def publish(feed: PoseFeed, payload_id: str, note: EstimateNote) -> None:
    """Sends one estimate; raises `ValueError` for one that is not as agreed."""
    feed.publish(payload_id, estimate_of(note), capture_ns=note.clock_ns, sequence=note.sequence)
