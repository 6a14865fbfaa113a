"""What is missing of a stream, when to ask for it again, and how long it can still come.

Generic NACKs (RFC 4585, 6.2.1) ask for it, retransmissions (RFC 4588) bring it. The round trip is
measured by them and smoothed as TCP's is (RFC 6298).
"""

from __future__ import annotations

from dataclasses import dataclass

from ground_station.stream.counters import Counters

LIVE_NS = 150_000_000
"""What a frame is waited for at most: nearly all poses are held to be here so soon after capture,
and what waits longer would not be shown sooner than the IDR that is asked for in its place."""
_MOST_MISSING = 256
"""So that one datagram asks for all: its entries are of four bytes (RFC 4585, 6.2.1)."""
_ONE_ENTRY = 17
"""Packets that one entry of a NACK asks for (RFC 4585, 6.2.1)."""
_SILENT_NS = 2 * LIVE_NS
"""What is lost in a longer silence would need a link that carries more than thrice the stream, to
be here in time."""
_STALE_NS = 5_000_000_000
"""A round trip of ours that is older says less than telemetry's newest."""
_GRANULARITY_NS = 10_000_000
"""Of the threads on both sides: no answer is missed earlier than this after a usual one."""
_MOST_OVERTAKEN_NS = LIVE_NS // 5
"""What is later than this was lost; so long was waited for all, before anything was asked for."""
_QUESTIONS = 4
"""Where a tenth is lost each way, so many leave 0.1 % of what is asked for unanswered."""


class RoundTrip:
    """The smoothed round trip and its variation, ns (RFC 6298, 2); none before the first."""

    def __init__(self) -> None:
        self.smoothed_ns: int | None = None
        self._variation_ns = 0
        self._measured_ns: int | None = None

    def hint(self, round_trip_ns: int, now_ns: int) -> None:
        """Takes what another measured, unless a measurement of our own is fresh."""
        if self._measured_ns is None or now_ns - self._measured_ns > _STALE_NS:
            self.smoothed_ns, self._variation_ns = round_trip_ns, round_trip_ns // 2

    def measure(self, round_trip_ns: int, now_ns: int) -> None:
        """Takes a measurement."""
        if self.smoothed_ns is None or self._measured_ns is None:
            self.smoothed_ns, self._variation_ns = round_trip_ns, round_trip_ns // 2
        else:
            off_ns = abs(self.smoothed_ns - round_trip_ns)
            self._variation_ns = (3 * self._variation_ns + off_ns) // 4
            self.smoothed_ns = (7 * self.smoothed_ns + round_trip_ns) // 8
        self._measured_ns = now_ns

    @property
    def timeout_ns(self) -> int:
        """After so long without an answer it was lost on the way.

        As TCP's, but for a way whose delay varies much: there `_QUESTIONS` fit into a frame's wait,
        as a question too many costs one packet and one too few a frame.
        """
        if self.smoothed_ns is None:
            return LIVE_NS
        usual_ns = self.smoothed_ns + max(_GRANULARITY_NS, 4 * self._variation_ns)
        most_ns = (LIVE_NS - self.smoothed_ns) // (_QUESTIONS - 1)
        return min(usual_ns, max(self.smoothed_ns + _GRANULARITY_NS, most_ns))


@dataclass
class _Missing:
    since_ns: int
    ask_ns: int
    """When it is to be asked for next."""
    first_ns: int | None = None
    """When it was asked for first, and last."""
    last_ns: int = 0
    came_ns: int = 0

    @property
    def until_ns(self) -> int:
        return self.since_ns + LIVE_NS


class Retransmission:
    """The missing packets of one stream, by sequence number; for one thread, times monotonic.

    Each is asked for when it is missed, and again when the answer must have been lost, as long as
    another can be here within `LIVE_NS`. It is given up when none is under way any more. On a way
    on which packets overtake each other it is asked for when it is later than those of late were.
    """

    def __init__(self, counters: Counters) -> None:
        self.round_trip = RoundTrip()
        self.offered = False
        """Whether the sender said that it keeps what it sent."""
        self._counters = counters
        self._missing: dict[int, _Missing] = {}
        self._ambiguous: dict[int, _Missing] = {}
        self._overtaken_ns = 0
        """How late packets of late were that others had overtaken."""

    @property
    def helps(self) -> bool:
        """Whether what is asked for can be here in time."""
        trip_ns = self.round_trip.smoothed_ns
        return self.offered and (trip_ns is None or trip_ns < LIVE_NS)

    def forget(self) -> None:
        """Another stream begins."""
        self._missing.clear()
        self._ambiguous.clear()

    def missed(self, first: int, count: int, silent_ns: int, now_ns: int) -> None:
        """Takes note of packets that are missing after `silent_ns` without any.

        What was lost in a long silence would come too late, unless it is little: all of it has to
        be sent beside what is sent now.
        """
        if silent_ns > _SILENT_NS and count > _ONE_ENTRY:
            return
        for ahead in range(min(count, _MOST_MISSING - len(self._missing))):
            sequence = (first + ahead) & 0xFFFF
            self._missing[sequence] = _Missing(now_ns, now_ns + self._overtaken_ns)

    def awaits(self, sequence: int) -> bool:
        """Whether this one can still come."""
        return sequence in self._missing

    def corrected(self, sequence: int) -> None:
        """Takes note of one that need not come any more."""
        self._missing.pop(sequence, None)

    def came(self, sequence: int, now_ns: int, *, again: bool) -> bool:
        """Takes note of one that came, `again` as a retransmission; whether it was waited for."""
        missing = self._missing.get(sequence)
        if missing is None or (again and missing.first_ns is None):  # nobody asked for it
            if again:
                self._came_twice(sequence, now_ns)
            return False
        del self._missing[sequence]
        if not again:
            late_ns = now_ns - missing.since_ns
            self._overtaken_ns = min(max(self._overtaken_ns, late_ns), _MOST_OVERTAKEN_NS)
        elif missing.first_ns is not None:
            self._overtaken_ns -= self._overtaken_ns // 8
            if missing.last_ns == missing.first_ns:
                self.round_trip.measure(now_ns - missing.first_ns, now_ns)
            else:  # whichever question it answers (Karn's algorithm)
                missing.came_ns = now_ns
                self._ambiguous[sequence] = missing
                if len(self._ambiguous) > _MOST_MISSING:
                    del self._ambiguous[next(iter(self._ambiguous))]
        return True

    def _came_twice(self, sequence: int, now_ns: int) -> None:
        """Two questions were answered: what came before was the first one's answer.

        As TCP finds out that it repeated what was under way (RFC 3708).
        """
        before = self._ambiguous.pop(sequence, None)
        if before is not None and before.first_ns is not None:
            self.round_trip.measure(before.came_ns - before.first_ns, now_ns)

    def due(self, now_ns: int) -> list[int]:
        """Those to be asked for now; lets go of those that cannot come any more."""
        asked, gone = [], []
        timeout_ns, trip_ns = self.round_trip.timeout_ns, self.round_trip.smoothed_ns or 0
        for sequence, missing in self._missing.items():
            if now_ns < min(missing.ask_ns, missing.until_ns):
                continue
            if missing.first_ns is None:
                missing.first_ns = now_ns
                self._counters.packets_asked += 1
            elif now_ns + trip_ns > missing.until_ns:
                gone.append(sequence)
                continue
            missing.last_ns, missing.ask_ns = now_ns, now_ns + timeout_ns
            asked.append(sequence)
        for sequence in gone:
            del self._missing[sequence]
        return asked

    def next_ns(self) -> int | None:
        """When `due` has something to say next; None while nothing is missing."""
        return min((min(m.ask_ns, m.until_ns) for m in self._missing.values()), default=None)
