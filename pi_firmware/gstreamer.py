"""Loads GStreamer once and says in one line what is not installed."""

from __future__ import annotations

from typing import Any

from pi_firmware.wire.errors import StreamError

_PACKAGES = {
    "x264enc": "gstreamer1.0-plugins-ugly",
    "avdec_h264": "gstreamer1.0-libav",
    "h264parse": "gstreamer1.0-plugins-bad",
    "openh264dec": "gstreamer1.0-plugins-bad",
    "srtpenc": "gstreamer1.0-plugins-bad",
    "appsrc": "gstreamer1.0-plugins-base",
    "videotestsrc": "gstreamer1.0-plugins-base",
    "videoconvert": "gstreamer1.0-plugins-base",
    "videoconvertscale": "gstreamer1.0-plugins-base",
    "libcamerasrc": "gstreamer1.0-libcamera",
}
_DEFAULT_PACKAGE = "gstreamer1.0-plugins-good"


def load() -> Any:
    """The initialised `Gst` module; raises `StreamError` when GStreamer is not installed."""
    try:
        import gi

        gi.require_version("Gst", "1.0")
        gi.require_version("GstVideo", "1.0")
        from gi.repository import Gst
    except (ImportError, ValueError) as error:
        raise StreamError(f"GStreamer's Python bindings are not installed: {error}") from None
    Gst.init(None)
    return Gst


def load_video() -> Any:
    """The `GstVideo` module, after `load`."""
    load()
    from gi.repository import GstVideo

    return GstVideo


def require(elements: tuple[str, ...], what: str) -> None:
    """Raises `StreamError` naming the first element that is missing, and its Debian package."""
    gst = load()
    for name in elements:
        if gst.ElementFactory.find(name) is None:
            package = _PACKAGES.get(name, _DEFAULT_PACKAGE)
            raise StreamError(
                f"{what}: GStreamer has no element '{name}' here (Debian package {package})"
            )


def first_of(elements: tuple[str, ...], what: str) -> str:
    """The first of these elements that is there; raises `StreamError` naming the first of all."""
    gst = load()
    for name in elements:
        if gst.ElementFactory.find(name) is not None:
            return name
    require(elements[:1], what)
    raise AssertionError("an element was installed meanwhile")


def failure(pipeline: Any) -> str | None:
    """What ended a pipeline, in GStreamer's words; None while it lives."""
    message = pipeline.get_bus().pop_filtered(load().MessageType.ERROR)
    return None if message is None else str(message.parse_error()[0].message)


def launch(description: str) -> Any:
    """A pipeline from its text; raises `StreamError` with one line."""
    gst = load()
    from gi.repository import GLib

    try:
        return gst.parse_launch(description)
    except GLib.Error as error:
        raise StreamError(f"video pipeline: {error.message}") from None
