"""Cameras and what stands in for one, chosen by URI."""

from __future__ import annotations

from collections.abc import Callable

from pi_firmware import uri
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.base import Source, Stamp
from pi_firmware.sources.pattern import PatternSource
from pi_firmware.sources.replay import ReplaySource

__all__ = ["Source", "Stamp", "check", "open_source"]

WHAT = "camera.uri"
NOT_YET = ("libcamera", "v4l2")

_SOURCES: dict[str, Callable[[uri.Uri, CameraSettings], Source]] = {
    "replay": ReplaySource,
    "test": PatternSource,
}


def check(text: str) -> uri.Uri:
    """The parsed URI of a source that exists; raises `SourceError` with one line."""
    parsed = uri.parse(text, WHAT)
    available = ", ".join(f"{scheme}:" for scheme in _SOURCES)
    if parsed.scheme in NOT_YET:
        raise parsed.fail(f"{parsed.scheme}: is not available yet (available: {available})")
    if parsed.scheme not in _SOURCES:
        raise parsed.fail(f"unknown scheme (available: {available})")
    return parsed


def open_source(camera: CameraSettings) -> Source:
    """The source that `camera.uri` names; raises `BlimpError` with one line."""
    parsed = check(camera.uri)
    return _SOURCES[parsed.scheme](parsed, camera)
