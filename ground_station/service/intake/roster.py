"""Which payloads are taken up, and which stream is whose, by what the payloads announce."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from ground_station.service.intake.payloads import Payload
from ground_station.service.settings import PayloadSettings

_PAYLOADS = 64
_SSRCS = 4
"""Kept of one payload: today's, and those before it."""
_RECENT_S = 3.0


class Announced:
    """The SSRCs that payloads announce in telemetry. Safe from any thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._heard: dict[str, dict[int, float]] = {}
        """By payload: when each SSRC was announced last, the newest one at the end."""
        self._returned_s: dict[str, float] = {}

    def said(self, payload_id: str, ssrc: int) -> None:
        """A payload announced its stream."""
        now_s = self._clock()
        with self._lock:
            if payload_id not in self._heard and len(self._heard) >= _PAYLOADS:
                silent = min(self._heard, key=lambda who: max(self._heard[who].values()))
                if now_s - max(self._heard[silent].values()) < _RECENT_S:
                    return
                del self._heard[silent]
                self._returned_s.pop(silent, None)
            heard = self._heard.setdefault(payload_id, {})
            # A payload that restarts takes another SSRC and never its old one again.
            if ssrc in heard and next(reversed(heard)) != ssrc:
                self._returned_s[payload_id] = now_s
            heard.pop(ssrc, None)
            heard[ssrc] = now_s
            if len(heard) > _SSRCS:
                del heard[next(iter(heard))]

    def by(self, ssrc: int, key_owner: str | None) -> str | None:
        """The payload that announces a stream; with keys only the one whose key it was made with.

        Of two that announce the same one, it is who did so first.
        """
        now_s = self._clock()
        with self._lock:
            for payload_id, heard in self._heard.items():
                if key_owner not in (None, payload_id) or ssrc not in heard:
                    continue
                newest = next(reversed(heard))
                if ssrc == newest or now_s - heard[ssrc] < _RECENT_S:
                    return payload_id
        return None

    def ssrc(self, payload_id: str) -> int | None:
        """What a payload announced last; None before it did."""
        with self._lock:
            heard = self._heard.get(payload_id)
            return next(reversed(heard)) if heard else None

    def disputed(self, payload_id: str) -> bool:
        """Whether two programs announce streams under one id by turns."""
        with self._lock:
            at_s = self._returned_s.get(payload_id)
        return at_s is not None and self._clock() - at_s < _RECENT_S

    def anyone(self) -> bool:
        """Whether anything was announced at all."""
        with self._lock:
            return bool(self._heard)


GRACE_S = 3.0
"""How long a stream comes before it is taken although nobody announced it."""
NAMELESS_S = 12.0
"""Longer where that leaves it without a name: telemetry that starts late needs some seconds."""
NAMELESS = "stream-"
_REFUSED, _REFUSED_S = 64, 10.0


class Roster:
    """The payloads that are taken up: those named, at most so many. Safe from any thread.

    One that is gone gives its place to one that comes.
    """

    def __init__(
        self,
        settings: PayloadSettings,
        announced: Announced,
        make: Callable[[str], Payload],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings, self._announced, self._make = settings, announced, make
        self._payloads: dict[str, Payload] = {}
        self._lock = threading.Lock()
        self._clock = clock
        self._refused_s: dict[str, float] = {}

    @property
    def refused(self) -> set[str]:
        """Those for whom there was no place of late."""
        with self._lock:
            since_s = self._clock() - _REFUSED_S
            self._refused_s = {who: at_s for who, at_s in self._refused_s.items() if at_s > since_s}
            return set(self._refused_s)

    def all(self) -> list[Payload]:
        """Those taken up, in the order in which they came."""
        with self._lock:
            return list(self._payloads.values())

    def get(self, payload_id: str) -> Payload | None:
        """One of them."""
        return self._payloads.get(payload_id)

    def take_up(self, payload_id: str, *, elsewhere: bool = False) -> Payload | None:
        """A payload, taken up if it was not yet; None: it is not wanted, or has no place.

        One that flies with another station (`elsewhere`) takes nobody's place, and gives its own to
        one that does not.
        """
        known = self._payloads.get(payload_id)
        if known is not None:
            return known
        if self._settings.ids and payload_id not in self._settings.ids:
            return None
        left: Payload | None = None
        with self._lock:
            if payload_id not in self._payloads:
                if len(self._payloads) >= self._settings.most:
                    silent = [p for p in self._payloads.values() if not p.streaming]
                    gone = [p for p in silent if not p.alive] or [p for p in silent if p.station]
                    if elsewhere:
                        return None
                    if not gone:
                        if len(self._refused_s) < _REFUSED or payload_id in self._refused_s:
                            self._refused_s[payload_id] = self._clock()
                        return None
                    left = min(gone, key=lambda payload: payload.seen_ns)
                    del self._payloads[left.id]
                self._payloads[payload_id] = self._make(payload_id)
                self._refused_s.pop(payload_id, None)
            taken = self._payloads[payload_id]
        if left is not None:
            left.close()
        return taken

    def forget(self, payload: Payload) -> None:
        """Lets go of one that has no name of its own and is gone."""
        with self._lock:
            self._payloads.pop(payload.id, None)
        payload.close()

    def owner(self, ssrc: int, key_owner: str | None, age_s: float) -> str | None:
        """Whose a stream is, as `several.Owner`.

        A payload says so in telemetry. A stream that nobody announces is taken after a moment if
        there is no doubt: by its key, when that payload announced no other (what it sent in an
        earlier flight is authentic, too); without keys when nobody announces anything.
        """
        payload_id = self._announced.by(ssrc, key_owner)
        if payload_id is None:
            if age_s < GRACE_S:
                return None
            if key_owner is not None:
                if self._announced.ssrc(key_owner) is not None:
                    return None
                payload_id = key_owner
            elif age_s < NAMELESS_S or self._announced.anyone():
                return None
            else:
                ids = self._settings.ids
                payload_id = ids[0] if len(ids) == 1 else f"{NAMELESS}{ssrc:08x}"
        return payload_id if self.take_up(payload_id) is not None else None
