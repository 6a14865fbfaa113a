"""Follows the clocks of all payloads that are heard, and serves them the ground station's time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from pi_firmware.wire import keys
from pi_firmware.wire.clock_offset import ASK_TIMEOUT_S, Clock, Offset, OffsetFilter, ask, serve

_PERIOD_S = 1.0
_KEPT = 64


class ClockFollower:
    """Asks each payload for its time once a second, on a thread of its own.

    `known` gives the ids of the payloads that are alive now; `clock` is this machine's wall clock.
    """

    def __init__(self, session: Any, known: Callable[[], list[str]], clock: Clock) -> None:
        self._session = session
        self._known = known
        self._clock = clock
        self._filters: dict[str, OffsetFilter] = {}
        self._offsets: dict[str, Offset] = {}
        self._round_trips_s: dict[str, float | None] = {}
        self._served: dict[str, Any] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clock-follower", daemon=True)
        self._thread.start()

    def offset(self, payload_id: str) -> Offset | None:
        """The newest offset of a payload's clock to ours; None before the first answer."""
        return self._offsets.get(payload_id)

    def round_trip_s(self, payload_id: str) -> float | None:
        """How long the newest question was on its way, there and back.

        Not the shortest, which the offset is made of: this one tells how the link is now. It is at
        least this long where no answer came in time; None where nobody serves the clock.
        """
        return self._round_trips_s.get(payload_id)

    def close(self) -> None:
        """Stops asking; to be called before its session closes."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        wait_s = 0.05  # a payload that comes is asked at once
        while not self._closing.wait(wait_s):
            known = self._known()
            for payload_id in known:
                self._follow(payload_id)
            gone = [payload_id for payload_id in self._served if payload_id not in known]
            for payload_id in gone[: max(0, len(self._served) - _KEPT)]:
                self._served.pop(payload_id).undeclare()
                for kept in (self._filters, self._offsets, self._round_trips_s):
                    kept.pop(payload_id, None)
            wait_s = _PERIOD_S if known else 0.05

    def _follow(self, payload_id: str) -> None:
        if payload_id not in self._served:
            key = keys.key(payload_id, keys.TIME)
            self._served[payload_id] = serve(self._session, key, self._clock)
        asked_s = time.monotonic()
        trip = ask(self._session, keys.key(payload_id, keys.CLOCK), self._clock)
        if trip is None:
            # A question that reaches nobody ends at once; one that is not answered waits.
            waited_s = time.monotonic() - asked_s
            self._round_trips_s[payload_id] = waited_s if waited_s >= ASK_TIMEOUT_S else None
            return
        if trip.delay_ns >= 0:  # otherwise a clock stepped meanwhile
            self._round_trips_s[payload_id] = trip.delay_ns / 1e9
        offset = self._filters.setdefault(payload_id, OffsetFilter()).add(trip)
        if offset is not None:
            self._offsets[payload_id] = offset
