"""The search for the highest level of a list that is sustained, without trusting monotony."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

BORNE = 0.95
"""The share of TRACKING frames that each seed must keep."""


@dataclass(frozen=True)
class Tried:
    """One level's shares of TRACKING, one for each seed."""

    shares: tuple[float, ...]

    @property
    def sustained(self) -> bool:
        """Whether all seeds keep the share; NaN keeps nothing."""
        return bool(self.shares) and all(share >= BORNE for share in self.shares)


@dataclass
class Found:
    """What a search knows: levels by their place in the list, 0 the easiest.

    `sustained` is the highest level up to which every tried one is so, None when not even the first
    is; `refused` the next one that is not, None when there is no harder level. `odd` are tried
    levels above a refused one that are sustained all the same: there the answer is not monotonic.
    """

    tried: dict[int, Tried] = field(default_factory=dict)

    @property
    def refused(self) -> int | None:
        return min((n for n, one in self.tried.items() if not one.sustained), default=None)

    @property
    def sustained(self) -> int | None:
        refused = self.refused
        below = [n for n in self.tried if refused is None or n < refused]
        return max(below, default=None)

    @property
    def odd(self) -> list[int]:
        refused = self.refused
        if refused is None:
            return []
        return sorted(n for n, one in self.tried.items() if n > refused and one.sustained)


def search(levels: int, measure: Callable[[int], Sequence[float]], found: Found) -> Found:
    """Brackets the limit among `levels` levels, easiest first, and looks at both its sides.

    `measure` gives a level's shares by seed. Level 0 comes first: when it is refused, nothing is
    said of the others. Then the list is halved until the highest level sustained and the lowest one
    refused are neighbours. One level beyond and one below are tried as well; should the one below
    fail, the search goes on beneath it. What `found` has already is not measured again, and it is
    filled as the search goes, so that an interruption keeps it.
    """

    def holds(level: int) -> bool:
        if level not in found.tried:
            found.tried[level] = Tried(tuple(measure(level)))
        return found.tried[level].sustained

    if levels < 1 or not holds(0):
        return found
    low, high = 0, levels  # `low` is sustained; `high` is refused, or beyond the list
    while True:
        while high - low > 1:
            middle = (low + high) // 2
            if holds(middle):
                low = middle
            else:
                high = middle
        if high + 1 < levels:
            holds(high + 1)
        if low < 2 or holds(low - 1):
            return found
        low, high = 0, low - 1
