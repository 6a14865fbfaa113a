"""The gate before the encoder: a frame without information is not worth its energy.

The thesis's gate: frames whose Shannon entropy lies below a threshold are dropped on board. The
gradient energy is measured beside it and travels with each frame; entropy alone decides.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pi_firmware.settings import GateSettings
from pi_firmware.wire.entropy import entropy_bits

LOW_RESOLUTION_PX = 160
"""Entropy is measured on about this many columns: every n-th pixel of every n-th row. Picking
pixels keeps the histogram's shape, which averaging them would narrow."""


@dataclass(frozen=True)
class Measure:
    """`entropy_bits` of the luma's histogram; `sharpness`, its mean squared gradient."""

    entropy_bits: float
    sharpness: float


def gradient_energy(luma: NDArray[np.uint8], step: int = 1) -> float:
    """Mean of dx^2 + dy^2 between neighbouring pixels of `luma` (H, W), grey levels squared.

    Each `step`-th pair of rows is looked at; the neighbours are always one pixel apart.
    """
    upper = luma[:-1:step].astype(np.int32)
    lower = luma[1::step].astype(np.int32)
    dx = np.diff(upper, axis=1)
    dy = lower - upper
    return float((dx * dx).mean() + (dy * dy).mean())


def measure(luma: NDArray[np.uint8]) -> Measure:
    """What the gate looks at, from the luma plane (H, W) as it goes to the encoder."""
    step = max(1, luma.shape[1] // LOW_RESOLUTION_PX)
    return Measure(entropy_bits(luma[::step, ::step]), gradient_energy(luma, step))


class Decision(enum.Enum):
    """What becomes of a captured frame."""

    PASS = "pass"
    GATED = "gated"
    HEARTBEAT = "heartbeat"


class Gate:
    """Decides frame by frame: a threshold with hysteresis, and a heartbeat while all is gated."""

    def __init__(self, settings: GateSettings) -> None:
        self._settings = settings
        self._open = True
        self._last_passed_ns: int | None = None

    def decide(self, entropy_bits: float, now_ns: int) -> Decision:
        """The decision on a frame captured at `now_ns` on a clock that does not jump."""
        limits = self._settings
        threshold = limits.min_entropy_bits + (0.0 if self._open else limits.hysteresis_bits)
        self._open = not limits.enabled or entropy_bits >= threshold
        if self._open:
            decision = Decision.PASS
        elif limits.heartbeat_s > 0 and self._silent_ns(now_ns) >= limits.heartbeat_s * 1e9:
            decision = Decision.HEARTBEAT
        else:
            return Decision.GATED
        self._last_passed_ns = now_ns
        return decision

    def _silent_ns(self, now_ns: int) -> int:
        if self._last_passed_ns is None:  # nothing sent yet: count from the first frame
            self._last_passed_ns = now_ns
        return now_ns - self._last_passed_ns
