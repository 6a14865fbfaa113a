"""What a picture costs with each extractor, all in one run."""

from __future__ import annotations

from typing import Any

import numpy as np

from ground_station.arrays import U8
from ground_station.bench.steps import medians_ms
from ground_station.features.extractor import Extractor

BESIDE = "rootsift"
"""Times are also given as shares of this one's."""


def measure(
    extractors: dict[str, Extractor], image: U8, repetitions: int
) -> dict[str, dict[str, Any]]:
    """By name: the median time of `image`, ms, and its ratio to RootSIFT's where that is there.

    They take turns, so that a busy moment of the machine slows all.
    """

    def work(extractor: Extractor) -> Any:
        return lambda: extractor.extract(image)

    times = medians_ms(repetitions, *(work(extractor) for extractor in extractors.values()))
    by_name = dict(zip(extractors, times, strict=True))
    beside = by_name.get(BESIDE)
    return {
        name: {"ms": ms, "ratio": ms / beside if beside else None} for name, ms in by_name.items()
    }


def picture(seed: int) -> U8:
    """A picture (480, 640) with texture at all scales, for when there is no real one."""
    import cv2

    rng = np.random.default_rng(seed)
    whole = np.zeros((480, 640), np.float32)
    for scale in (4, 16, 64, 160):
        small = rng.normal(size=(480 // scale + 1, 640 // scale + 1)).astype(np.float32)
        whole += scale**0.5 * cv2.resize(small, (640, 480), interpolation=cv2.INTER_CUBIC)
    whole = 128 + 40 * whole / whole.std()
    return np.asarray(whole.clip(0, 255), np.uint8)
