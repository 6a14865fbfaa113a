"""Judgement: a run's outcome against its case, row by row; nothing passes that was not measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal

import numpy as np

from ground_station.evaluation import ate
from ground_station.replay.cases import accounting, measure, telemetry
from ground_station.replay.cases.case import Case
from ground_station.replay.cases.golden import Golden
from ground_station.replay.cases.limits import Limits
from ground_station.replay.cases.measure import Figure
from ground_station.replay.cases.outcome import Outcome
from ground_station.replay.cases.same import first_difference
from ground_station.replay.cases.truth import Reference, reference_of
from pi_firmware.wire.errors import BlimpError

AT_MOST, AT_LEAST, EXACTLY = "at most", "at least", "exactly"


@dataclass(frozen=True)
class Row:
    """One figure and what became of it.

    `bound` is what it was held against, `sense` from which side. `holds` is None where nothing was
    asked. `told` says what it was taken from, or why it could not be.
    """

    name: str
    value: float | None
    unit: str
    bound: float | None = None
    holds: bool | None = None
    sense: str = AT_MOST
    told: str = ""

    @property
    def measured(self) -> str:
        """The value for a person, with digits enough to be on its side of the bound."""
        if self.value is None:
            return "not measured" if self.unit else ""
        return f"{digits(self.value, self.bound)} {self.unit}".strip()

    @property
    def allowed(self) -> str:
        """What was asked, for a person; "" for nothing or a plain condition."""
        if self.bound is None:
            return ""
        return f"{self.sense} {number(self.bound)} {self.unit}".strip()


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
    def passed(self) -> bool:
        """False for an error; a case that was skipped has neither passed nor failed: True."""
        return not self.error and not self.missed


def digits(value: float, bound: float | None) -> str:
    """A number in four digits, or in as many as leave it on its own side of the bound."""
    for count in range(4, 17):
        text = f"{value:.{count}g}"
        shown = float(text)
        if 1e4 <= abs(shown) < 1e15:
            text = format(Decimal(text), "f")
        if bound is None or (shown < bound, shown > bound) == (value < bound, value > bound):
            return text
    return repr(value)


def number(value: float) -> str:
    """A number as a person wrote it."""
    text = f"{value:g}"
    return text if float(text) == value else repr(value)


def judge(outcome: Outcome, case: Case, kind: str, again: Outcome | None = None) -> list[Row]:
    """All rows of a run: what must always hold, the case's bounds, then what nobody asked.

    `again` is a second run for `bounds.identical`. A truth that cannot be read fails what needs it.
    """
    return rows(outcome, case.limits(kind), _reference(case), again)


def judged(
    outcome: Outcome,
    case: Case,
    kind: str,
    *,
    again: Outcome | None = None,
    seconds: float = 0.0,
    notes: Sequence[str] = (),
) -> Judged:
    """A case's judgement with all that its page shows."""
    reference = _reference(case)
    return Judged(
        case.name,
        case.title,
        kind,
        rows(outcome, case.limits(kind), reference, again),
        outcome,
        reference if isinstance(reference, Reference) else None,
        seconds,
        notes=[*outcome.run.notes, *notes],
        again=again,
    )


def _reference(case: Case) -> Reference | str | None:
    try:
        return reference_of(case)
    except BlimpError as error:
        return str(error)


def rows(
    outcome: Outcome,
    limits: Limits,
    reference: Reference | str | None,
    again: Outcome | None = None,
) -> list[Row]:
    """The same of bounds and a truth; `reference` in words is why there is none."""
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


# Bound, its figure, unit, sense; the figure without a suffix that its bound has.
BOUNDS: tuple[tuple[str, str, str, str], ...] = (
    ("coverage_min", "coverage", "share", AT_LEAST),
    ("tracking_min", "tracking", "share", AT_LEAST),
    ("lost_max", "lost", "share", AT_MOST),
    ("position_rmse_m_max", "position_rmse_m", "m", AT_MOST),
    ("rotation_rmse_deg_max", "rotation_rmse_deg", "°", AT_MOST),
    ("position_max_m", "tracking_worst_m", "m", AT_MOST),
    ("latency_p50_ms_max", "latency_p50_ms", "ms", AT_MOST),
    ("latency_p99_ms_max", "latency_p99_ms", "ms", AT_MOST),
    ("recovery_s_max", "recovery_s", "s", AT_MOST),
    ("payload_memory_MB_max", "payload_memory_MB", "MB", AT_MOST),
    ("ground_memory_MB_max", "ground_memory_MB", "MB", AT_MOST),
    ("payload_cpu_max", "payload_cpu", "share", AT_MOST),
    ("battery_V_min", "battery_V", "V", AT_LEAST),
    ("battery_V_max", "battery_V", "V", AT_MOST),
)


def _bounds(limits: Limits, figures: dict[str, Figure]) -> list[Row]:
    found = []
    for name, figure_name, unit, sense in BOUNDS:
        bound = getattr(limits, name)
        if bound is not None:
            figure = figures[figure_name]
            holds = holds_at(figure.value, bound, sense)
            found.append(Row(name, figure.value, unit, bound, holds, sense, figure.told))
    return found


def holds_at(value: float | None, bound: float, sense: str) -> bool:
    """Whether a value is on the right side, or on the bound; never for None and NaN."""
    if value is None or math.isnan(value):
        return False
    return value <= bound if sense == AT_MOST else value >= bound


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
    found = [
        Row(b.name, float(b.off), "frames off", 0.0, b.holds, EXACTLY, b.told)
        for b in accounting.balances(outcome)
    ]
    broken = int((outcome.frames.localized & ~outcome.frames.finite).sum())
    found.append(Row("poses not finite", float(broken), "poses", 0.0, broken == 0, EXACTLY))
    run = outcome.run
    for kind, message, ranges in (
        ("battery", run.battery, telemetry.BATTERY),
        ("health", run.health, telemetry.HEALTH),
    ):
        why = telemetry.trouble(kind, message, ranges)
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
        Row("golden: missing", missing, "share", terms.missing_max,
            holds_at(missing, terms.missing_max, AT_MOST), AT_MOST,
            f"{count} of {len(golden.poses)} accepted poses")
    ]  # fmt: skip
    parts: Sequence[tuple[str, np.ndarray, str, float]] = (
        ("golden: position", found.position_m, "m", terms.tolerance_m),
        ("golden: rotation", found.rotation_deg, "°", terms.tolerance_deg),
    )
    for name, values, unit, bound in parts:
        worst = float(values.max()) if len(values) else None
        why = told if worst is not None else "no pose at the time of an accepted one"
        rows.append(Row(name, worst, unit, bound, holds_at(worst, bound, AT_MOST), AT_MOST, why))
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
