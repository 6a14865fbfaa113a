"""`libcamera:`, the Pi's cameras and every other that libcamera has."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.live import LiveSource, Mark, caps, check_exposure, post_error, readout_s
from pi_firmware.uri import Uri

EXPOSURE_MODES = ("normal", "short", "long")
"""Profiles of libcamera's automatic exposure (AeExposureMode); it knows no other limits."""

_SETTLED_FRAMES = 30
_TOLERANCE = 0.1


@dataclass(frozen=True)
class Control:
    """One property of libcamerasrc for a configured value.

    `optional`: versions that have no such property need none.
    """

    config_key: str
    value: Any
    optional: bool = False


def controls(camera: CameraSettings, exposure_mode: str = "normal") -> dict[str, Control]:
    """libcamerasrc's properties for the configured controls.

    Up to libcamera 0.4 a fixed exposure or gain ends its automatic, and AeEnable that of both; from
    0.5 on each has a mode of its own, which says so. A lens moves only in manual focus, and its
    position is the inverse of the distance.
    """
    result: dict[str, Control] = {}
    if exposure_mode != "normal":
        result["ae-exposure-mode"] = Control("exposure_mode", exposure_mode)
    if camera.exposure_s > 0:
        key = "camera.exposure_s"
        result["exposure-time-mode"] = Control(key, "manual", optional=True)
        result["exposure-time"] = Control(key, round(camera.exposure_s * 1e6))
    if camera.gain > 0:
        key = "camera.gain"
        result["analogue-gain-mode"] = Control(key, "manual", optional=True)
        result["analogue-gain"] = Control(key, camera.gain)
    if camera.exposure_s > 0 and camera.gain > 0:
        result["ae-enable"] = Control("camera.exposure_s", False)
    if camera.white_balance != "auto":
        result["awb-mode"] = Control("camera.white_balance", camera.white_balance)
    if camera.focus_m > 0:
        result["af-mode"] = Control("camera.focus_m", "manual")
        result["lens-position"] = Control("camera.focus_m", 1.0 / camera.focus_m)
    return result


def agrees(asked: Any, got: Any) -> bool:
    """Whether a property's value is the one asked for; enumerations are compared by nickname."""
    if isinstance(asked, str):
        return bool(getattr(got, "value_nick", got) == asked)
    return math.isclose(float(got), float(asked), rel_tol=1e-5)


class LibcameraSource(LiveSource):
    """`libcamera:`, or `libcamera:NAME` with a camera's name as `cam --list` shows it.

    Each buffer's timestamp is the sensor's. libcamera's SensorTimestamp is said to be the start of
    the first row's exposure; its drivers take the time at which the frame begins on the CSI-2 bus,
    the Pi's among them (raspberrypi/picamera2, issue 821): when the first row has been exposed.

    libcamerasrc (0.4) drops without a word what the camera does not have, and hands no metadata
    on, but its properties tell: once the camera is open, what was dropped is back at its default;
    while it delivers, those that a frame's metadata reports are the last completed frame's.
    """

    def __init__(self, uri: Uri, camera: CameraSettings) -> None:
        uri.only("readout_s", "exposure_mode")
        mode = uri.choice("exposure_mode", "normal", EXPOSURE_MODES)
        if mode != "normal" and camera.exposure_s > 0 and camera.gain > 0:
            raise uri.fail("exposure_mode has no effect with camera.exposure_s and camera.gain")
        check_exposure(uri, camera)
        gstreamer.require(("libcamerasrc",), f"camera.uri '{uri.text}'")
        super().__init__(
            camera,
            f"libcamerasrc name=source ! {caps(camera)}",
            mark=Mark.READOUT_START,
            readout_s=readout_s(uri),
        )
        self._uri = uri
        self._controls = controls(camera, mode)
        self._element: Any = None
        self._pad: Any = None
        self._probe = 0
        self.dmabuf = True

    def attach(self, pipeline: Any) -> None:
        """Sets what is configured; raises `SourceError` for what the camera does not have."""
        super().attach(pipeline)
        gst = gstreamer.load()
        self._element = pipeline.get_by_name("source")
        if self._uri.path:
            self._element.set_property("camera-name", self._uri.path)
        for name, control in self._controls.items():
            if self._element.find_property(name) is not None:
                gst.util_set_object_arg(self._element, name, str(control.value))
            elif not control.optional:
                raise self._uri.fail(f"{control.config_key}: libcamerasrc here has no '{name}'")
        if self._controls:
            self._verify_taken(gst)
        kind = gst.PadProbeType.EVENT_DOWNSTREAM
        self._pad = self._element.get_static_pad("src")
        self._probe = self._pad.add_probe(kind, self._on_event)

    def exposure_and_gain(self) -> tuple[float | None, float | None]:
        """What the camera's metadata says; None for both where it says nothing.

        After a while a fixed exposure or gain that the camera does not keep ends the source.
        """
        if self._element.find_property("exposure-time") is None:
            return None, None  # libcamerasrc before 0.4
        exposure_s = (self._element.get_property("exposure-time") or 0) / 1e6 or None
        gain = self._element.get_property("analogue-gain") or None
        if self._stamped == _SETTLED_FRAMES:
            self._verify_kept("exposure_s", self._camera.exposure_s, exposure_s)
            self._verify_kept("gain", self._camera.gain, gain)
        return exposure_s, gain

    def explain(self, message: str) -> str:
        if "Could not find" in message or "No camera" in message.capitalize():
            return f"camera.uri '{self._uri.text}': libcamera has no such camera"
        if "negotiat" in message or "data stream error" in message or "data flow" in message:
            return self._unavailable(self._uri, message)
        return message

    def close(self) -> None:
        if self._pad is not None:  # else the pipeline and this source would keep each other
            self._pad.remove_probe(self._probe)
            self._pad = None
        if self._element is not None:
            self._element.set_state(gstreamer.load().State.NULL)
        super().close()

    def _verify_taken(self, gst: Any) -> None:
        """Opens the camera, which leaves those properties as they are that it has."""
        if self._element.set_state(gst.State.READY) == gst.StateChangeReturn.FAILURE:
            return  # there is no such camera: said when it is to play
        for name, control in self._controls.items():
            if self._element.find_property(name) is None:
                continue
            if not agrees(control.value, self._element.get_property(name)):
                self._element.set_state(gst.State.NULL)
                raise self._uri.fail(f"{control.config_key}: the camera has no such control")

    def _verify_kept(self, name: str, asked: float, got: float | None) -> None:
        if asked > 0 and got is not None and abs(got - asked) > _TOLERANCE * asked:
            self._refuse(f"camera.{name}: the camera says {got:g} after it was set to {asked:g}")

    def _on_event(self, pad: Any, probe: Any) -> Any:
        """A camera that has not the rate takes another one, and libcamerasrc ends in silence."""
        gst = gstreamer.load()
        event = probe.get_event()
        if event.type == gst.EventType.CAPS:
            known, above, below = event.parse_caps().get_structure(0).get_fraction("framerate")
            offered_hz = above / below if known and below else 0.0
            asked_hz = self._camera.rate_hz
            if offered_hz > 0 and not math.isclose(offered_hz, asked_hz, rel_tol=1e-3):
                self._refuse(f"camera.rate_hz is {asked_hz:g}; the camera offers {offered_hz:g} Hz")
        return gst.PadProbeReturn.OK

    def _refuse(self, reason: str) -> None:
        """Ends the source, from a thread of the pipeline."""
        if self.error is None:
            self.error = self._uri.fail(reason)
            post_error(self._element, str(self.error))


SOURCE = LibcameraSource
