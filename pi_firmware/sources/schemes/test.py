"""`test:`, a moving test picture as a live camera would deliver it; `gradient` never changes.

It misbehaves when asked: unplugged for a while, or silent without an error. Sources are closed and
opened again when they fail, so the times count from the first opening of the URI in this process,
on a clock that nobody sets.
"""

from __future__ import annotations

import math
import threading
import time
from typing import Any

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.live import LiveSource, caps, check_exposure, post_error
from pi_firmware.uri import Uri

PATTERNS = ("zone-plate", "smpte", "ball", "black", "snow", "gradient")
_FAULTS = ("gone_at_s", "gone_for_s", "hang_at_s", "hang_for_s")
GONE = "the camera is gone, as asked by gone_at_s"

Window = tuple[float, float]
_NEVER: Window = (math.inf, math.inf)

_first_opened_s: dict[str, float] = {}
_lock = threading.Lock()


class Faults:
    """The faults that a test camera's URI asks for; none when it names none.

    Raises `SourceError` with one line while the camera is to be gone: it cannot be opened then. One
    that was open before ends with an error and stays dead; one that hangs delivers again when the
    time is over, or at once when it is opened again.
    """

    def __init__(self, uri: Uri) -> None:
        self._gone = _window(uri, "gone")
        self._hangs = _window(uri, "hang")
        self._elapsed_s = 0.0
        if self._gone == self._hangs == _NEVER:
            return
        now_s = time.monotonic()
        with _lock:
            self._first_s = _first_opened_s.setdefault(uri.text, now_s)
        self._elapsed_s = now_s - self._first_s
        if self._gone[0] <= self._elapsed_s < self._gone[1]:
            raise uri.fail(GONE)

    def attach(self, pipeline: Any) -> None:
        """Has the element named `source` misbehave; costs a call for each frame, if any."""
        gone_s, _ = self._ahead(self._gone)
        hangs_s, delivers_s = self._ahead(self._hangs)
        if gone_s == hangs_s == math.inf:
            return
        source = pipeline.get_by_name("source").get_static_pad("src")
        result = gstreamer.load().PadProbeReturn
        kind = gstreamer.load().PadProbeType.BUFFER
        is_gone = False

        def on_frame(pad: Any, probe: Any) -> Any:
            nonlocal is_gone
            elapsed_s = time.monotonic() - self._first_s
            if not is_gone and elapsed_s >= gone_s:
                is_gone = True
                # Not an element of this closure: it and the pad would keep each other.
                post_error(pad.get_parent_element(), GONE)
            hangs = hangs_s <= elapsed_s < delivers_s
            return result.DROP if is_gone or hangs else result.OK

        source.add_probe(kind, on_frame)

    def frames(self, duration_s: float, rate_hz: float) -> int | None:
        """How many frames are left of so many seconds since the first opening; None: no end."""
        left_s = duration_s - self._elapsed_s
        return max(1, round(left_s * rate_hz)) if duration_s else None

    def _ahead(self, window: Window) -> Window:
        """The fault, unless it began before this opening: that has outlived it."""
        return window if self._elapsed_s < window[0] else _NEVER


def _window(uri: Uri, name: str) -> Window:
    """When the fault begins and ends, seconds after the first opening."""
    at, lasts = f"{name}_at_s", f"{name}_for_s"
    if at not in uri.options:
        if lasts in uri.options:
            raise uri.fail(f"{lasts} needs {at}")
        return _NEVER
    begin_s = uri.number(at, 0.0, 0.01, 86_400.0)
    return begin_s, begin_s + uri.number(lasts, 86_400.0, 0.01, 86_400.0)


class PatternSource(LiveSource):
    """GStreamer's test picture in real time; capture time is the payload's clock.

    It takes any fixed exposure and gain that fit a frame and says so, though nothing shows it. With
    faults, `duration_s` counts from the first opening, as they do.
    """

    def __init__(self, uri: Uri, camera: CameraSettings) -> None:
        uri.only("pattern", "duration_s", *_FAULTS)
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

    def exposure_and_gain(self) -> tuple[float | None, float | None]:
        return self._camera.exposure_s or None, self._camera.gain or None


SOURCE = PatternSource
