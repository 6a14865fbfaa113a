"""What things take longer on a way than the fastest of them did: the queue on it, or its lateness.

As LEDBAT's base delay (RFC 6817, 3.4): delays are above any constant, so that no common clock is
needed, and the least of them is forgotten after a while, so that neither a clock that drifts nor
one hiccup is believed for ever.
"""

from __future__ import annotations

from collections import deque

WINDOW_NS = 500_000_000
"""What is standing is of this last time: a group of pictures, so that one IDR is in it."""
_QUANTILE = 0.25
"""Most must be late for it to stand: the frames after an IDR and those of a short hiccup do not."""
_BASE_NS = 30_000_000_000
_BUCKET_NS = 1_000_000_000


class StandingDelay:
    """Takes delays as they come; for one thread. Times and delays are ns, of any one clock each."""

    def __init__(self) -> None:
        self._late: deque[tuple[int, int]] = deque()
        self._least: deque[tuple[int, int]] = deque()  # of each second: its begin, least delay

    @property
    def base_ns(self) -> int | None:
        """The least delay of late; None before the first."""
        return min((least_ns for _, least_ns in self._least), default=None)

    def add(self, at_ns: int, delay_ns: int) -> None:
        """Takes the delay of what came at this time."""
        self._late.append((at_ns, delay_ns))
        if self._least and at_ns - self._least[-1][0] < _BUCKET_NS:
            begin_ns, least_ns = self._least.pop()
            self._least.append((begin_ns, min(least_ns, delay_ns)))
        else:
            self._least.append((at_ns, delay_ns))
        while len(self._least) > 1 and at_ns - self._least[0][0] >= _BASE_NS:
            self._least.popleft()
        self._forget(at_ns)

    def rebase(self, at_ns: int, least_ns: int) -> None:
        """Takes this for the least delay of late, whatever came before."""
        self._least = deque([(at_ns, least_ns)])

    def standing_s(self, now_ns: int) -> float | None:
        """How much longer most of late took than the fastest; None when nothing came of late."""
        self._forget(now_ns)
        base_ns = self.base_ns
        if not self._late or base_ns is None:
            return None
        delays_ns = sorted(delay_ns for _, delay_ns in self._late)
        return max(0, delays_ns[int(_QUANTILE * len(delays_ns))] - base_ns) / 1e9

    def _forget(self, now_ns: int) -> None:
        while self._late and now_ns - self._late[0][0] >= WINDOW_NS:
            self._late.popleft()
