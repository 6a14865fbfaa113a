"""What the payload asks of a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from pi_firmware.wire.errors import BlimpError


@dataclass(frozen=True)
class Stamp:
    """When a frame was captured: the camera's time, the payload's clock at it, and the exposure."""

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

    cut_reason: str
    """Why a recording ended early, in words; empty when it did not."""

    error: BlimpError | None
    """What ended the source, when it was not its end."""

    dmabuf: bool
    """Whether the pictures are dmabufs, which a hardware encoder reads without a copy."""

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
        ...

    def stop(self) -> None:
        """Ends the stream: what was delivered still flows through."""
        ...

    def close(self) -> None:
        """Releases threads and files, after the pipeline has stopped."""
        ...
