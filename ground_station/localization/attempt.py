"""One frame on its way to a pose, and the time it takes."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.arrays import Bools, Indices
from ground_station.localization.estimate import Counts, PoseEstimate, State, no_observations
from ground_station.localization.kinematics import Kinematics
from pi_firmware.wire import annexb


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
    1; `recent` (R,), the landmarks seen just before, where any are known; `damaged` (rows, columns)
    the macroblocks of H.264 that a loss took on the way, None where all is as it was sent.
    """

    exposure_s: float | None = None
    sharpness: float = 1.0
    recent: Indices | None = None
    damaged: Bools | None = None

    def shows(self, pixel_px: npt.NDArray[np.floating], reach_px: int) -> Bools:
        """Whether what is around pixels (N, 2), up to `reach_px` off, is as it was sent (N,)."""
        whole = np.ones(len(pixel_px), bool)
        if self.damaged is None:
            return whole
        last = np.array(self.damaged.shape[::-1]) - 1
        steps = [*range(-reach_px, reach_px, annexb.MACROBLOCK_PX), reach_px]
        for step in itertools.product(steps, repeat=2):
            beside = np.nan_to_num((pixel_px + step) // annexb.MACROBLOCK_PX)
            column, row = np.clip(beside, 0, last).astype(int).T
            whole &= ~self.damaged[row, column]
        return whole


class Attempt:
    """One frame on its way to a pose."""

    def __init__(self, time_ns: int, index: int = 0) -> None:
        self.time_ns, self.index = time_ns, index
        self.watch = Stopwatch()
        self.taken = Conditions()
        self.predicted: Kinematics | None = None
        self.counts = Counts()
        self.observations = no_observations()

    def estimate(self, state: State, reason: str, **more: Any) -> PoseEstimate:
        """What became of it; `more` are the estimate's other fields, of a frame that was solved."""
        return PoseEstimate(
            self.time_ns, self.index, state, reason, counts=self.counts,
            observations=self.observations, stage_ms=self.watch.finish(), **more,
        )  # fmt: skip
