"""What live cameras have in common: they deliver by themselves, stamped by the pipeline's clock."""

from __future__ import annotations

import enum
import time
from fractions import Fraction
from typing import Any

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.base import Source, Stamp
from pi_firmware.uri import Uri

_GOOD_NS = 100_000  # a tenth of the millisecond that capture times are good for
_ATTEMPTS = 5


class Mark(enum.Enum):
    """Which instant of a frame a camera stamps, with a rolling shutter as with a global one."""

    EXPOSURE_START = "the first row begins to be exposed"
    READOUT_START = "the first row has been exposed, and its transfer begins"
    READOUT_END = "the last row has been transferred"
    MIDDLE = "the middle of the middle row's exposure"


def to_middle_ns(mark: Mark, exposure_s: float | None, readout_s: float) -> int:
    """What to add to a timestamp to get the middle of the middle row's exposure, ns.

    `readout_s` is the time from the first row to the last, 0 for a global shutter. Where the
    exposure is unknown (None) it counts as none: the result is then wrong by half of it.
    """
    half_exposure_s = (exposure_s or 0.0) / 2
    if mark is Mark.EXPOSURE_START:
        offset_s = readout_s / 2 + half_exposure_s
    elif mark is Mark.READOUT_START:
        offset_s = readout_s / 2 - half_exposure_s
    elif mark is Mark.READOUT_END:
        offset_s = -readout_s / 2 - half_exposure_s
    else:
        offset_s = 0.0
    return round(offset_s * 1e9)


def wall_at(pipeline: Any, running_ns: int) -> int:
    """The wall clock, ns since 1970, when the pipeline's running time was `running_ns`.

    The two clocks cannot be read at once, and the thread may be held between: of up to five tries
    the one counts whose reading of the wall clock is framed most tightly. A wall clock that was set
    again since shifts the result by as much: it is the wall clock of now that is meant.
    """
    clock = pipeline.get_clock()
    best_ns, offset_ns = 1 << 62, 0
    for _ in range(_ATTEMPTS):
        before_ns = clock.get_time()
        wall_ns = time.time_ns()
        after_ns = clock.get_time()
        if after_ns - before_ns < best_ns:
            best_ns = after_ns - before_ns
            offset_ns = wall_ns - (before_ns + after_ns) // 2
        if best_ns < _GOOD_NS:
            break
    return int(pipeline.get_base_time() + running_ns + offset_ns)


def caps(camera: CameraSettings, formats: str = "{I420,NV12}") -> str:
    """The pictures that are asked for; a device that has no such ones does not start."""
    rate = Fraction(camera.rate_hz).limit_denominator(1001)
    return (
        f"video/x-raw,format=(string){formats},width={camera.width_px},height={camera.height_px},"
        f"framerate={rate.numerator}/{rate.denominator}"
    )


def readout_s(uri: Uri) -> float:
    """The URI's `readout_s`: the rolling shutter's time from the first row to the last."""
    return uri.number("readout_s", 0.0, 0.0, 1.0)


def check_exposure(uri: Uri, camera: CameraSettings) -> None:
    """Raises `SourceError` for a fixed exposure longer than a frame: no camera can keep both."""
    frame_s = 1 / camera.rate_hz
    if camera.exposure_s > frame_s:
        raise uri.fail(
            f"camera.exposure_s is {camera.exposure_s:g}; a frame lasts {frame_s:.4g} s at"
            f" camera.rate_hz {camera.rate_hz:g}"
        )


def post_error(element: Any, text: str) -> None:
    """Ends the pipeline with an error of this element, as GStreamer's own would."""
    gst = gstreamer.load()
    from gi.repository import GLib

    error = GLib.Error.new_literal(gst.resource_error_quark(), text, gst.ResourceError.READ)
    element.post_message(gst.Message.new_error(element, error, text))


class LiveSource(Source):
    """A GStreamer source named `source` that stamps each frame; `mark` tells which instant of it.

    A source that knows more than this one of a frame's exposure says so in `told`.
    """

    def __init__(
        self,
        camera: CameraSettings,
        elements: str,
        *,
        mark: Mark = Mark.MIDDLE,
        readout_s: float = 0.0,
    ) -> None:
        self.rate_hz = camera.rate_hz
        self._camera = camera
        self._elements = elements
        self._mark = mark
        self._readout_s = readout_s
        self._stamped = 0
        self._pipeline: Any = None

    def elements(self) -> str:
        return self._elements

    def attach(self, pipeline: Any) -> None:
        self._pipeline = pipeline

    def start(self) -> None:
        """Nothing to do: it delivers from the moment the pipeline plays."""

    def stamp(self, running_ns: int) -> Stamp:
        self._stamped += 1
        exposure_s, gain = self.exposure_and_gain()
        marked_ns = wall_at(self._pipeline, running_ns)
        captured_ns = marked_ns + to_middle_ns(self._mark, exposure_s, self._readout_s)
        return Stamp(captured_ns, captured_ns, exposure_s, gain)

    def exposure_and_gain(self) -> tuple[float | None, float | None]:
        """Exposure, s, and gain of the frame at hand; None where the device does not tell."""
        return None, None

    def stop(self) -> None:
        if self._pipeline is not None:
            gst = gstreamer.load()
            self._pipeline.get_by_name("source").send_event(gst.Event.new_eos())

    def close(self) -> None:
        self._pipeline = None

    def _unavailable(self, uri: Uri, message: str) -> str:
        """What GStreamer words as an error of its data flow: a refusal, before the first frame."""
        if self._stamped:
            return f"camera.uri '{uri.text}': {message}"
        camera = self._camera
        self.error = self.error or uri.fail(
            f"the camera does not deliver {camera.width_px}x{camera.height_px} at"
            f" {camera.rate_hz:g} Hz (camera.width_px, height_px, rate_hz): {message}"
        )
        return str(self.error)
