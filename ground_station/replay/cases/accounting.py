"""Whether every frame of a run is accounted for, from the camera to the pose."""

from __future__ import annotations

import numpy as np

from ground_station.evaluation.figures import EXACTLY, Row
from ground_station.replay.cases.outcome import Outcome

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
