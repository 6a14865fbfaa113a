"""The settings of features, one table in the localizer's file and one in map building's."""

from __future__ import annotations

from dataclasses import dataclass

from pi_firmware.wire import config

OF_THE_MAP = "map"
"""The extractor's name that means: the one with which the map was built."""


@dataclass(frozen=True)
class LearnedSettings:
    """How a learned model is run and what is taken of what it says; no matter to the others."""

    provider: str = "cpu"
    nms_px: int = config.key(0, unit="px", low=0, high=64)
    threshold: float = config.key(0.0, low=0, high=1)


@dataclass(frozen=True)
class FeatureSettings:
    """Which features a frame is described by; the map must have been built with the same."""

    extractor: str = OF_THE_MAP
    max_features: int = config.key(1000, low=50, high=20000)
    threads: int = config.key(0, unit="threads", low=0, high=64)
    learned: LearnedSettings = config.table(LearnedSettings)
