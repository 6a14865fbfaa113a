"""The settings of features, one table in the localizer's file and one in map building's."""

from __future__ import annotations

from dataclasses import dataclass

from pi_firmware.wire import config

OF_THE_MAP = "map"
"""The extractor's name that means: the one with which the map was built."""


@dataclass(frozen=True)
class LearnedSettings:
    """How a learned model is run and what is taken of what it says; no matter to the others."""

    provider: str = config.key(
        "cpu", "onnxruntime's execution provider, as cpu, openvino or cuda; it must be installed"
    )
    nms_px: int = config.key(
        0, "no two key points are nearer, along rows or columns; 0: as the model was made for",
        unit="px", low=0, high=64,
    )  # fmt: skip
    threshold: float = config.key(
        0.0, "a key point has at least this score; 0: as the model was made for", low=0, high=1
    )


@dataclass(frozen=True)
class FeatureSettings:
    """Which features a frame is described by; the map must have been built with the same."""

    extractor: str = config.key(
        OF_THE_MAP, "name of the extractor or of a model; map: what the map was built with"
    )
    max_features: int = config.key(1000, "strongest key points kept a frame", low=50, high=20000)
    threads: int = config.key(
        0, "of a learned model; 0: one core is left to the tracker", unit="threads", low=0, high=64
    )
    learned: LearnedSettings = config.table(LearnedSettings)
