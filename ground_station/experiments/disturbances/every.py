"""Frames that are farther apart."""

from __future__ import annotations

from dataclasses import dataclass

from ground_station.experiments.disturbance import Disturbance
from pi_firmware.wire import config


@dataclass(frozen=True)
class Every(Disturbance):
    """A camera, or a radio, that is slower."""

    every: int = config.key(1, "one frame in so many is seen", unit="frames", low=1, high=100)

    def keeps(self, index: int) -> bool:
        return index % self.every == 0


DISTURBANCE = Every
