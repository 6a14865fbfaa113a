"""What goes wrong again and again is said once a minute, with how often it did."""

from __future__ import annotations

import time
from collections.abc import Callable

_PERIOD_S = 60.0


class RateLimitedLog:
    """Says a text of each name at most once a minute, through `say(name, text)`."""

    def __init__(
        self, say: Callable[[str, str], object], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._say, self._clock = say, clock
        self._said_s: dict[str, float] = {}
        self._held: dict[str, int] = {}

    def __call__(self, name: str, text: str) -> bool:
        """Whether it was said and not only counted."""
        now_s = self._clock()
        last_s = self._said_s.get(name)
        if last_s is not None and now_s - last_s < _PERIOD_S:
            self._held[name] = self._held.get(name, 0) + 1
            return False
        held = self._held.pop(name, 0)
        self._said_s[name] = now_s
        self._say(name, f"{text} ({held} more since the last line)" if held else text)
        return True
