"""Where a payload was of late, in few points."""

from __future__ import annotations

import math
from collections.abc import Sequence

MOST = 2000
_SPACING_M = 0.05
_GAP_NS = 2_000_000_000
_KEPT_NS = 30 * 60 * 1_000_000_000


class Trail:
    """At most `MOST` positions, `_SPACING_M` apart; the older half is thinned when it is full.

    What is older than half an hour is forgotten. A stretch begins where nothing was known before
    for 2 s, or where the payload was found again: no line leads there.
    """

    def __init__(self) -> None:
        self._points: list[tuple[int, list[float], bool]] = []

    def add(self, now_ns: int, position_m: Sequence[float], begins: bool = False) -> None:
        """Takes a position (3,), m; one near the last one is left out."""
        point = [round(value, 3) for value in position_m]
        if self._points:
            last_ns, last, broke = self._points[-1]
            begins = begins or now_ns - last_ns > _GAP_NS
            if not begins and math.dist(last, point) < _SPACING_M:
                # Its time is kept up: standing still is no gap.
                self._points[-1] = (now_ns, last, broke)
                return
        self._points.append((now_ns, point, begins))
        if len(self._points) > MOST:
            self._thin(now_ns)

    def document(self) -> tuple[list[list[float]], list[int]]:
        """The points, and the indices at which a new stretch begins."""
        points = [point for _, point, _ in self._points]
        return points, [at for at, item in enumerate(self._points) if item[2] and at]

    def _thin(self, now_ns: int) -> None:
        points = [item for item in self._points if now_ns - item[0] < _KEPT_NS]
        half = len(points) // 2
        older = points[:half]
        kept = [item for at, item in enumerate(older) if at % 2 == 0 or item[2]]
        # Where each point begins a stretch nothing would be thinned.
        self._points = [*kept, *points[half:]][-MOST + MOST // 8 :]
