"""`test:`, a moving test picture as a live camera would deliver it; `gradient` never changes."""

from __future__ import annotations

from typing import Any

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.faults import OPTIONS, Faults
from pi_firmware.sources.live import LiveSource, caps, check_exposure
from pi_firmware.uri import Uri

PATTERNS = ("zone-plate", "smpte", "ball", "black", "snow", "gradient")


class PatternSource(LiveSource):
    """GStreamer's test picture in real time; capture time is the payload's clock.

    It takes any fixed exposure and gain that fit a frame and says so, though nothing shows it. With
    faults, `duration_s` counts from the first opening, as they do.
    """

    def __init__(self, uri: Uri, camera: CameraSettings) -> None:
        uri.only("pattern", "duration_s", *OPTIONS)
        if uri.path:
            raise uri.fail(f"takes no path, but options, not {uri.path!r}")
        pattern = uri.choice("pattern", "zone-plate", PATTERNS)
        duration_s = uri.number("duration_s", 0.0, 0.0, 86_400.0)
        check_exposure(uri, camera)
        gstreamer.require(("videotestsrc",), f"camera.uri '{uri.text}'")
        self._faults = Faults(uri)
        frames = self._faults.frames(duration_s, camera.rate_hz) or -1
        super().__init__(
            camera,
            f"videotestsrc name=source is-live=true pattern={pattern} num-buffers={frames} "
            f"kx2=20 ky2=20 kt=4 ! {caps(camera, 'I420')}",
        )

    def attach(self, pipeline: Any) -> None:
        super().attach(pipeline)
        self._faults.attach(pipeline)

    def told(self) -> tuple[float | None, float | None]:
        return self._camera.exposure_s or None, self._camera.gain or None


SOURCE = PatternSource
