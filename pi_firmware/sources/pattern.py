"""`test:`, a moving test picture as a live camera would deliver it."""

from __future__ import annotations

import time
from fractions import Fraction
from typing import Any

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.base import Stamp
from pi_firmware.uri import Uri
from pi_firmware.wire.errors import BlimpError

_PATTERNS = ("zone-plate", "smpte", "ball", "black", "snow")


class PatternSource:
    """GStreamer's test picture in real time; capture time is the payload's clock."""

    def __init__(self, uri: Uri, camera: CameraSettings) -> None:
        uri.only("pattern", "duration_s")
        if uri.path:
            raise uri.fail(f"takes no path, but options, not {uri.path!r}")
        pattern = uri.choice("pattern", "zone-plate", _PATTERNS)
        duration_s = uri.number("duration_s", 0.0, 0.0, 86_400.0)
        gstreamer.require(("videotestsrc",), f"camera.uri '{uri.text}'")
        self.rate_hz = camera.rate_hz
        self.dmabuf = False
        self.cut_reason = ""
        self.error: BlimpError | None = None
        rate = Fraction(camera.rate_hz).limit_denominator(1001)
        frames = round(duration_s * camera.rate_hz) or -1
        self._elements = (
            f"videotestsrc name=source is-live=true pattern={pattern} num-buffers={frames} "
            "kx2=20 ky2=20 kt=1 ! video/x-raw,format=I420,"
            f"width={camera.width_px},height={camera.height_px},"
            f"framerate={rate.numerator}/{rate.denominator}"
        )
        self._pipeline: Any = None

    def elements(self) -> str:
        return self._elements

    def attach(self, pipeline: Any) -> None:
        self._pipeline = pipeline

    def start(self) -> None:
        """Nothing to do: it delivers from the moment the pipeline plays, as cameras do."""

    def stamp(self, running_ns: int) -> Stamp:
        pipeline = self._pipeline
        age_ns = pipeline.get_clock().get_time() - pipeline.get_base_time() - running_ns
        captured_ns = time.time_ns() - age_ns
        return Stamp(captured_ns, captured_ns)

    def explain(self, message: str) -> str:
        return message

    def stop(self) -> None:
        if self._pipeline is not None:
            gst = gstreamer.load()
            self._pipeline.get_by_name("source").send_event(gst.Event.new_eos())

    def close(self) -> None:
        self._pipeline = None
