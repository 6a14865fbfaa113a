"""Absolute trajectory error: association in time, alignment, errors of every pair, shares.

Every bound of this project means the RMSE of `position_m`, which is what evo prints.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, I64, Indices
from ground_station.errors import GeometryError, InputError
from ground_station.geometry import alignment, poses
from ground_station.geometry.alignment import Alignment
from ground_station.geometry.trajectory import Trajectory

ALIGNMENTS = ("none", "se3", "sim3")
MAX_DIFF_S = 0.01
THRESHOLDS = ((0.02, 1.0), (0.05, 2.0), (0.10, 5.0))
"""Metres and degrees, as usual for indoor relocalization."""


@dataclass(frozen=True)
class Statistics:
    """Of N errors, in their unit."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, errors: npt.ArrayLike) -> Statistics:
        """From errors (N,), N >= 1."""
        e = np.asarray(errors, dtype=np.float64)
        values = (math.sqrt(np.mean(e * e)), e.mean(), np.median(e), e.std(), e.min(), e.max())
        return cls(*(float(value) for value in values))


@dataclass(frozen=True)
class Errors:
    """What each of N pairs is off after an alignment, and the alignment itself.

    Each is (N,): `position_m` ‖p − p̂'‖; `rotation_deg` ‖log R·R̂'ᵀ‖; `position_zhang_m`
    ‖p − ΔR·p̂'‖ after Zhang and Scaramuzza, IROS 2018, which grows with the distance from the
    origin.
    """

    position_m: F64
    rotation_deg: F64
    position_zhang_m: F64
    alignment: Alignment

    def rmse(self) -> dict[str, float]:
        """The three RMSEs by name."""
        return {
            "position_m": Statistics.of(self.position_m).rmse,
            "rotation_deg": Statistics.of(self.rotation_deg).rmse,
            "position_zhang_m": Statistics.of(self.position_zhang_m).rmse,
        }

    def statistics(self) -> dict[str, dict[str, float]]:
        """All statistics of position and rotation by name."""
        return {
            "position_m": asdict(Statistics.of(self.position_m)),
            "rotation_deg": asdict(Statistics.of(self.rotation_deg)),
        }


@dataclass(frozen=True)
class Evaluation:
    """An estimate against the truth: the pairs, and their errors under each alignment.

    An alignment that the pairs do not determine has no errors but a line in `impossible`.
    """

    estimate: Trajectory
    truth: Trajectory
    errors: dict[str, Errors]
    impossible: dict[str, str]

    @property
    def pairs(self) -> int:
        return len(self.estimate)

    def ate(self) -> dict[str, dict[str, float] | None]:
        """The RMSEs of `none`, `se3` and `sim3`; None where an alignment is impossible."""
        return {
            name: self.errors[name].rmse() if name in self.errors else None for name in ALIGNMENTS
        }


def associate(
    estimate_ns: I64,
    truth_ns: I64,
    max_diff_s: float = MAX_DIFF_S,
) -> tuple[Indices, Indices]:
    """Indices of the pairs nearest in time, at most `max_diff_s` apart; both inputs sorted.

    evo's rule (1.38): each pose of the shorter trajectory (of the estimate, if as long) takes the
    nearest of the longer one, the earlier of two as near. Differences are taken in binary seconds
    as evo does, so that ties and the limit itself fall to the same side.
    """
    swap = len(estimate_ns) > len(truth_ns)
    short, long = (truth_ns, estimate_ns) if swap else (estimate_ns, truth_ns)
    if not len(short):
        return np.empty(0, np.intp), np.empty(0, np.intp)
    s, t = _seconds(short), _seconds(long)
    after = np.minimum(np.searchsorted(t, s, side="right"), len(t) - 1)
    ahead = t[after] - s
    behind = np.where(after > 0, s - t[after - 1], np.inf)
    take_after = (ahead <= max_diff_s) & (ahead < behind)
    take_before = ~take_after & (behind <= max_diff_s) & (behind <= ahead)
    inside = (s >= t[0] - max_diff_s) & (s <= t[-1] + max_diff_s)
    chosen = np.flatnonzero((take_after | take_before) & inside)
    partner = np.where(take_after, after, after - 1)[chosen]
    return (partner, chosen) if swap else (chosen, partner)


def _seconds(time_ns: I64) -> F64:
    """The doubles nearest to the decimal seconds; numpy would round a large int64 twice."""
    return np.array([t / 1_000_000_000 for t in time_ns.tolist()])


def synchronize(
    estimate: Trajectory, truth: Trajectory, max_diff_s: float = MAX_DIFF_S
) -> tuple[Trajectory, Trajectory]:
    """Both trajectories cut down to their pairs; raises `InputError` when there is none."""
    if not (math.isfinite(max_diff_s) and max_diff_s >= 0):
        raise InputError(f"--max-diff-s is {max_diff_s}; allowed: 0 s or more")
    i, j = associate(estimate.time_ns, truth.time_ns, max_diff_s)
    if not len(i):
        raise InputError(
            f"no estimated pose is within {max_diff_s:g} s of a true one "
            f"(estimate: {_span(estimate)}; truth: {_span(truth)})"
        )
    return estimate[i], truth[j]


def _span(trajectory: Trajectory) -> str:
    if not len(trajectory):
        return "no poses"
    return f"{trajectory.time_ns[0] / 1e9:.3f} to {trajectory.time_ns[-1] / 1e9:.3f} s"


def errors(estimate: Trajectory, truth: Trajectory, align: str = "none") -> Errors:
    """The errors of N pairs after aligning the estimate's positions to the truth's.

    `align` is `none`, `se3` or `sim3` (Umeyama 1991). Raises `GeometryError` when the positions do
    not determine the alignment.
    """
    if align == "none":
        motion = Alignment(np.eye(3), np.zeros(3), 1.0)
    elif align in ALIGNMENTS:
        motion = alignment.align(estimate.position_m, truth.position_m, align == "sim3")
    else:
        raise InputError(f"the alignment is {align!r}; allowed: {', '.join(ALIGNMENTS)}")
    p, p_hat = truth.position_m, motion.apply(estimate.position_m)
    R, R_hat = truth.wTc[:, :3, :3], motion.apply_poses(estimate.wTc)[:, :3, :3]
    dR = R @ np.swapaxes(R_hat, 1, 2)
    return Errors(
        position_m=np.linalg.norm(p - p_hat, axis=1),
        rotation_deg=np.degrees(poses.rotation_angle(dR)),
        position_zhang_m=np.linalg.norm(p - np.einsum("nij,nj->ni", dR, p_hat), axis=1),
        alignment=motion,
    )


def evaluate(estimate: Trajectory, truth: Trajectory, max_diff_s: float = MAX_DIFF_S) -> Evaluation:
    """Pairs the poses and takes the errors under all three alignments.

    Raises `InputError` when no pair is near enough in time.
    """
    estimate, truth = synchronize(estimate, truth, max_diff_s)
    found: dict[str, Errors] = {}
    impossible: dict[str, str] = {}
    for name in ALIGNMENTS:
        try:
            found[name] = errors(estimate, truth, name)
        except GeometryError as error:
            impossible[name] = str(error)
    return Evaluation(estimate, truth, found, impossible)


def shares(errors: Errors) -> list[dict[str, float]]:
    """The share of the pairs, 0 to 1, within each of `THRESHOLDS`."""
    return [
        {
            "position_m": m,
            "rotation_deg": deg,
            "share": float(np.mean((errors.position_m <= m) & (errors.rotation_deg <= deg))),
        }
        for m, deg in THRESHOLDS
    ]


def coverage(estimate: Trajectory, frame_ns: I64, max_diff_s: float = MAX_DIFF_S) -> float:
    """The share of frames (their times, sorted, (N,) ns) that have an estimated pose, 0 to 1."""
    if not len(frame_ns) or not len(estimate):
        return 0.0
    right = np.searchsorted(estimate.time_ns, frame_ns)
    left = np.maximum(right - 1, 0)
    right = np.minimum(right, len(estimate) - 1)
    nearest = np.minimum(
        np.abs(estimate.time_ns[left] - frame_ns), np.abs(estimate.time_ns[right] - frame_ns)
    )
    return float(np.mean(nearest <= max_diff_s * 1e9))
