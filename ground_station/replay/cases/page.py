"""Pages of a comparison and of a suite: one HTML file each, no script, nothing fetched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ground_station.evaluation.figures import digits
from ground_station.geometry.trajectory import Trajectory
from ground_station.presentation.pages import ThemedFigure, themed_figure, write_page
from ground_station.replay.cases import measure, pictures
from ground_station.replay.cases.compare import Comparison, Line
from ground_station.replay.cases.frames import UNKNOWN
from ground_station.replay.cases.judge import Judged
from ground_station.replay.cases.outcome import Outcome
from ground_station.replay.cases.pictures import Series, Strip

_TEMPLATES = Path(__file__).parent / "templates"


def write_comparison(path: str | Path, comparison: Comparison, a: str, b: str) -> None:
    """Writes the page of two runs; `a` and `b` are their names."""
    c = comparison
    counts = {
        name: (count, getattr(c.b.run.accounts, name))
        for name, count in asdict(c.a.run.accounts).items()
    }
    write_page(
        path,
        _TEMPLATES / "compare.html",
        title=f"{b} against {a}",
        comparison=c,
        lines=[
            (line.name, a_, b_, line.unit, *more, ("✗ " if line.fails else "") + line.told)
            for line in c.lines
            for a_, b_, *more in [cells(line)]
        ],
        counts=[
            (name, *both, f"{both[1] - both[0]:+d}" if both[0] != both[1] else "")
            for name, both in (counts | c.states).items()
        ],
        shown=_of_comparison(c),
    )


def write_suite(
    path: str | Path,
    title: str,
    cases: Sequence[Judged],
    *,
    began: str,
    comparisons: dict[str, Comparison] | None = None,
) -> None:
    """Writes the page of a judged suite.

    `comparisons` by a case's name show that run against an earlier one, which is A.
    """
    against = comparisons or {}
    write_page(
        path,
        _TEMPLATES / "suite.html",
        title=title,
        began=began,
        cases=[
            (
                f"case-{number}",
                case,
                _of_case(case),
                _of_comparison(against[case.name]) if case.name in against else [],
            )
            for number, case in enumerate(cases, start=1)
        ],
        against=against,
    )


def cells(line: Line) -> tuple[str, str, str, str]:
    """A line's figures for a person: A, B, by how much worse, what is allowed."""
    a, b = ("—" if v is None else digits(v, None) for v in (line.a, line.b))
    worse = "" if line.worse is None else digits(line.worse, line.allowed)
    if line.worse is not None and line.worse > 0:
        worse = f"+{worse}"
    allowed = "" if line.allowed is None else f"{line.allowed:g}"
    return a, b, worse, allowed


def _of_comparison(c: Comparison) -> list[ThemedFigure]:
    a, b = c.a.frames, c.b.frames
    found: list[ThemedFigure] = []
    if len(c.time_ns):
        start_ns = int(min(a.time_ns.min(), b.time_ns.min()))
        gone = a.finite[c.pairs.a] & ~b.finite[c.pairs.b]
        missing = np.concatenate(
            [a.position_m[c.pairs.a[gone]], a.position_m[c.pairs.only_a][a.finite[c.pairs.only_a]]]
        )
        first = _place(c)
        plan = c.b.floorplan or c.a.floorplan
        found.append(
            themed_figure(
                "Where the poses of B are off those of A",
                "B's path from above, coloured by its distance from A's pose of the same frame",
                lambda theme: pictures.path(
                    b.position_m[c.pairs.b],
                    c.position_m,
                    under=[("A", c.a.estimate)],
                    lost_m=missing,
                    first_m=first,
                    floorplan=plan,
                    label="B off A, cm",
                    theme=theme,
                ),
            )
        )
        panels = []
        if c.errors_a is not None and c.errors_b is not None:
            series = [
                Series(name, (o.frames.time_ns[e.frame] - start_ns) / 1e9, 100 * e.position_m, k)
                for k, (name, o, e) in enumerate((("A", c.a, c.errors_a), ("B", c.b, c.errors_b)))
            ]
            panels.append(("error, cm", series, None))
        time_s = (c.time_ns - start_ns) / 1e9
        panels.append(("B off A, cm", [Series("B off A", time_s, 100 * c.position_m, 1)], None))
        panels.append(("B off A, °", [Series("B off A", time_s, c.rotation_deg, 1)], None))
        strips = [
            Strip(name, (f.time_ns - start_ns) / 1e9, f.state) for name, f in (("A", a), ("B", b))
        ]
        found.append(
            themed_figure(
                "Over time",
                "Errors of both runs, their difference and their states over time",
                lambda theme: pictures.over_time(panels, strips, theme=theme),
            )
        )
    sets = []
    if c.errors_a is not None and c.errors_b is not None:
        sets.append(
            ("error, cm", [("A", 100 * c.errors_a.position_m), ("B", 100 * c.errors_b.position_m)])
        )
    sets.append(("capture to pose, ms", [("A", a.latency_ms), ("B", b.latency_ms)]))
    found.append(
        themed_figure(
            "How often",
            "The share of frames up to an error, and up to a latency, of both runs",
            lambda theme: pictures.distributions(sets, theme),
        )
    )
    return found


def _place(c: Comparison) -> np.ndarray | None:
    """Where the two runs first part, by the pose of either."""
    if c.first.time_ns is None:
        return None
    for frames in (c.b.frames, c.a.frames):
        k = np.flatnonzero((frames.time_ns == c.first.time_ns) & frames.finite)
        if len(k):
            return np.asarray(frames.position_m[k[0]])
    return None


def _of_case(case: Judged) -> list[ThemedFigure]:
    if case.outcome is None:
        return []
    bounds = {row.name: row.bound for row in case.rows}
    return of_run(
        case.outcome,
        None if case.reference is None else case.reference.poses,
        position_m=bounds.get("position_max_m"),
        latency_ms=bounds.get("latency_p99_ms_max"),
    )


def of_run(
    outcome: Outcome,
    truth: Trajectory | None,
    *,
    position_m: float | None = None,
    rotation_deg: float | None = None,
    latency_ms: float | None = None,
) -> list[ThemedFigure]:
    """Path, errors against the truth, latency and states of a run; bounds are drawn as lines."""
    frames = outcome.frames
    if not len(frames):
        return []
    start_ns = int(frames.time_ns.min())
    seconds = (frames.time_ns - start_ns) / 1e9
    panels: list[tuple[str, Sequence[Series], float | None]] = []
    off_m = np.zeros(len(frames))
    if truth is not None:
        errors = measure.errors(outcome, truth)
        off_m = np.full(len(frames), np.nan)
        off_m[errors.frame] = errors.position_m
        limit_cm = None if position_m is None else 100 * position_m
        for label, values, limit in (
            ("error, cm", 100 * errors.position_m, limit_cm),
            ("error, °", errors.rotation_deg, rotation_deg),
        ):
            panels.append((label, [Series("error", seconds[errors.frame], values)], limit))
    if np.isfinite(frames.latency_ms).any():
        series = Series("latency", seconds, frames.latency_ms)
        panels.append(("latency, ms", [series], latency_ms))
    under = [] if outcome.truth is None else [("truth", outcome.truth)]
    return [
        themed_figure(
            "Path",
            "The path from above, coloured by its error",
            lambda theme: pictures.path(
                frames.position_m[frames.finite],
                off_m[frames.finite],
                under=under,
                floorplan=outcome.floorplan,
                label="error, cm",
                theme=theme,
            ),
        ),
        themed_figure(
            "Over time",
            "Error, latency and state over time; what was out is shaded",
            lambda theme: pictures.over_time(
                panels,
                [Strip("state", seconds, frames.state)],
                _outages_s(outcome, start_ns),
                theme,
            ),
        ),
    ]


def _outages_s(outcome: Outcome, start_ns: int) -> list[tuple[float, float]]:
    """The outages on the axis of capture times, which is another clock's."""
    frames = outcome.frames
    known = frames.captured_ns != UNKNOWN
    if not known.any():
        return []
    ahead_ns = int(np.median((frames.captured_ns - frames.time_ns)[known])) + start_ns
    return [
        ((o.begin_ns - ahead_ns) / 1e9, (o.end_ns - ahead_ns) / 1e9) for o in outcome.run.outages
    ]
