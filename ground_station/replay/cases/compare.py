"""Two runs side by side: what differs, what got worse, and whether that is too much."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ground_station.arrays import F64, I64
from ground_station.errors import InputError
from ground_station.evaluation.figures import AT_LEAST
from ground_station.geometry import poses
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization.estimate import State
from ground_station.presentation.text import flat
from ground_station.replay.cases import frames, measure
from ground_station.replay.cases.case import BOUNDS
from ground_station.replay.cases.judge import balances
from ground_station.replay.cases.measure import Errors, Figure
from ground_station.replay.cases.outcome import Outcome
from ground_station.replay.cases.truth import Reference


@dataclass(frozen=True)
class Allowed:
    """How much worse B may be than A; None: as much as it likes.

    `over_m` and `over_deg` are of the RMSE against the truth, or of the difference between the runs
    where no truth is known; `over_max_m` of the worst TRACKING pose, `over_share` of coverage, the
    share of TRACKING and that of lost frames; `over_ms` of the median latency.
    """

    over_m: float | None = 0.02
    over_deg: float | None = 0.2
    over_max_m: float | None = 0.1
    over_share: float | None = 0.02
    over_ms: float | None = None
    identical: bool = False


@dataclass(frozen=True)
class Line:
    """One figure of both runs; `worse` is by how much B is worse than A (negative: better), None
    where it cannot be told. `allowed` is the most that B may be, None for any.
    """

    name: str
    a: float | None
    b: float | None
    unit: str
    worse: float | None
    allowed: float | None = None
    told: str = ""

    @property
    def fails(self) -> bool:
        """Whether B is worse than allowed, or has lost a figure that A had."""
        if self.allowed is None:
            return False
        if self.worse is None or math.isnan(self.worse):
            return self.a is not None
        return self.worse > self.allowed

    @property
    def weight(self) -> float:
        """How much worse, against what is allowed or a usual step of its unit."""
        if self.worse is None or math.isnan(self.worse):
            return math.inf if self.fails else 0.0
        return self.worse / (self.allowed or _USUAL.get(self.unit, 1.0))


_USUAL = {"m": 0.02, "°": 0.2, "share": 0.02, "ms": 20.0, "s": 0.5, "MB": 50.0, "V": 0.2}


@dataclass(frozen=True)
class Comparison:
    """Runs `a` and `b`; M frames are in both, in order of capture time.

    `time_ns`, `position_m` and `rotation_deg` are (M,), how far the poses of a pair are apart, NaN
    where not both have one. `errors_a` and `errors_b` are against the truth, where it is known.
    `lines` begin with what got worst; `settings` and `versions` are those that differ, each with
    both values. `moves` counts pairs by their two states, where these differ.
    """

    a: Outcome
    b: Outcome
    pairs: frames.Pairs
    time_ns: I64
    position_m: F64
    rotation_deg: F64
    first: frames.Difference
    errors_a: Errors | None
    errors_b: Errors | None
    lines: list[Line]
    settings: list[tuple[str, str, str]]
    versions: list[tuple[str, str, str]]
    moves: Counter[tuple[str, str]]
    notes: list[str] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        """Whether all poses and states are the same, bit for bit."""
        return self.first.count == 0

    @property
    def failed(self) -> list[Line]:
        """What is worse than allowed."""
        return [line for line in self.lines if line.fails]

    @property
    def states(self) -> dict[str, tuple[int, int]]:
        """Frames of each run by state."""
        names = [state.value for state in State]
        counts = [Counter(outcome.frames.state) for outcome in (self.a, self.b)]
        return {name: (counts[0][name], counts[1][name]) for name in names}


def compare(a: Outcome, b: Outcome, allowed: Allowed | None = None) -> Comparison:
    """Compares run B with run A; raises `InputError` when no frame of one is in the other."""
    allowed = allowed or Allowed()
    both = frames.pairs(a.frames, b.frames)
    if len(a.frames) and len(b.frames) and not len(both.a):
        raise InputError(
            f"{b.folder or 'B'}: none of its {len(b.frames)} frames was captured at the time of one"
            f" of {a.folder or 'A'}: it is another flight"
        )
    position, rotation = _apart(a, b, both)
    first = frames.first_difference(a.frames, b.frames)
    truth_a, truth_b = _truths(a, b)
    figures = [_figures(a, truth_a), _figures(b, truth_b)]
    lines = [
        *_measured(figures[0], figures[1], allowed),
        *_differences(position, rotation, allowed, truth_known=truth_a is not None),
        *_balances(a, b),
        _unlike(both, first, allowed),
    ]
    return Comparison(
        a,
        b,
        both,
        a.frames.time_ns[both.a],
        position,
        rotation,
        first,
        None if truth_a is None else measure.errors(a, truth_a),
        None if truth_b is None else measure.errors(b, truth_b),
        sorted(lines, key=lambda line: (not line.fails, -line.weight)),
        differing(_conditions(a), _conditions(b)),
        differing(a.run.versions, b.run.versions),
        _moves(a, b, both),
        _notes(a, b),
    )


def differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Dotted keys whose values differ, with both; "—" where one has none."""
    flat_a, flat_b = ({key: str(value) for key, value in flat(of).items()} for of in (a, b))
    keys = sorted(set(flat_a) | set(flat_b))
    return [
        (key, flat_a.get(key, "—"), flat_b.get(key, "—"))
        for key in keys
        if flat_a.get(key) != flat_b.get(key)
    ]


_OF_RUN = ("recording", "map", "map_sha256", "preset", "init", "stepped", "rate_hz", "seed",
           "payload", "link", "case")  # fmt: skip


def _conditions(outcome: Outcome) -> dict[str, Any]:
    return {name: getattr(outcome.run, name) for name in _OF_RUN} | outcome.run.settings


def _truths(a: Outcome, b: Outcome) -> tuple[Trajectory | None, Trajectory | None]:
    """Each run's own truth, or the other's where both flew the same recording."""
    if a.run.recording == b.run.recording:
        return (a.truth or b.truth), (b.truth or a.truth)
    return a.truth, b.truth


def _figures(outcome: Outcome, truth: Trajectory | None) -> dict[str, Figure]:
    return measure.figures(outcome, None if truth is None else Reference(truth, "the truth"))


def _apart(a: Outcome, b: Outcome, both: frames.Pairs) -> tuple[F64, F64]:
    """How far the poses of each pair are apart: metres (M,) and degrees (M,)."""
    apart_m = np.linalg.norm(a.frames.position_m[both.a] - b.frames.position_m[both.b], axis=1)
    apart_deg = np.full(len(both.a), np.nan)
    whole = a.frames.finite[both.a] & b.frames.finite[both.b]
    apart_m[~whole] = np.nan
    if whole.any():
        Ra, Rb = (
            poses.from_quaternion(f.position_m[k], f.quaternion_xyzw[k])[:, :3, :3]
            for f, k in ((a.frames, both.a[whole]), (b.frames, both.b[whole]))
        )
        apart_deg[whole] = np.degrees(poses.rotation_angle(Ra @ np.swapaxes(Rb, 1, 2)))
    return apart_m, apart_deg


def _measured(a: dict[str, Figure], b: dict[str, Figure], allowed: Allowed) -> list[Line]:
    limits = {
        "coverage": allowed.over_share,
        "tracking": allowed.over_share,
        "lost": allowed.over_share,
        "position_rmse_m": allowed.over_m,
        "rotation_rmse_deg": allowed.over_deg,
        "tracking_worst_m": allowed.over_max_m,
        "latency_p50_ms": allowed.over_ms,
    }
    found = []
    for figure, unit, sense in dict.fromkeys(
        (f, u, s) for _, f, u, s in BOUNDS if f != "battery_V"
    ):
        one, other = a[figure], b[figure]
        if one.value is None and other.value is None:
            continue
        worse = None
        if one.value is not None and other.value is not None:
            worse = (one.value - other.value) if sense == AT_LEAST else (other.value - one.value)
        told = other.told if other.value is None else ""
        found.append(Line(figure, one.value, other.value, unit, worse, limits.get(figure), told))
    return found


def _differences(
    position: F64, rotation: F64, allowed: Allowed, *, truth_known: bool
) -> list[Line]:
    """The poses of both runs against each other; judged where no truth says which is right."""
    found = []
    for name, values, unit, limit in (
        ("position_difference", position, "m", allowed.over_m),
        ("rotation_difference", rotation, "deg", allowed.over_deg),
    ):
        known = values[np.isfinite(values)]
        if not len(known):
            continue
        rms, worst = float(np.sqrt(np.mean(known**2))), float(known.max())
        sign, told = ("°" if unit == "deg" else unit), f"{len(known)} pairs"
        # Not worse by itself: with a truth, its errors say whether it is.
        judged = None if truth_known else limit
        found.append(Line(f"{name}_rms_{unit}", None, rms, sign, None if truth_known else rms,
                          judged, told))  # fmt: skip
        found.append(Line(f"{name}_max_{unit}", None, worst, sign, None, None, told))
    return found


def _balances(a: Outcome, b: Outcome) -> list[Line]:
    """Sums of frames that come out in A must come out in B."""
    found = []
    for one, other in zip(balances(a), balances(b), strict=True):
        if not other.holds:
            told = other.told or f"off by {other.value:g}"
            worse = float(bool(one.holds))
            found.append(Line(other.name, one.value, other.value, "frames", worse, 0.0, told))
    broken = [o.frames.broken for o in (a, b)]
    if any(broken):
        worse = float(broken[1] - broken[0])
        found.append(
            Line("poses not finite", float(broken[0]), float(broken[1]), "poses", worse, 0.0)
        )
    return found


def _unlike(both: frames.Pairs, first: frames.Difference, allowed: Allowed) -> Line:
    limit = 0.0 if allowed.identical else None
    count = float(first.count)
    worse = count if allowed.identical else None
    told = f"{len(both.a)} in both, {len(both.only_a)} in A only, {len(both.only_b)} in B only"
    return Line("frames that differ", None, count, "frames", worse, limit, told)


def _moves(a: Outcome, b: Outcome, both: frames.Pairs) -> Counter[tuple[str, str]]:
    states = [
        (a.frames.state[i], b.frames.state[j])
        for i, j in zip(both.a.tolist(), both.b.tolist(), strict=True)
    ]
    return Counter(pair for pair in states if pair[0] != pair[1])


def _notes(a: Outcome, b: Outcome) -> list[str]:
    found = []
    if a.run.recording != b.run.recording:
        found.append(f"They flew recordings of different names: {a.run.recording} and "
                     f"{b.run.recording}.")  # fmt: skip
    if a.run.map_sha256 != b.run.map_sha256:
        found.append(f"Their maps differ: {a.run.map} and {b.run.map}.")
    for name, outcome in (("A", a), ("B", b)):
        found += [f"{name}: {note}" for note in outcome.run.notes]
        if not len(outcome.frames):
            found.append(f"{name}: no frame reached the localizer.")
    return found
