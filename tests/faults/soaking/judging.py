"""Whether a value that was watched for hours may be called flat, and the table that says so."""

from __future__ import annotations

import math
from collections.abc import Iterable

from soaking.measures import Measure
from soaking.table import Row
from soaking.trend import Trend, trend

FLAT, SMALL, GROWS, FALLS, SHORT = (
    "flat",
    "under what matters",
    "grows",
    "falls",
    "too short to tell",
)


def verdict(found: Trend, matters: float, *, both: bool = False) -> tuple[str, bool]:
    """What a trend says in a word, and whether it holds.

    A value is flat when 0 lies in the slope's interval *and* the slope that matters does not: a run
    in which such a leak would go unnoticed is too short (or too noisy) to tell, and does not hold.
    A slope that differs from 0 and is still surely below what matters holds, by another word.
    """
    rises = found.high >= matters
    sinks = both and found.low <= -matters
    if not math.isfinite(found.high) or (both and not math.isfinite(found.low)):
        return SHORT, False
    if not rises and not sinks:
        return (FLAT if found.low <= 0.0 <= found.high else SMALL), True
    if rises and found.low > 0.0:
        return GROWS, False
    if sinks and found.high < 0.0:
        return FALLS, False
    return SHORT, False


def row(measure: Measure, settled_s: float) -> Row | None:
    """The row of a measure from when it had settled; None for one that is not judged."""
    if measure.matters is None:
        return None
    found = trend(measure.settled(settled_s), measure.step)
    word, holds = verdict(found, measure.matters, both=measure.both)
    sign = "±" if measure.both else ""
    return Row(
        f"{measure.kind}, {measure.name}: slope",
        f"{slope_text(found)}, {word}",
        f"{sign}{measure.matters:g} {measure.unit}/h",
        holds,
    )


def rows(measures: Iterable[Measure], settled_s: float) -> list[Row]:
    """The rows of all that are judged."""
    return [found for measure in measures if (found := row(measure, settled_s)) is not None]


def slope_text(found: Trend) -> str:
    """A slope an hour with its interval, in few digits."""
    if not math.isfinite(found.slope):
        return "?"
    return f"{found.slope:+.2g} ({found.low:+.2g} to {found.high:+.2g})"
