"""One frame on its way to a pose, and the time it takes."""

from __future__ import annotations

import time
from dataclasses import dataclass

from ground_station.arrays import Indices
from ground_station.localization.estimate import Counts, no_observations
from ground_station.localization.kinematics import Kinematics


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


@dataclass(frozen=True)
class Conditions:
    """How a frame was taken.

    `exposure_s`, None where the camera does not tell; `sharpness` against the frames before, 0 to
    1; `recent` (R,), the landmarks seen just before, where any are known.
    """

    exposure_s: float | None = None
    sharpness: float = 1.0
    recent: Indices | None = None


class Attempt:
    """One frame on its way to a pose."""

    def __init__(self, time_ns: int, index: int = 0) -> None:
        self.time_ns, self.index = time_ns, index
        self.watch = Stopwatch()
        self.entropy = float("nan")
        self.taken = Conditions()
        self.predicted: Kinematics | None = None
        self.counts = Counts()
        self.observations = no_observations()
