"""Cameras and what stands in for one, chosen by URI: a file each in `schemes`."""

from __future__ import annotations

import importlib
import pkgutil

from pi_firmware import uri
from pi_firmware.settings import CameraSettings
from pi_firmware.sources import schemes
from pi_firmware.sources.base import Source

__all__ = ["Source", "check", "open_source"]

WHAT = "camera.uri"


def check(text: str) -> uri.Uri:
    """The parsed URI of a source that exists; raises `SourceError` with one line."""
    parsed = uri.parse(text, WHAT)
    known = [module.name for module in pkgutil.iter_modules(schemes.__path__)]
    if parsed.scheme not in known:
        available = ", ".join(f"{scheme}:" for scheme in known)
        raise parsed.fail(f"unknown scheme (available: {available})")
    return parsed


def open_source(camera: CameraSettings) -> Source:
    """The source that `camera.uri` names; raises `BlimpError` with one line."""
    parsed = check(camera.uri)
    # Imported where it is chosen: a payload that flies loads no reader of recordings.
    module = importlib.import_module(f"{schemes.__name__}.{parsed.scheme}")
    source: Source = module.SOURCE(parsed, camera)
    return source
