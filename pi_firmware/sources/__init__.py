"""Cameras and what stands in for one, chosen by URI."""

from __future__ import annotations

from collections.abc import Callable

from pi_firmware import uri
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.base import Source, Stamp

__all__ = ["Source", "Stamp", "check", "open_source"]

WHAT = "camera.uri"


# Each source is imported where it is chosen: a payload that flies loads no reader of recordings.


def _libcamera(parsed: uri.Uri, camera: CameraSettings) -> Source:
    from pi_firmware.sources.libcamera import LibcameraSource

    return LibcameraSource(parsed, camera)


def _v4l2(parsed: uri.Uri, camera: CameraSettings) -> Source:
    from pi_firmware.sources.v4l2 import V4l2Source

    return V4l2Source(parsed, camera)


def _replay(parsed: uri.Uri, camera: CameraSettings) -> Source:
    from pi_firmware.sources.replay import ReplaySource

    return ReplaySource(parsed, camera)


def _test(parsed: uri.Uri, camera: CameraSettings) -> Source:
    from pi_firmware.sources.clock import ClockSource
    from pi_firmware.sources.pattern import PatternSource

    is_clock = parsed.options.get("pattern") == "clock"
    return ClockSource(parsed, camera) if is_clock else PatternSource(parsed, camera)


_SOURCES: dict[str, Callable[[uri.Uri, CameraSettings], Source]] = {
    "libcamera": _libcamera,
    "v4l2": _v4l2,
    "replay": _replay,
    "test": _test,
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
