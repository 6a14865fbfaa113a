"""A run's figures, each with what it was taken from, or why it could not be taken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_station.arrays import F64, Indices
from ground_station.evaluation import ate
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization.estimate import State
from ground_station.replay.cases.frames import UNKNOWN
from ground_station.replay.cases.outcome import Outcome
from ground_station.replay.cases.truth import Reference


@dataclass(frozen=True)
class Figure:
    """A measured value, `told` where it comes from; None: not measured, `told` is why."""

    value: float | None
    told: str = ""


@dataclass(frozen=True)
class Errors:
    """P poses that have a true one at their time: how far each is off.

    `frame` (P,) are indices into the outcome's frames; `position_m` and `rotation_deg` are (P,).
    """

    frame: Indices
    position_m: F64
    rotation_deg: F64

    def __len__(self) -> int:
        return len(self.frame)


def errors(outcome: Outcome, truth: Trajectory) -> Errors:
    """The errors of the finite poses, unaligned, by nearest time within `ate.MAX_DIFF_S`."""
    ordered = outcome.frames.ordered()
    estimate = outcome.estimate
    i, j = ate.associate(estimate.time_ns, truth.time_ns)
    if not len(i):
        return Errors(ordered[:0], np.empty(0), np.empty(0))
    found = ate.errors(estimate[i], truth[j])
    return Errors(ordered[i], found.position_m, found.rotation_deg)


def figures(outcome: Outcome, reference: Reference | str | None) -> dict[str, Figure]:
    """All figures by name, as `Limits` names its bounds but for `_min` and `_max`.

    `reference` is what the poses are held against, None for nothing, or in words why there is none.
    """
    battery = outcome.run.battery
    return {
        **_shares(outcome),
        **_errors(outcome, reference),
        **_latencies(outcome),
        "recovery_s": _recovery(outcome),
        **_resources(outcome),
        "battery_V": Figure(battery.voltage, "its last message")
        if battery
        else Figure(None, "no battery message came"),
    }


def _shares(outcome: Outcome) -> dict[str, Figure]:
    run, frames = outcome.run, outcome.frames
    accounts = run.accounts
    found: dict[str, Figure] = {}
    parts = {"coverage": (int(frames.finite.sum()), "localized"), "lost": (accounts.lost, "lost")}
    for name, (count, word) in parts.items():
        if not run.complete:
            found[name] = Figure(None, "the payload's final counts did not come")
        elif accounts.sent <= 0:
            found[name] = Figure(None, "no frame was sent")
        else:
            told = f"{count} of {accounts.sent} sent {word}"
            found[name] = Figure(count / accounts.sent, told)
    tracking = int(frames.called(State.TRACKING.value).sum())
    if len(frames):
        told = f"{tracking} of {len(frames)} frames"
        found["tracking"] = Figure(tracking / len(frames), told)
    else:
        found["tracking"] = Figure(None, "no frame reached the localizer")
    return found


_OF_ERRORS = ("position_rmse_m", "rotation_rmse_deg", "position_worst_m", "tracking_worst_m")


def _errors(outcome: Outcome, reference: Reference | str | None) -> dict[str, Figure]:
    if not isinstance(reference, Reference):
        why = reference or "this case has no truth"
        return {name: Figure(None, why) for name in _OF_ERRORS}
    found = errors(outcome, reference.poses)
    if not len(found):
        why = f"no pose is within {ate.MAX_DIFF_S:g} s of one of {reference.what}"
        return {name: Figure(None, why) for name in _OF_ERRORS}
    without = int(outcome.frames.finite.sum()) - len(found)
    told = f"{len(found)} poses against {reference.what}"
    if without:
        told += f"; {without} more have none of it at their time"
    position, rotation = ate.Statistics.of(found.position_m), ate.Statistics.of(found.rotation_deg)
    tracking = outcome.frames.called(State.TRACKING.value)[found.frame]
    worst = Figure(None, f"no pose called TRACKING among {told}")
    if tracking.any():
        k = np.flatnonzero(tracking)[np.argmax(found.position_m[tracking])]
        sequence = int(outcome.frames.sequence[found.frame[k]])
        worst = Figure(
            float(found.position_m[k]), f"frame {sequence}, of {int(tracking.sum())} TRACKING"
        )
    return {
        "position_rmse_m": Figure(position.rmse, told),
        "rotation_rmse_deg": Figure(rotation.rmse, told),
        "position_worst_m": Figure(position.max, told),
        "tracking_worst_m": worst,
    }


def _latencies(outcome: Outcome) -> dict[str, Figure]:
    latency = outcome.frames.latency_ms
    latency = latency[np.isfinite(latency)]
    if not len(latency):
        why = "no frame came" if not len(outcome.frames) else "the payload's clock never answered"
        return {name: Figure(None, why) for name in ("latency_p50_ms", "latency_p99_ms")}
    p50, p99 = np.percentile(latency, [50, 99]).tolist()
    told = f"{len(latency)} frames"
    return {"latency_p50_ms": Figure(p50, told), "latency_p99_ms": Figure(p99, told)}


def _recovery(outcome: Outcome) -> Figure:
    """How long after the end of an outage or fault (s) the first TRACKING pose was there of a frame
    that was taken after it; of several the longest.

    Where the capture by the ground's clock is not known, the arrival stands in its place.
    """
    if not outcome.run.outages:
        return Figure(None, "nothing was out in this run")
    frames = outcome.frames
    taken_ns = np.where(frames.captured_ns == UNKNOWN, frames.arrival_ns, frames.captured_ns)
    good = frames.called(State.TRACKING.value) & frames.finite
    never: list[str] = []
    found: list[tuple[float, str]] = []
    for outage in sorted(outcome.run.outages, key=lambda outage: outage.end_ns):
        after = good & (taken_ns >= outage.end_ns)
        done_ns = frames.done_ns[after]
        if len(done_ns):
            found.append((float(done_ns.min() - outage.end_ns) / 1e9, outage.name))
        else:
            never.append(outage.name)
    if never:
        return Figure(None, f"not TRACKING again after {', '.join(never)}")
    worst_s, name = max(found)
    return Figure(worst_s, f"after {name}, the slowest of {len(found)}")


def _resources(outcome: Outcome) -> dict[str, Figure]:
    found: dict[str, Figure] = {}
    for name, side in (("payload", outcome.run.payload_side), ("ground", outcome.run.ground_side)):
        values = {f"{name}_memory_MB": side.memory_MB, f"{name}_cpu": side.cpu}
        for key, value in values.items():
            told = f"by {side.source}" if side.source else ""
            found[key] = Figure(value, "nobody measured it" if value is None else told)
    return found
