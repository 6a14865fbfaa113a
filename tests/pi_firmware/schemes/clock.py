"""`clock:`, pictures that show when they were taken: a camera in a file of its own.

It is put beside those that ship in `pi_firmware.sources.schemes`.
"""

from __future__ import annotations

import threading
import time

import numpy as np
from numpy.typing import NDArray

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.live import LiveSource, caps
from pi_firmware.uri import Uri

BITS = 64
COLUMNS = 16
_DARK, _BRIGHT = 30, 220


def block_px(width_px: int) -> int:
    """Side of one bit's square: the bits stand in four rows of sixteen, lowest bit first."""
    return width_px // COLUMNS


def burn_in(luma: NDArray[np.uint8], time_ns: int) -> None:
    """Paints `time_ns` as bright and dark squares into the upper left of `luma` (H, W)."""
    side = block_px(luma.shape[1])
    bits = np.array([time_ns >> bit & 1 for bit in range(BITS)], bool).reshape(-1, COLUMNS)
    squares = np.where(bits, _BRIGHT, _DARK).astype(np.uint8)
    painted = squares.repeat(side, axis=0).repeat(side, axis=1)
    luma[: painted.shape[0], : painted.shape[1]] = painted


def read_clock(luma: NDArray[np.uint8]) -> int:
    """The time, ns, that `burn_in` painted into a picture of this size (H, W)."""
    side = block_px(luma.shape[1])
    rows = BITS // COLUMNS
    squares = luma[: rows * side, : COLUMNS * side].reshape(rows, side, COLUMNS, side)
    inner = slice(side // 4, max(side // 4 + 1, 3 * side // 4))
    bright = squares[:, inner, :, inner].mean(axis=(1, 3)).ravel() > (_DARK + _BRIGHT) / 2
    return sum(1 << bit for bit in range(BITS) if bright[bit])


class ClockSource(LiveSource):
    """Each picture shows the wall clock at its instant; the stamp comes the cameras' own way.

    The picture's timestamp is the pipeline's clock at the instant, and the time of capture is made
    of it as for every live source: what is painted is nowhere handed on.
    """

    def __init__(self, uri: Uri, camera: CameraSettings) -> None:
        self._frames = round(uri.number("duration_s", 1.0, 0.1, 60.0) * camera.rate_hz)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clock", daemon=True)
        super().__init__(
            camera,
            "appsrc name=source is-live=true format=time block=true max-bytes=0 max-buffers=2 "
            f'caps="{caps(camera, "I420")}"',
        )

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()

    def close(self) -> None:
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        super().close()

    def _run(self) -> None:
        gst = gstreamer.load()
        source = self._pipeline.get_by_name("source")
        width, height = self._camera.width_px, self._camera.height_px
        stride = -(-width // 4) * 4
        chroma = bytes([128]) * (2 * -(-stride // 8) * 4 * (height // 2))
        rows = np.zeros((height, stride), np.uint8)
        rows[:, :width] = np.linspace(20, 235, width).astype(np.uint8)
        clock, base_ns = self._pipeline.get_clock(), self._pipeline.get_base_time()
        start_ns = clock.get_time()
        for count in range(self._frames):
            wait_ns = start_ns + int(count * 1e9 / self.rate_hz) - clock.get_time()
            if self._stopping.wait(max(0, wait_ns) / 1e9):
                break
            before_ns = clock.get_time()
            wall_ns = time.time_ns()
            instant_ns = (before_ns + clock.get_time()) // 2
            burn_in(rows[:, :width], wall_ns)
            buffer = gst.Buffer.new_wrapped(rows.tobytes() + chroma)
            buffer.pts = instant_ns - base_ns
            if source.emit("push-buffer", buffer) != gst.FlowReturn.OK:
                break
        source.emit("end-of-stream")


SOURCE = ClockSource
