"""The gate before the encoder: a frame without information is not worth its energy.

Three tests on the luma at low resolution, each of which can hold a frame back: the thesis's Shannon
entropy (dark and blank frames), the gradient energy against that of the frames just before (motion
blur), and the difference from the last frame sent (nothing moved). Who looks at a silent payload
cannot tell gated from dead: a heartbeat passes each second whatever the tests say.
"""

from __future__ import annotations

import enum
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pi_firmware.settings import GateSettings
from pi_firmware.wire.entropy import entropy_bits
from pi_firmware.wire.messages import Reason

_BLOCK_PX = 4
_RECENT_FRAMES = 60
_RECENT_AT_LEAST = 10
_BLUR_HYSTERESIS = 1.2


@dataclass(frozen=True)
class Measure:
    """What the gate looks at.

    `entropy_bits` of the luma's histogram; `sharpness`, its mean squared gradient, grey levels
    squared; `blocks` (H/4, W/4), the means of its 4x4 blocks, in which a sensor's noise is a
    quarter.
    """

    entropy_bits: float
    sharpness: float
    blocks: NDArray[np.float32]


def gradient_energy(luma: NDArray[np.uint8]) -> float:
    """Mean of dx^2 + dy^2 between neighbouring pixels of `luma` (H, W), grey levels squared."""
    grey = luma.astype(np.float32)
    dx = (grey[:, 1:] - grey[:, :-1]).ravel()
    dy = (grey[1:] - grey[:-1]).ravel()
    return float(dx.dot(dx) / max(1, dx.size) + dy.dot(dy) / max(1, dy.size))


def block_means(luma: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Means of the 4x4 blocks of `luma` (H, W), both at least 4; what is left over is left out."""
    rows, columns = (size // _BLOCK_PX for size in luma.shape)
    whole = luma[: rows * _BLOCK_PX, : columns * _BLOCK_PX]
    # Whole rows are added, then whole columns: numpy's sum over an axis of four works four by four.
    lines = whole[::_BLOCK_PX].astype(np.uint16)
    for row in range(1, _BLOCK_PX):
        lines += whole[row::_BLOCK_PX]
    sums = lines[:, ::_BLOCK_PX].astype(np.float32)
    for column in range(1, _BLOCK_PX):
        sums += lines[:, column::_BLOCK_PX]
    return sums / np.float32(_BLOCK_PX**2)


def measure(luma: NDArray[np.uint8]) -> Measure:
    """The figures of a low-resolution luma (H, W), as `measuring` delivers it."""
    return Measure(entropy_bits(luma), gradient_energy(luma), block_means(luma))


class Decision(enum.Enum):
    """What becomes of a captured frame."""

    PASS = "pass"
    GATED = "gated"
    HEARTBEAT = "heartbeat"


@dataclass(frozen=True)
class Verdict:
    """A decision and why; `difference` from the last frame sent, grey levels, None before one."""

    decision: Decision
    reason: Reason
    difference: float | None = None


class Gate:
    """Decides frame by frame; the tests in `GateSettings`, and a heartbeat while all is gated."""

    def __init__(self, settings: GateSettings) -> None:
        self._settings = settings
        self._rich = True
        self._sharp = True
        self._recent: deque[float] = deque(maxlen=_RECENT_FRAMES)
        self._sent: NDArray[np.float32] | None = None
        self._last_passed_ns: int | None = None

    def decide(self, measured: Measure, now_ns: int) -> Verdict:
        """The verdict on a frame captured at `now_ns` on a clock that does not jump."""
        difference = self._difference(measured.blocks)
        reason = self._reason(measured, difference)
        if reason is Reason.PASS:
            decision = Decision.PASS
        elif self._silent_ns(now_ns) >= self._settings.heartbeat_s * 1e9 > 0:
            decision = Decision.HEARTBEAT
        else:
            return Verdict(Decision.GATED, reason, difference)
        self._last_passed_ns = now_ns
        self._sent = measured.blocks
        return Verdict(decision, reason, difference)

    def _reason(self, measured: Measure, difference: float | None) -> Reason:
        """Every test is made on every frame, so that its hysteresis knows all of them."""
        limits = self._settings
        least_bits = limits.min_entropy_bits + (0.0 if self._rich else limits.hysteresis_bits)
        self._rich = measured.entropy_bits >= least_bits
        self._sharp = self._is_sharp(measured.sharpness)
        if not limits.enabled:
            return Reason.PASS
        if not self._rich:
            return Reason.ENTROPY
        if not self._sharp:
            return Reason.BLUR
        if difference is not None and difference < limits.min_difference:
            return Reason.DUPLICATE
        return Reason.PASS

    def _is_sharp(self, sharpness: float) -> bool:
        """Against the median of the last two seconds at 30 Hz: another scene has another level."""
        recent = self._recent
        recent.append(sharpness)
        if len(recent) < _RECENT_AT_LEAST:
            return True
        usual = sorted(recent)[len(recent) // 2]
        hysteresis = 1.0 if self._sharp else _BLUR_HYSTERESIS
        return sharpness >= usual * min(1.0, self._settings.min_sharpness_ratio * hysteresis)

    def _difference(self, blocks: NDArray[np.float32]) -> float | None:
        if self._sent is None or self._sent.shape != blocks.shape:
            return None
        apart = blocks - self._sent
        np.abs(apart, out=apart)
        return float(np.add.reduce(apart, axis=None) / apart.size)  # mean() without its wrapping

    def _silent_ns(self, now_ns: int) -> int:
        if self._last_passed_ns is None:  # nothing sent yet: count from the first frame
            self._last_passed_ns = now_ns
        return now_ns - self._last_passed_ns
