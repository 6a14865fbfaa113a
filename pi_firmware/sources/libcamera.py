"""`libcamera:`, the Pi's cameras and every other that libcamera has."""

from __future__ import annotations

from typing import Any

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.live import LiveSource, caps
from pi_firmware.uri import Uri


def controls(camera: CameraSettings) -> dict[str, tuple[str, Any]]:
    """libcamerasrc's properties for the configured controls: name, config key, value.

    A fixed exposure or gain ends its automatic (libcamera, ExposureTime and AnalogueGain); a lens
    moves only in manual focus, and its position is the inverse of the distance. Whether the camera
    behind it follows, libcamerasrc does not tell: so no exposure is claimed in the frames.
    """
    result: dict[str, tuple[str, Any]] = {}
    if camera.exposure_s > 0:
        result["exposure-time"] = ("camera.exposure_s", round(camera.exposure_s * 1e6))
    if camera.gain > 0:
        result["analogue-gain"] = ("camera.gain", camera.gain)
    if camera.exposure_s > 0 and camera.gain > 0:
        result["ae-enable"] = ("camera.exposure_s", False)
    if camera.white_balance != "auto":
        result["awb-mode"] = ("camera.white_balance", camera.white_balance)
    if camera.focus_m > 0:
        result["af-mode"] = ("camera.focus_m", "manual")
        result["lens-position"] = ("camera.focus_m", 1.0 / camera.focus_m)
    return result


class LibcameraSource(LiveSource):
    """`libcamera:`, or `libcamera:NAME` with a camera's name as `cam --list` shows it.

    Each buffer's timestamp is the sensor's (SensorTimestamp: the first row's first exposure).
    """

    def __init__(self, uri: Uri, camera: CameraSettings) -> None:
        uri.only()
        gstreamer.require(("libcamerasrc",), f"camera.uri '{uri.text}'")
        super().__init__(camera, f"libcamerasrc name=source ! {caps(camera)}")
        self._uri = uri
        self.dmabuf = True

    def attach(self, pipeline: Any) -> None:
        """Sets what is configured; raises `SourceError` for what this libcamera does not know."""
        super().attach(pipeline)
        gst = gstreamer.load()
        element = pipeline.get_by_name("source")
        if self._uri.path:
            element.set_property("camera-name", self._uri.path)
        for name, (config_key, value) in controls(self._camera).items():
            known = element.find_property(name)
            if known is None:
                raise self._uri.fail(f"{config_key}: libcamerasrc here has no '{name}'")
            if isinstance(value, str):
                gst.util_set_object_arg(element, name, value)
            else:
                element.set_property(name, value)

    def explain(self, message: str) -> str:
        if "Could not find" in message or "No camera" in message.capitalize():
            return f"camera.uri '{self._uri.text}': libcamera has no such camera"
        if "negotiat" in message or "data stream error" in message or "data flow" in message:
            return self._unavailable(f"camera.uri '{self._uri.text}'", message)
        return message
