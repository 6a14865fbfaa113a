"""A lens that is covered for a while."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_station.arrays import U8
from ground_station.experiments.disturbance import Disturbance
from pi_firmware.wire import config


@dataclass(frozen=True)
class Dark(Disturbance):
    """Black pictures from a time on, for so long."""

    dark_from_s: float = config.key(
        0.0, "the lens is covered from then on", unit="s", low=0.0, high=3600
    )
    dark_s: float = config.key(0.0, "for so long; 0: never", unit="s", low=0.0, high=3600)

    def picture(self, image: U8, time_s: float) -> U8:
        is_dark = 0 <= time_s - self.dark_from_s < self.dark_s
        return np.zeros_like(image) if is_dark else image

    @property
    def blind_until_s(self) -> float | None:
        return self.dark_from_s + self.dark_s if self.dark_s > 0 else None


DISTURBANCE = Dark
