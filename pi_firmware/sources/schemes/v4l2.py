"""`v4l2:/dev/video0`, USB cameras; their controls are set and read back (Linux, videodev2.h)."""

from __future__ import annotations

import fcntl
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.live import LiveSource, Mark, caps, check_exposure, readout_s
from pi_firmware.uri import Uri

_CAPABILITY = struct.Struct("=16s88x")
_REQUEST_BUFFERS = struct.Struct("=IIIIB3x")
_BUFFER = struct.Struct("IIIIIlliiiiIILIIi0l")  # before 2038 on 32 bits; a kernel takes either
_QUERYCTRL = struct.Struct("=II32siiiiI8x")
_CONTROL = struct.Struct("=Ii")
VIDIOC_QUERYCAP = 0x80685600
VIDIOC_REQBUFS = 0xC0145608
VIDIOC_QUERYBUF = 0xC0005609 | _BUFFER.size << 16
VIDIOC_QUERYCTRL = 0xC0445624
VIDIOC_G_CTRL = 0xC008561B
VIDIOC_S_CTRL = 0xC008561C

_AUTO_WHITE_BALANCE = 0x0098090C
_GAIN_AUTO = 0x00980912
_GAIN = 0x00980913
_WHITE_BALANCE_K = 0x0098091A
_EXPOSURE_AUTO = 0x009A0901
_EXPOSURE_100US = 0x009A0902
_EXPOSURE_MAY_SLOW = 0x009A0903
_FOCUS = 0x009A090A
_FOCUS_AUTO = 0x009A090C
_MANUAL_EXPOSURE = 1

_VIDEO_CAPTURE = _MMAP = 1
_TIMESTAMP_SOURCE = 0x00070000
_START_OF_EXPOSURE = 0x00010000
_UVC_TIMES = "/sys/module/uvcvideo/parameters/hwtimestamps"

_LIGHT_K = {"incandescent": 2800, "fluorescent": 4200, "daylight": 5500, "cloudy": 6500}
"""Usual colour temperatures of the lights, as photographers' tables have them."""

# The Pi's encoder takes a list of colorimetries and no other; those of most USB cameras differ from
# this one in nothing that a picture's bytes would tell.
_COLOURS = ",colorimetry=(string)bt601"

Ioctl = Callable[[int, int, bytearray], object]


@dataclass(frozen=True)
class ControlRequest:
    """One control that the configuration asks for; an optional one may be missing."""

    config_key: str
    control: int
    value: int
    optional: bool = False


def control_requests(camera: CameraSettings, focus: int | None) -> list[ControlRequest]:
    """The controls in the order in which a device takes them: an automatic goes off first."""
    result = [ControlRequest("camera.rate_hz", _EXPOSURE_MAY_SLOW, 0, optional=True)]
    if camera.exposure_s > 0:
        ticks = max(1, round(camera.exposure_s * 1e4))
        result.append(ControlRequest("camera.exposure_s", _EXPOSURE_AUTO, _MANUAL_EXPOSURE))
        result.append(ControlRequest("camera.exposure_s", _EXPOSURE_100US, ticks))
    if camera.gain > 0:
        result.append(ControlRequest("camera.gain", _GAIN_AUTO, 0, optional=True))
        result.append(ControlRequest("camera.gain", _GAIN, round(camera.gain)))
    if camera.white_balance != "auto":
        result.append(ControlRequest("camera.white_balance", _AUTO_WHITE_BALANCE, 0))
        kelvin = _LIGHT_K[camera.white_balance]
        result.append(ControlRequest("camera.white_balance", _WHITE_BALANCE_K, kelvin))
    if focus is not None:
        result.append(ControlRequest("focus", _FOCUS_AUTO, 0, optional=True))
        result.append(ControlRequest("focus", _FOCUS, focus))
    return result


def apply(wish: ControlRequest, file: int, ioctl: Ioctl = fcntl.ioctl) -> str:
    """Sets one control and reads it back; why the device refuses, or nothing."""
    query = bytearray(_QUERYCTRL.pack(wish.control, 0, b"", 0, 0, 0, 0, 0))
    try:
        ioctl(file, VIDIOC_QUERYCTRL, query)
    except OSError:
        return "" if wish.optional else f"{wish.config_key}: the device has no such control"
    _, _, _, low, high, step, _, _ = _QUERYCTRL.unpack(query)
    if not low <= wish.value <= high:
        return f"{wish.config_key}: the device takes {low} to {high}, not {wish.value}"
    control = bytearray(_CONTROL.pack(wish.control, wish.value))
    try:
        ioctl(file, VIDIOC_S_CTRL, control)
        ioctl(file, VIDIOC_G_CTRL, control)
    except OSError as error:
        return f"{wish.config_key}: the device refuses {wish.value}: {error.strerror or error}"
    got = _CONTROL.unpack(control)[1]
    if abs(got - wish.value) > max(0, step - 1):
        return f"{wish.config_key}: the device says {got} after it was set to {wish.value}"
    return ""


def timestamp_mark(file: int, ioctl: Ioctl = fcntl.ioctl, uvc_times: str = _UVC_TIMES) -> Mark:
    """Which instant of a frame the driver's timestamps mark; `MIDDLE` when it does not tell.

    A buffer's flags say so; one is asked for and given back. The driver of USB cameras claims the
    start of exposure, but unless its parameter `hwtimestamps` is set it takes the time at which a
    frame's first packet arrives.
    """
    capability = bytearray(_CAPABILITY.size)
    request = bytearray(_REQUEST_BUFFERS.pack(1, _VIDEO_CAPTURE, _MMAP, 0, 0))
    buffer = bytearray(_BUFFER.size)
    struct.pack_into("=II", buffer, 0, 0, _VIDEO_CAPTURE)
    try:
        ioctl(file, VIDIOC_QUERYCAP, capability)
        ioctl(file, VIDIOC_REQBUFS, request)
        try:
            ioctl(file, VIDIOC_QUERYBUF, buffer)
        finally:
            none = bytearray(_REQUEST_BUFFERS.pack(0, _VIDEO_CAPTURE, _MMAP, 0, 0))
            ioctl(file, VIDIOC_REQBUFS, none)
    except OSError:
        return Mark.MIDDLE
    flags = struct.unpack_from("=I", buffer, 12)[0]
    if flags & _TIMESTAMP_SOURCE != _START_OF_EXPOSURE:
        return Mark.READOUT_END
    driver = _CAPABILITY.unpack(capability)[0].rstrip(b"\0")
    if driver == b"uvcvideo" and not _is_set(uvc_times):
        return Mark.READOUT_START
    return Mark.EXPOSURE_START


def _is_set(parameter: str) -> bool:
    """Whether a kernel module's parameter is anything but off."""
    try:
        text = Path(parameter).read_text().strip()
    except OSError:
        return False
    return text not in ("", "0", "N")


class V4l2Source(LiveSource):
    """A V4L2 device; frames carry the driver's timestamps. Raises `SourceError` when it refuses.

    Which exposure an automatic has taken V4L2 does not tell frame by frame: then none is claimed.
    """

    def __init__(self, uri: Uri, camera: CameraSettings) -> None:
        uri.only("focus", "readout_s")
        if not uri.path.startswith("/dev/"):
            raise uri.fail("expected v4l2:/dev/videoN")
        if camera.focus_m > 0:
            raise uri.fail("camera.focus_m: V4L2 knows no metres; give focus=N in the URI")
        check_exposure(uri, camera)
        gstreamer.require(("v4l2src",), f"camera.uri '{uri.text}'")
        focus = int(uri.number("focus", -1, 0, 65_535)) if "focus" in uri.options else None
        rows_s = readout_s(uri)
        self._uri = uri
        mark = self._set_up(camera, focus)
        # Many USB cameras have YUY2 only; where the formats agree, nothing is converted.
        sized = caps(camera, "{I420,NV12,YUY2,UYVY}")
        super().__init__(
            camera,
            f"v4l2src name=source ! {sized},interlace-mode=(string)progressive "
            "! videoconvert n-threads=1 ! video/x-raw,format=(string){I420,NV12}" + _COLOURS,
            mark=mark,
            readout_s=rows_s,
        )

    def attach(self, pipeline: object) -> None:
        super().attach(pipeline)
        self._pipeline.get_by_name("source").set_property("device", self._uri.path)

    def exposure_and_gain(self) -> tuple[float | None, float | None]:
        """The fixed exposure and gain, which were read back when they were set."""
        return self._camera.exposure_s or None, self._camera.gain or None

    def explain(self, message: str) -> str:
        if "negotiat" in message or "data stream error" in message:
            return self._unavailable(self._uri, message)
        return message

    def _set_up(self, camera: CameraSettings, focus: int | None) -> Mark:
        """Sets the controls; returns what the device's timestamps mark."""
        try:
            file = os.open(self._uri.path, os.O_RDWR | os.O_NONBLOCK)
        except OSError as error:
            raise self._uri.fail(error.strerror or str(error)) from None
        try:
            for wish in control_requests(camera, focus):
                refusal = apply(wish, file)
                if refusal:
                    raise self._uri.fail(refusal)
            return timestamp_mark(file)
        finally:
            os.close(file)


SOURCE = V4l2Source
