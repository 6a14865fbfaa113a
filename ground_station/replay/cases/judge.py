"""Judgement: a run's outcome against its case, row by row; nothing passes that was not measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ground_station.evaluation import ate
from ground_station.evaluation.figures import EXACTLY, Row
from ground_station.replay.cases import measure
from ground_station.replay.cases.case import BOUNDS, Case, Limits
from ground_station.replay.cases.frames import first_difference
from ground_station.replay.cases.measure import Figure
from ground_station.replay.cases.outcome import Outcome
from ground_station.replay.cases.truth import Golden, Reference, reference_of
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.messages import Battery, Health


@dataclass(frozen=True)
class Judged:
    """A case that was flown with one payload kind, or why it was not.

    `error` is why there is no outcome, in one line; `skipped` why none was to be. `again` is the
    second run of a case that asks for two.
    """

    name: str
    title: str
    payload: str
    rows: list[Row] = field(default_factory=list)
    outcome: Outcome | None = None
    reference: Reference | None = None
    seconds: float = 0.0
    error: str = ""
    skipped: str = ""
    notes: list[str] = field(default_factory=list)
    again: Outcome | None = None

    @property
    def missed(self) -> list[Row]:
        """The rows that do not hold."""
        return [row for row in self.rows if row.holds is False]

    @property
    def told(self) -> list[tuple[str, str, str, str]]:
        """Rows for a person: name, measured, allowed, and whether it holds; misses first."""
        marks = {False: "✗ ", True: "✓ ", None: ""}
        rows = sorted(self.rows, key=lambda row: list(marks).index(row.holds))
        return [(r.name, r.measured, r.allowed, f"{marks[r.holds]}{r.told}".strip()) for r in rows]

    @property
    def passed(self) -> bool:
        """False for an error; a case that was skipped has neither passed nor failed: True."""
        return not self.error and not self.missed


def judged(
    outcome: Outcome,
    case: Case,
    kind: str,
    *,
    again: Outcome | None = None,
    seconds: float = 0.0,
) -> Judged:
    """A case's judgement with all that its page shows; `again` is for `bounds.identical`.

    A truth that cannot be read fails what needs it.
    """
    reference: Reference | str | None
    try:
        reference = reference_of(case)
    except BlimpError as error:
        reference = str(error)
    return Judged(
        case.name,
        case.title,
        kind,
        rows(outcome, case.limits(kind), reference, again),
        outcome,
        reference if isinstance(reference, Reference) else None,
        seconds,
        notes=outcome.run.notes,
        again=again,
    )


def rows(
    outcome: Outcome,
    limits: Limits,
    reference: Reference | str | None,
    again: Outcome | None = None,
) -> list[Row]:
    """All rows of a run: what must always hold, the bounds, then what nobody asked.

    `reference` in words is why there is no truth.
    """
    figures = measure.figures(outcome, reference)
    golden = reference.golden if isinstance(reference, Reference) else None
    return [
        *_conditions(outcome),
        *(
            [Row("truth", None, "", holds=False, told=reference)]
            if isinstance(reference, str)
            else []
        ),
        *_bounds(limits, figures),
        *(_golden(outcome, golden) if golden is not None else []),
        *([_identical(outcome, again)] if limits.identical else []),
        *_unasked(limits, figures, outcome),
    ]


def _bounds(limits: Limits, figures: dict[str, Figure]) -> list[Row]:
    found = []
    for name, figure_name, unit, sense in BOUNDS:
        bound = getattr(limits, name)
        if bound is not None:
            figure = figures[figure_name]
            found.append(Row.bounded(name, figure.value, unit, bound, sense, figure.told))
    return found


def _unasked(limits: Limits, figures: dict[str, Figure], outcome: Outcome) -> list[Row]:
    """What was measured and held against nothing, once each."""
    asked = {figure for name, figure, _, _ in BOUNDS if getattr(limits, name) is not None}
    units = {figure: unit for _, figure, unit, _ in BOUNDS}
    units |= {"position_worst_m": "m", "ground_cpu": "share"}
    return [
        Row(name, figure.value, units[name], told=figure.told)
        for name, figure in figures.items()
        if name not in asked and figure.value is not None
    ]


def _conditions(outcome: Outcome) -> list[Row]:
    found = balances(outcome)
    broken = outcome.frames.broken
    found.append(Row("poses not finite", float(broken), "poses", 0.0, broken == 0, EXACTLY))
    run = outcome.run
    for kind, message, ranges in (
        ("battery", run.battery, _BATTERY), ("health", run.health, _HEALTH)
    ):  # fmt: skip
        why = trouble(message, ranges) if message else f"no {kind} message came"
        found.append(Row(f"telemetry: {kind}", None, "", holds=not why, told=why))
    if run.refused is not None:
        found.append(
            Row(
                "telemetry: refused", float(run.refused), "messages", 0.0, run.refused == 0, EXACTLY
            )
        )
    return found


def _golden(outcome: Outcome, golden: Golden) -> list[Row]:
    terms = golden.accepted
    found = measure.errors(outcome, golden.poses)
    # Each accepted pose wants one of this run at its time.
    have, _ = ate.associate(golden.poses.time_ns, outcome.estimate.time_ns)
    count = len(golden.poses) - len(np.unique(have))
    missing = count / len(golden.poses)
    told = f"{len(found)} poses against the run {golden}"
    rows = [
        Row.bounded("golden: missing", missing, "share", terms.missing_max,
                    told=f"{count} of {len(golden.poses)} accepted poses")
    ]  # fmt: skip
    parts: Sequence[tuple[str, np.ndarray, str, float]] = (
        ("golden: position", found.position_m, "m", terms.tolerance_m),
        ("golden: rotation", found.rotation_deg, "°", terms.tolerance_deg),
    )
    for name, values, unit, bound in parts:
        worst = float(values.max()) if len(values) else None
        why = told if worst is not None else "no pose at the time of an accepted one"
        rows.append(Row.bounded(name, worst, unit, bound, told=why))
    return rows


def _identical(outcome: Outcome, again: Outcome | None) -> Row:
    """Frames that another run of the same has otherwise; none is what a stepped run promises."""
    count, told = None, "there is no second run"
    if not len(outcome.frames):
        told = "no frame reached the localizer"
    elif again is not None:
        difference = first_difference(outcome.frames, again.frames)
        count, told = float(difference.count), difference.told
    return Row("identical", count, "differing frames", 0.0, count == 0.0, EXACTLY, told)


CAPTURED = "captured = gated + sent + discarded"
SENT = "sent = received + lost"
RECEIVED = "received = localized + not localized + dropped"


def balances(outcome: Outcome) -> list[Row]:
    """The three sums, and by how many frames each does not come out.

    Each side is counted by another: the payload, the receiver, the localizer.
    """
    return [_captured(outcome), _sent(outcome), _received(outcome)]


def _row(name: str, off: int, told: str) -> Row:
    """`told` is what speaks against a sum, even one that comes out."""
    return Row(name, float(off), "frames off", 0.0, off == 0 and not told, EXACTLY, told)


def _captured(outcome: Outcome) -> Row:
    a = outcome.run.accounts
    off = a.captured - (a.gated + a.sent + a.discarded)
    told = "" if outcome.run.complete else "the payload's final counts did not come"
    negative = [name for name in ("captured", "gated", "sent", "discarded") if getattr(a, name) < 0]
    if negative:
        told = f"{negative[0]} is {getattr(a, negative[0])}"
    return _row(CAPTURED, off, told)


def _sent(outcome: Outcome) -> Row:
    """`lost` is reckoned as what is missing: so it must not be less than none, no frame may have
    come twice, and no more of them than were sent."""
    a, frames = outcome.run.accounts, outcome.frames
    off = a.sent - (a.received + a.lost)
    told = ""
    numbers, times = np.unique(frames.sequence, return_counts=True)
    units = outcome.run.stream.get("access_units")
    if a.lost < 0:
        told = f"{-a.lost} more were received than sent"
    elif (times > 1).any():
        told = f"frame {int(numbers[times > 1][0])} was localized {int(times.max())} times"
    elif isinstance(units, int) and units > a.sent:
        told = f"something of {units} frames came, {a.sent} were sent"
    return _row(SENT, off, told)


def _received(outcome: Outcome) -> Row:
    a, frames = outcome.run.accounts, outcome.frames
    localized = int(frames.localized.sum())
    off = a.received - (len(frames) + a.dropped)
    told = ""
    if a.localized != localized:
        told = f"{a.localized} are counted as localized, {localized} frames have a pose"
    elif a.dropped < 0:
        told = f"dropped is {a.dropped}"
    return _row(RECEIVED, off, told)


_BATTERY = {
    "voltage": (1.0, 60.0),
    "percentage": (0.0, 1.0),
    "current": (-100.0, 100.0),
    "charge": (0.0, 1000.0),
    "capacity": (0.0, 1000.0),
    "temperature": (-60.0, 120.0),
    "time_left_s": (0.0, 1e6),
    "read_errors": (0.0, math.inf),
    "refused": (0.0, math.inf),
}
"""What a cell of any blimp can have; V, share, A, Ah, °C, s."""
_HEALTH = {
    "uptime_s": (0.0, math.inf),
    "captured": (0.0, math.inf),
    "gated": (0.0, math.inf),
    "sent": (0.0, math.inf),
    "discarded": (0.0, math.inf),
    "rate_hz": (0.0, 1000.0),
    "bitrate_kbps": (0.0, 1e6),
    "lost": (0.0, 1.0),
    "round_trip_s": (0.0, 3600.0),
    "temperature_C": (-60.0, 150.0),
    "cpu": (0.0, 1.0),
    "memory_MB": (0.0, 1e6),
    "memory_free_MB": (0.0, 1e7),
    "disk_free_MB": (0.0, 1e9),
    "wifi_signal_dBm": (-130.0, 30.0),
    "wifi_quality": (0.0, 1.0),
}


def trouble(message: Battery | Health, ranges: dict[str, tuple[float, float]]) -> str:
    """Which value of a message no board can have, in words; "" where none is."""
    for name, (low, high) in ranges.items():
        value = getattr(message, name)
        if value is not None and not low <= value <= high:
            return f"{name} is {value}; allowed: {low:g} to {high:g}"
    return ""
