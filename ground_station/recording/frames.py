"""What every input gives: frames in order of time, and the camera when the input knows it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from ground_station.arrays import U8
from ground_station.geometry.camera import Camera

if TYPE_CHECKING:
    from pi_firmware.wire.recording import RecordingWriter


RATE_HZ = 30.0
"""Of frames that tell no times and are given no rate."""


@dataclass(frozen=True)
class Frame:
    """One picture. `index` counts in the input from 0; `image` is (H, W) uint8, grey.

    `exposure_s` is how long each row was exposed, None where the input does not tell.
    """

    index: int
    name: str
    time_ns: int
    image: U8
    exposure_s: float | None = None


MAX_EXPOSURE_S = 1.0
"""No camera that films exposes longer: a message that says so is wrong."""


def plausible_exposure_s(value: Any) -> float | None:
    """An exposure as a message tells it; None unless it is a number above 0 s and at most 1 s."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    return float(value) if 0 < value <= MAX_EXPOSURE_S else None  # NaN fails both


@dataclass(frozen=True)
class FrameRange:
    """Every `step`-th frame from `start` up to but without `stop` (None: to the end)."""

    start: int = 0
    stop: int | None = None
    step: int = 1

    def __contains__(self, index: int) -> bool:
        below = self.stop is None or index < self.stop
        return below and index >= self.start and (index - self.start) % self.step == 0

    def __str__(self) -> str:
        stop = "" if self.stop is None else self.stop
        return f"{self.start}:{stop}" + (f":{self.step}" if self.step != 1 else "")

    def is_past(self, index: int) -> bool:
        """Whether neither this frame nor any later one is wanted."""
        return self.stop is not None and index >= self.stop

    def count(self, available: int) -> int:
        """How many of `available` frames are wanted."""
        stop = available if self.stop is None else min(available, self.stop)
        return len(range(self.start, stop, self.step))


ALL_FRAMES = FrameRange()

CAMERA_TABLE = "camera"
"""A recording's metadata table that may hold `readout_s`, which no Foxglove message has."""


def write_calibration(writer: RecordingWriter, camera: Camera, time_ns: int, topic: str) -> None:
    """Writes a camera's calibration as of a time, without what no Foxglove message has."""
    writer.write_calibration(
        time_ns,
        width_px=camera.width_px,
        height_px=camera.height_px,
        matrix=camera.matrix.ravel().tolist(),
        distortion=camera.distortion.tolist(),
        distortion_model=camera.distortion_model,
        topic=topic,
    )


class FrameSource(Protocol):
    """A folder of images, a video file or a recording. Iterating opens it again from its start.

    `camera` is None unless the input carries one; `notes` holds lines a person should see, such as
    where a cut recording ends (complete only after the iteration).
    """

    camera: Camera | None
    notes: list[str]

    def __iter__(self) -> Iterator[Frame]: ...

    def count(self) -> int | None:
        """The number of frames when it is known without decoding, else None."""
        ...
