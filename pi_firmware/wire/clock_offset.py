"""How far another machine's clock is from ours: round trips over Zenoh, and a minimum filter.

Four times make a round trip, as in NTP (RFC 5905, 8): the shortest of the recent ones bounds the
offset best, since what a packet waited is what makes its two ways differ. Neither clock is ever
set: a payload that believes it is 1970 is understood all the same.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

WINDOW = 32
# Crystals of small boards stay within 50 ppm of the truth, two of them within 100 of each other.
DRIFT_PPM = 100
ASK_TIMEOUT_S = 1.0

Clock = Callable[[], int]


@dataclass(frozen=True)
class RoundTrip:
    """One question and its answer, ns: ours when it left and returned, theirs between the two."""

    sent_ns: int
    received_ns: int
    replied_ns: int
    returned_ns: int

    @property
    def offset_ns(self) -> int:
        """Their clock less ours, if both ways took the same time."""
        there, back = self.received_ns - self.sent_ns, self.replied_ns - self.returned_ns
        return (there + back) // 2

    @property
    def delay_ns(self) -> int:
        """Time on the way, both ways; half of it bounds the error of the offset."""
        return (self.returned_ns - self.sent_ns) - (self.replied_ns - self.received_ns)


@dataclass(frozen=True)
class Offset:
    """Their clock is ours plus `offset_ns`, within `uncertainty_ns`; `steps` seen so far."""

    offset_ns: int
    uncertainty_ns: int
    steps: int

    def to_ours(self, theirs_ns: int) -> int:
        """A time of their clock on ours."""
        return theirs_ns - self.offset_ns


class OffsetFilter:
    """Keeps the newest round trips and trusts the tightest; a clock that steps starts it again."""

    def __init__(self) -> None:
        self._trips: deque[RoundTrip] = deque(maxlen=WINDOW)
        self._steps = 0

    def add(self, trip: RoundTrip) -> Offset | None:
        """Takes a round trip; None while none was usable. One with a step inside is not."""
        if trip.delay_ns >= 0 and trip.replied_ns >= trip.received_ns:
            now_ns = trip.returned_ns
            if self._trips:
                best = self._best(now_ns)
                apart_ns = abs(trip.offset_ns - best.offset_ns)
                back = now_ns < self._trips[-1].returned_ns
                if back or apart_ns > _bound_ns(best, now_ns) + _bound_ns(trip, now_ns):
                    self._trips.clear()
                    self._steps += 1
            self._trips.append(trip)
        if not self._trips:
            return None
        now_ns = self._trips[-1].returned_ns
        best = self._best(now_ns)
        return Offset(best.offset_ns, _bound_ns(best, now_ns), self._steps)

    def _best(self, now_ns: int) -> RoundTrip:
        return min(self._trips, key=lambda trip: _bound_ns(trip, now_ns))


def _bound_ns(trip: RoundTrip, now_ns: int) -> int:
    """How wrong a round trip's offset can be by now."""
    return trip.delay_ns // 2 + abs(now_ns - trip.returned_ns) * DRIFT_PPM // 1_000_000 + 1


def serve(session: Any, key: str, clock: Clock = time.time_ns) -> Any:
    """Answers questions for the time at a key of a Zenoh session until it is undeclared."""

    def answer(query: Any) -> None:
        received_ns = clock()
        times = {"schema": "blimp.clock/1.0", "received_ns": received_ns, "replied_ns": clock()}
        query.reply(key, json.dumps(times).encode())

    return session.declare_queryable(key, answer)


def ask(session: Any, key: str, clock: Clock = time.time_ns) -> RoundTrip | None:
    """One round trip to whoever serves the key; None without an answer that is as agreed."""
    sent_ns = clock()
    for reply in session.get(key, timeout=ASK_TIMEOUT_S):
        returned_ns = clock()
        if reply.ok is None:
            continue
        try:
            times = json.loads(reply.ok.payload.to_bytes())
            received_ns, replied_ns = times["received_ns"], times["replied_ns"]
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
        if all(type(t) is int and abs(t) < 2**63 for t in (received_ns, replied_ns)):
            return RoundTrip(sent_ns, received_ns, replied_ns, returned_ns)
    return None
