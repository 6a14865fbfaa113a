"""Too little processor for the frames that come: seen, said, and answered by doing less."""

from __future__ import annotations

from collections import deque

from ground_station.localization.localizer import Localizer

WINDOW_S = 2.0
SKIPPED = 0.05
"""Of the frames told of: what `make limits` calls sustained is TRACKING in 95 % of them."""
LATE_S = 1.0
"""Features of a frame take a tenth of this where a core is free for them."""


class Overload:
    """Whether frames are skipped, or features late, for lack of processor; its state in words."""

    def __init__(self) -> None:
        self._counts: deque[tuple[float, int, int]] = deque()

    def watch(self, localizer: Localizer, now_s: float, taken: int, skipped: int) -> str:
        """After each frame; the localizer is told, and the answer is "" while all is well.

        `now_s` is monotonic; `taken` and `skipped` count the stream's frames so far.
        """
        counts = self._counts
        if counts and taken + skipped < counts[-1][1] + counts[-1][2]:
            counts.clear()  # counted again
        counts.append((now_s, taken, skipped))
        while len(counts) > 1 and counts[1][0] <= now_s - WINDOW_S:
            counts.popleft()
        lost = skipped - counts[0][2]
        told = lost + taken - counts[0][1]
        late_s = localizer.keyframe_late_s
        localizer.overloaded = lost > SKIPPED * told
        if localizer.overloaded:
            return (
                f"this computer is too slow: {lost} of {told} frames skipped in {WINDOW_S:g} s;"
                " keyframes are rare"
            )
        if late_s > LATE_S:
            return (
                f"this computer is too slow: features under way for {late_s:.1f} s;"
                " keyframes are late"
            )
        return ""
