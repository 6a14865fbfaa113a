"""Which stream is whose, by what the payloads announce."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

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
