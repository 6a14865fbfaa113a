"""What a viewer or pilot wants to know of a pose, from the estimate: pure functions."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from ground_station.arrays import F64, Indices
from ground_station.geometry.poses import from_quaternion, to_quaternion
from ground_station.localization.estimate import Counts, Observations, PoseEstimate, State
from ground_station.service.bus_messages import EstimateMessage, FrameMessage

MOST_POINTS = 300
STEEPEST_DEG = 85.0
"""A view that is steeper, up or down, has no heading: a little swing would turn it around."""


@dataclass(frozen=True)
class Accounts:
    """The frames of a payload's session: those taken, of these localized, and those not taken."""

    processed: int = 0
    localized: int = 0
    skipped: int = 0


def position_covariance(wTc: F64, covariance: F64) -> F64:
    """The position's covariance (3, 3) in world axes, m².

    `covariance` (6, 6) is of the right tangent of wTc (4, 4), rotation first: wTc·exp(ξ) moves the
    position by R·ξ_t to first order (Barfoot 2017, section 7.3.1), so it is R·Σ_tt·Rᵀ.
    """
    R = wTc[:3, :3]
    turned = R @ covariance[3:, 3:] @ R.T
    return np.asarray((turned + turned.T) / 2)


def world_velocity(wTc: F64, twist: F64 | None) -> F64 | None:
    """The camera's velocity (3,) in world axes, m/s, from a twist (6,) in its own axes.

    None for a twist of exactly zero, which stands for one that is not estimated (yet).
    """
    if twist is None or not np.isfinite(twist).all() or not twist.any():
        return None
    return np.asarray(wTc[:3, :3] @ twist[3:])


def heading_deg(wTc: F64) -> float | None:
    """Where the camera looks on the floor, degrees from the map's x axis towards y, -180 to 180.

    It is the camera's z axis without its vertical part; None where the view is within 5° of the
    vertical.
    """
    x, y, z = (float(value) for value in wTc[:3, 2])
    across = float(np.hypot(x, y))
    if np.rad2deg(np.arctan2(abs(z), across)) > STEEPEST_DEG:
        return None
    return float(np.rad2deg(np.arctan2(y, x)))


def shown(observations: Observations) -> Indices:
    """Which observations are told: the inliers, at most 300, evenly chosen in their order."""
    inliers = np.flatnonzero(observations.inlier)
    if len(inliers) > MOST_POINTS:
        inliers = inliers[np.arange(MOST_POINTS) * len(inliers) // MOST_POINTS]
    return inliers


def points_px(observations: Observations) -> list[float]:
    """Their pixels in the frame as it was taken (distorted), u, v by turns, to a tenth."""
    pixels = observations.pixel_px[shown(observations)]
    rounded: list[float] = np.round(pixels.astype(np.float64), 1).ravel().tolist()
    return rounded


def estimate_note(
    frame: FrameMessage, estimate: PoseEstimate, accounts: Accounts, map_name: str, done_ns: int
) -> EstimateMessage:
    """An estimate as the other processes take it; `done_ns` is this machine's wall clock.

    What is not finite is not told: without a finite pose the frame counts as LOST.
    """
    wTc = estimate.wTc
    if wTc is None or not np.isfinite(wTc).all():
        state = estimate.state if wTc is None else State.LOST
        reason = estimate.reason if wTc is None else "the pose is not finite"
        return unsolved_note(frame, state, reason, accounts, map_name, done_ns, estimate)
    covariance, sigma = estimate.covariance, None
    if covariance is not None:
        if np.isfinite(covariance).all():
            sigma = position_covariance(wTc, covariance).ravel().tolist()
        else:
            covariance = None
    twist = estimate.twist
    velocity = world_velocity(wTc, twist)
    return replace(
        unsolved_note(
            frame, estimate.state, estimate.reason, accounts, map_name, done_ns, estimate
        ),
        position_m=wTc[:3, 3].tolist(),
        quaternion_xyzw=to_quaternion(wTc).tolist(),
        covariance=None if covariance is None else covariance.ravel().tolist(),
        position_sigma_m=sigma,
        velocity_mps=None if velocity is None else velocity.tolist(),
        turn_radps=None if twist is None or velocity is None else twist[:3].tolist(),
        heading_deg=heading_deg(wTc),
        speed_mps=None if velocity is None else float(np.linalg.norm(velocity)),
        height_m=float(wTc[2, 3]),
        relocalized=estimate.relocalized,
        tracked=estimate.tracked,
        points_px=points_px(estimate.observations),
    )


def estimate_of(note: EstimateMessage, index: int) -> PoseEstimate:
    """The estimate that was told: without its observations, and but for what a frame adds to it."""
    wTc = covariance = None
    if note.position_m is not None and note.quaternion_xyzw is not None:
        wTc = from_quaternion(note.position_m, note.quaternion_xyzw)
    if note.covariance is not None:
        covariance = np.array(note.covariance).reshape(6, 6)
    return PoseEstimate(
        time_ns=note.time_ns,
        index=index,
        state=State(note.state),
        reason=note.reason,
        wTc=wTc,
        covariance=covariance,
        counts=Counts(projected=note.expected, inliers=note.inliers),
        stage_ms=note.stage_ms,
        relocalized=note.relocalized,
        tracked=note.tracked,
    )


def unsolved_note(
    frame: FrameMessage,
    state: State,
    reason: str,
    accounts: Accounts,
    map_name: str,
    done_ns: int,
    estimate: PoseEstimate | None = None,
) -> EstimateMessage:
    """A frame without a pose, and why; `estimate` where the localizer saw it."""
    counts = estimate.counts if estimate else Counts()
    stage_ms = estimate.stage_ms if estimate else {}
    return EstimateMessage(
        sequence=frame.sequence,
        time_ns=frame.time_ns,
        clock_ns=frame.clock_ns,
        capture_ns=frame.capture_ns,
        done_ns=done_ns,
        state=state.value,
        reason=reason,
        inliers=counts.inliers,
        expected=counts.projected,
        stage_ms={stage: round(value, 3) for stage, value in stage_ms.items()},
        map=map_name,
        **asdict(accounts),
    )
