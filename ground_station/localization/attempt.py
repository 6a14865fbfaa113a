"""One frame on its way to a pose, and the time it takes."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt

from ground_station.features.extractor import Features
from ground_station.localization.estimate import Counts, no_observations

Array = npt.NDArray[np.float64]


class Stopwatch:
    """Milliseconds by stage; a stage that runs twice adds up."""

    def __init__(self) -> None:
        self.stage_ms: dict[str, float] = {}
        self._begin = self._mark = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + 1e3 * (now - self._mark)
        self._mark = now

    def finish(self) -> dict[str, float]:
        return self.stage_ms | {"total": 1e3 * (time.perf_counter() - self._begin)}


class Attempt:
    """One frame on its way to a pose."""

    def __init__(
        self, time_ns: int, index: int, watch: Stopwatch, entropy: float = float("nan")
    ) -> None:
        self.time_ns, self.index, self.watch, self.entropy = time_ns, index, watch, entropy
        self.predicted: Array | None = None
        self.counts = Counts()
        self.observations = no_observations()
        self.features = Features(
            np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty((0, 0), np.float32)
        )
        self.normalized = np.empty((0, 2))
