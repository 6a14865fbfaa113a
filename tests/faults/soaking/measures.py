"""What a long run measures over time: one value each some seconds, in small memory."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MEMORY, DESCRIPTORS, LATENCY, CLOCK = "memory", "descriptors", "latency", "clock"
KINDS = (MEMORY, DESCRIPTORS, LATENCY, CLOCK)


@dataclass
class Measure:
    """One value over time, of one `kind`; what stands beside it is how it is judged.

    `matters` is the slope an hour that would matter: None, and it is drawn only. `both` says that
    falling matters as rising does. `step` is the least by which the value can change at all, as 1
    of a count.
    """

    kind: str
    name: str
    unit: str
    matters: float | None = None
    both: bool = False
    step: float = 0.0
    points: list[tuple[float, float]] = field(default_factory=list)
    """(seconds from the start, value); NaN where there is none."""

    def add(self, at_s: float, value: float | None) -> None:
        """The value at a time; None: it is not known."""
        self.points.append((at_s, float("nan") if value is None else value))

    def settled(self, from_s: float) -> Array:
        """The known points from a time on, (N, 2)."""
        points = np.array(self.points, np.float64).reshape(-1, 2)
        return points[(points[:, 0] >= from_s) & np.isfinite(points[:, 1])]

    def document(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)


def from_document(document: dict[str, Any]) -> Measure:
    """A measure from what `document` gave and a file kept, where null stands for NaN."""
    measure = Measure(**document)
    given, measure.points = measure.points, []
    for at_s, value in given:
        measure.add(at_s, value)
    return measure


@dataclass(frozen=True)
class Window:
    """The quantiles of the values in one stretch of time, which began at `at_s`."""

    at_s: float
    least: float
    median: float
    p99: float
    most: float


class Windows:
    """Values that come often, as quantiles of one stretch of time after the other."""

    def __init__(self, length_s: float) -> None:
        self._length_s = length_s
        self._number = 0
        self._values: list[float] = []

    def add(self, at_s: float, value: float) -> Window | None:
        """Takes a value; gives the window before when this is the first one after it."""
        number = int(at_s // self._length_s)
        closed = self.close() if number != self._number else None
        self._number = number
        self._values.append(value)
        return closed

    def close(self) -> Window | None:
        """The window that is open, whole or not; None when it is empty."""
        if not self._values:
            return None
        quantiles = np.quantile(self._values, (0.0, 0.5, 0.99, 1.0))
        self._values = []
        return Window(self._number * self._length_s, *map(float, quantiles))
