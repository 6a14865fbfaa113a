"""What live cameras have in common: they deliver by themselves, stamped by the pipeline's clock."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from pi_firmware import clocks, gstreamer
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.base import Stamp
from pi_firmware.wire.errors import BlimpError


def caps(camera: CameraSettings, formats: str = "{I420,NV12}") -> str:
    """The pictures that are asked for; a device that has no such ones does not start."""
    rate = Fraction(camera.rate_hz).limit_denominator(1001)
    return (
        f"video/x-raw,format=(string){formats},width={camera.width_px},height={camera.height_px},"
        f"framerate={rate.numerator}/{rate.denominator}"
    )


class LiveSource:
    """A GStreamer source named `source` that stamps each frame with its time of capture."""

    def __init__(self, camera: CameraSettings, elements: str) -> None:
        self.rate_hz = camera.rate_hz
        self.dmabuf = False
        self.cut_reason = ""
        self.error: BlimpError | None = None
        self.exposure_s: float | None = None
        self.gain: float | None = None
        self._camera = camera
        self._elements = elements
        self._pipeline: Any = None

    def elements(self) -> str:
        return self._elements

    def attach(self, pipeline: Any) -> None:
        self._pipeline = pipeline

    def start(self) -> None:
        """Nothing to do: it delivers from the moment the pipeline plays."""

    def stamp(self, running_ns: int) -> Stamp:
        """Exposure and gain are told where the device confirmed fixed ones."""
        captured_ns = clocks.wall_at(self._pipeline, running_ns)
        return Stamp(captured_ns, captured_ns, self.exposure_s, self.gain)

    def explain(self, message: str) -> str:
        return message

    def stop(self) -> None:
        if self._pipeline is not None:
            gst = gstreamer.load()
            self._pipeline.get_by_name("source").send_event(gst.Event.new_eos())

    def close(self) -> None:
        self._pipeline = None

    def _unavailable(self, name: str, message: str) -> str:
        """The camera's refusal, which GStreamer words as an error of its data flow."""
        camera = self._camera
        return (
            f"{name} does not deliver {camera.width_px}x{camera.height_px} at"
            f" {camera.rate_hz:g} Hz (camera.width_px, height_px, rate_hz): {message}"
        )
