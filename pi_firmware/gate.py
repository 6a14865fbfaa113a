"""The gate before the encoder: a frame without information is not worth its energy.

Three tests on the luma at low resolution, each of which can hold a frame back: the thesis's Shannon
entropy (dark and blank frames), the gradient energy against that of the frames just before (motion
blur), and the difference from the last frame sent (nothing moved). Who looks at a silent payload
cannot tell gated from dead: a heartbeat passes each second whatever the tests say.

The luma, scaled by GStreamer, is all that Python sees of a picture. Nearest neighbour picks pixels
and so keeps the histogram's shape, which averaging would narrow. On four simulated flights at
640x480 the entropy of the 160x120 picked pixels lies between 0.018 bit below and 0.006 bit above
that of the whole picture; of averaged ones, up to 0.078 bit below. So a threshold in bits means the
same at both sizes, and the scaling costs a hundredth of a millisecond.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings, GateSettings
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
    """The figures of a low-resolution luma (H, W), as `attach_luma` delivers it."""
    return Measure(entropy_bits(luma), gradient_energy(luma), block_means(luma))


@dataclass(frozen=True)
class Verdict:
    """Whether a frame passes, and why; a heartbeat does whatever the `reason` against it.

    `difference` from the last frame sent, grey levels, is None before one.
    """

    reason: Reason
    heartbeat: bool = False
    difference: float | None = None

    @property
    def passed(self) -> bool:
        return self.heartbeat or self.reason is Reason.PASS


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
        beats = self._silent_ns(now_ns) >= self._settings.heartbeat_s * 1e9 > 0
        verdict = Verdict(reason, beats and reason is not Reason.PASS, difference)
        if verdict.passed:
            self._last_passed_ns, self._sent = now_ns, measured.blocks
        return verdict

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


_LOW_RESOLUTION_PX = 160
"""Columns of the scaled luma: a whole fraction of the picture's, at least this many."""

Measured = Callable[[NDArray[np.uint8], int], None]


def low_resolution_px(camera: CameraSettings) -> tuple[int, int]:
    """Width and height of the scaled luma; the width is a multiple of 4, as its rows lie."""
    step = max(1, camera.width_px // _LOW_RESOLUTION_PX)
    return camera.width_px // step // 4 * 4, max(4, camera.height_px // step)


def luma_branch(camera: CameraSettings) -> str:
    """The tee behind the source and the branch that measures.

    A tee without queues serves its branches in turn and in one thread, in the order of their links:
    this branch has been measured before the frame goes on to the encoder. Grey levels stay as they
    are, whatever range the camera's colorimetry says.
    """
    width_px, height_px = low_resolution_px(camera)
    return (
        "tee name=split split. ! videoconvertscale name=scale method=nearest-neighbour "
        "matrix-mode=none add-borders=false n-threads=1 "
        f"! video/x-raw,format=GRAY8,pixel-aspect-ratio=1/1,width={width_px},height={height_px} "
        "! fakesink name=luma sync=false async=false split."
    )


def attach_luma(pipeline: Any, camera: CameraSettings, measured: Measured) -> Callable[[], None]:
    """Has `measured` called with each frame's scaled luma (H, W) and its running time, ns.

    What it gives ends that, and lets go of `measured`.
    """
    gst = gstreamer.load()
    width_px, height_px = low_resolution_px(camera)
    size = width_px * height_px

    def on_luma(pad: Any, probe: Any) -> Any:
        buffer = probe.get_buffer()
        plane = np.frombuffer(buffer.extract_dup(0, size), np.uint8).reshape(height_px, width_px)
        measured(plane, running_ns(gst, pad, buffer))
        return gst.PadProbeReturn.OK

    pad = pipeline.get_by_name("luma").get_static_pad("sink")
    number = pad.add_probe(gst.PadProbeType.BUFFER, on_luma)
    return lambda: pad.remove_probe(number)


def running_ns(gst: Any, pad: Any, buffer: Any) -> int:
    """The running time of a buffer that passes a pad, whatever the pad's segment is."""
    event = pad.get_sticky_event(gst.EventType.SEGMENT, 0)
    return int(event.parse_segment().to_running_time(gst.Format.TIME, buffer.pts))
