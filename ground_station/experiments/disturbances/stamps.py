"""Frames whose times are off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_station.experiments.disturbance import Disturbance
from pi_firmware.wire import config


@dataclass(frozen=True)
class Stamps(Disturbance):
    """Each time is off by chance, whatever the others are."""

    stamp_error_s: float = config.key(
        0.0, "standard deviation of the frames' times", unit="s", low=0.0, high=0.1
    )

    def late_s(self, index: int, seed: int) -> float:
        return float(self.stamp_error_s * np.random.default_rng((seed, index)).standard_normal())


DISTURBANCE = Stamps
