"""What the payload asks of a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from pi_firmware.sources.window import Window
from pi_firmware.wire.errors import BlimpError


@dataclass(frozen=True)
class Stamp:
    """When a frame was captured, and with what exposure.

    `time_ns`, since 1970, is the middle of the exposure of the picture's middle row: the instant
    whose pose the ground station estimates, from which it counts the other rows of a rolling
    shutter. A live camera's timestamp is brought there by the sensor's readout and exposure, as far
    as these are known (`live.to_middle_ns`); a recording's capture times are this already.
    `clock_ns` is the payload's clock at that instant; in a replay, when the frame was handed over.
    `exposure_s`, of each row, and `gain` are None where the device does not tell.
    """

    time_ns: int
    clock_ns: int
    exposure_s: float | None = None
    gain: float | None = None


class Source(Protocol):
    """Frames for the pipeline; whichever camera they come from.

    The pipeline is built from `elements`, `attach`ed, set to playing, and then `start`ed. The
    source ends the stream itself when it has no more frames, or when `stop` is called.
    """

    rate_hz: float
    """Frames captured a second."""

    cut_reason: str = ""
    """Why a recording ended early, in words; empty when it did not."""

    error: BlimpError | None = None
    """What ended the source for good, when it was not its end: opening it again would not help.

    None where the pipeline's error is one of the moment, as of a camera that was unplugged.
    """

    dmabuf: bool = False
    """Whether the pictures are dmabufs, which a hardware encoder reads without a copy."""

    window: Window | None = None
    """Told of each frame that passes the gate, where the source waits for the ground's answers."""

    def elements(self) -> str:
        """The pipeline's text from the source to raw I420 or NV12 at the camera's size and rate."""
        ...

    def attach(self, pipeline: Any) -> None:
        """Takes the pipeline that was built, before it plays."""
        ...

    def start(self) -> None:
        """Begins to deliver frames into the playing pipeline."""
        ...

    def stamp(self, running_ns: int) -> Stamp:
        """The capture times of the frame that has this running time in the pipeline."""
        ...

    def explain(self, message: str) -> str:
        """GStreamer's error message, in words of this source where it has better ones."""
        return message

    def stop(self) -> None:
        """Ends the stream: what was delivered still flows through."""
        ...

    def close(self) -> None:
        """Releases threads and files, after the pipeline has stopped."""
        ...
