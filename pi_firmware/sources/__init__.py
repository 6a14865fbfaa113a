"""Cameras and what stands in for one, chosen by URI."""

from __future__ import annotations

from collections.abc import Callable

from pi_firmware import uri
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.base import Source, Stamp
from pi_firmware.sources.clock import ClockSource
from pi_firmware.sources.libcamera import LibcameraSource
from pi_firmware.sources.pattern import PatternSource
from pi_firmware.sources.replay import ReplaySource
from pi_firmware.sources.v4l2 import V4l2Source

__all__ = ["Source", "Stamp", "check", "open_source"]

WHAT = "camera.uri"


def _test_source(parsed: uri.Uri, camera: CameraSettings) -> Source:
    is_clock = parsed.options.get("pattern") == "clock"
    return ClockSource(parsed, camera) if is_clock else PatternSource(parsed, camera)


_SOURCES: dict[str, Callable[[uri.Uri, CameraSettings], Source]] = {
    "libcamera": LibcameraSource,
    "v4l2": V4l2Source,
    "replay": ReplaySource,
    "test": _test_source,
}


def check(text: str) -> uri.Uri:
    """The parsed URI of a source that exists; raises `SourceError` with one line."""
    parsed = uri.parse(text, WHAT)
    available = ", ".join(f"{scheme}:" for scheme in _SOURCES)
    if parsed.scheme not in _SOURCES:
        raise parsed.fail(f"unknown scheme (available: {available})")
    return parsed


def open_source(camera: CameraSettings) -> Source:
    """The source that `camera.uri` names; raises `BlimpError` with one line."""
    parsed = check(camera.uri)
    return _SOURCES[parsed.scheme](parsed, camera)
