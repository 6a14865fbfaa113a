"""Whether every frame of a run is accounted for, from the camera to the pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_station.replay.cases.outcome import Outcome


@dataclass(frozen=True)
class Balance:
    """A sum that must come out: by how many frames it does not, and what speaks against it."""

    name: str
    off: int
    told: str = ""

    @property
    def holds(self) -> bool:
        return self.off == 0 and not self.told


CAPTURED = "captured = gated + sent + discarded"
SENT = "sent = received + lost"
RECEIVED = "received = localized + not localized + dropped"


def balances(outcome: Outcome) -> list[Balance]:
    """The three sums. Each side is counted by another: the payload, the receiver, the localizer."""
    return [_captured(outcome), _sent(outcome), _received(outcome)]


def _captured(outcome: Outcome) -> Balance:
    a = outcome.run.accounts
    off = a.captured - (a.gated + a.sent + a.discarded)
    told = "" if outcome.run.complete else "the payload's final counts did not come"
    negative = [name for name in ("captured", "gated", "sent", "discarded") if getattr(a, name) < 0]
    if negative:
        told = f"{negative[0]} is {getattr(a, negative[0])}"
    return Balance(CAPTURED, off, told)


def _sent(outcome: Outcome) -> Balance:
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
    return Balance(SENT, off, told)


def _received(outcome: Outcome) -> Balance:
    a, frames = outcome.run.accounts, outcome.frames
    localized = int(frames.localized.sum())
    off = a.received - (len(frames) + a.dropped)
    told = ""
    if a.localized != localized:
        told = f"{a.localized} are counted as localized, {localized} frames have a pose"
    elif a.dropped < 0:
        told = f"dropped is {a.dropped}"
    return Balance(RECEIVED, off, told)
