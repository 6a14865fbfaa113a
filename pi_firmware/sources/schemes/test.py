"""`test:`, drawn pictures: patterns of GStreamer's, or the clock that tells latencies."""

from __future__ import annotations

from pi_firmware.settings import CameraSettings
from pi_firmware.sources.base import Source
from pi_firmware.sources.clock import ClockSource
from pi_firmware.sources.pattern import PatternSource
from pi_firmware.uri import Uri


def SOURCE(parsed: Uri, camera: CameraSettings) -> Source:
    """The clock where it is asked for, else a pattern."""
    is_clock = parsed.options.get("pattern") == "clock"
    return ClockSource(parsed, camera) if is_clock else PatternSource(parsed, camera)
