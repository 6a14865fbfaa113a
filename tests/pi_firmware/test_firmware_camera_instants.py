"""Which instant of a frame a camera stamps, and that ours is the middle row's middle."""

import errno
import struct
from pathlib import Path

import pytest

from pi_firmware import gstreamer, uri
from pi_firmware.settings import CameraSettings
from pi_firmware.sources import live
from pi_firmware.sources.live import LiveSource, Mark, to_middle_ns
from pi_firmware.sources.schemes import v4l2

_SOE, _EOF = 0x00010000, 0
_MONOTONIC = 0x00002000


@pytest.mark.parametrize(
    ("mark", "expected_ms"),
    [
        # Rows 20 ms from first to last, each exposed for 8 ms.
        (Mark.EXPOSURE_START, 10 + 4),
        (Mark.READOUT_START, 10 - 4),
        (Mark.READOUT_END, -10 - 4),
        (Mark.MIDDLE, 0),
    ],
)
def test_every_mark_leads_to_the_middle_of_the_middle_row(mark: Mark, expected_ms: float) -> None:
    assert to_middle_ns(mark, 0.008, 0.020) == expected_ms * 1_000_000


def test_an_unknown_exposure_counts_as_none_and_a_global_shutter_has_no_readout() -> None:
    assert to_middle_ns(Mark.READOUT_START, None, 0.020) == 10_000_000
    assert to_middle_ns(Mark.EXPOSURE_START, 0.008, 0.0) == 4_000_000


def test_a_live_sources_stamp_is_brought_to_the_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "wall_at", lambda *_: 10**18)
    source = LiveSource(CameraSettings(), "", mark=Mark.READOUT_END, readout_s=0.016)
    stamp = source.stamp(0)
    assert stamp.time_ns == stamp.clock_ns == 10**18 - 8_000_000
    assert (stamp.exposure_s, stamp.gain) == (None, None)


class Buffers:
    """A V4L2 device's driver name and the flags of its buffers, behind its ioctls."""

    def __init__(self, driver: bytes, flags: int, *, busy: bool = False) -> None:
        self.driver, self.flags, self.busy, self.held = driver, flags, busy, 0

    def ioctl(self, file: int, request: int, data: bytearray) -> None:
        if request == v4l2.VIDIOC_QUERYCAP:
            data[: len(self.driver)] = self.driver
        elif request == v4l2.VIDIOC_REQBUFS:
            if self.busy:
                raise OSError(errno.EBUSY, "Device or resource busy")
            self.held = struct.unpack_from("=I", data)[0]
        else:
            assert request == v4l2.VIDIOC_QUERYBUF and self.held == 1
            struct.pack_into("=I", data, 12, self.flags)


@pytest.mark.parametrize(
    ("driver", "flags", "uvc_times", "expected"),
    [
        (b"vivid", _MONOTONIC | _SOE, None, Mark.EXPOSURE_START),
        (b"capture", _MONOTONIC | _EOF, None, Mark.READOUT_END),
        # USB cameras' driver claims the start of exposure whatever it stamps.
        (b"uvcvideo", _MONOTONIC | _SOE, "0", Mark.READOUT_START),
        (b"uvcvideo", _MONOTONIC | _SOE, None, Mark.READOUT_START),
        (b"uvcvideo", _MONOTONIC | _SOE, "1", Mark.EXPOSURE_START),
    ],
)
def test_a_v4l2_device_is_asked_what_its_times_mark(
    tmp_path: Path, driver: bytes, flags: int, uvc_times: str | None, expected: Mark
) -> None:
    parameter = tmp_path / "hwtimestamps"
    if uvc_times is not None:
        parameter.write_text(f"{uvc_times}\n")
    device = Buffers(driver, flags)
    assert v4l2.timestamp_mark(0, device.ioctl, str(parameter)) is expected
    assert device.held == 0


@pytest.mark.parametrize("colorimetry", ["2:4:16:1", "1:4:7:1"])
def test_a_v4l2_device_gives_progressive_pictures_of_one_colorimetry(
    monkeypatch: pytest.MonkeyPatch, colorimetry: str
) -> None:
    monkeypatch.setattr(v4l2.V4l2Source, "_set_up", lambda *_: Mark.MIDDLE)
    camera = CameraSettings(uri="v4l2:/dev/video0")
    elements = v4l2.V4l2Source(uri.parse(camera.uri, "camera.uri"), camera).elements()
    assert "interlace-mode=(string)progressive ! videoconvert" in elements
    offered = f"video/x-raw,format=YUY2,colorimetry=(string){colorimetry}"
    device = f"videotestsrc num-buffers=1 ! {offered} ! identity name=source"
    gst = gstreamer.load()
    text = elements.replace("v4l2src name=source", device) + " ! fakesink name=end"
    pipeline = gst.parse_launch(text)
    pipeline.set_state(gst.State.PLAYING)
    kinds = gst.MessageType.EOS | gst.MessageType.ERROR
    message = pipeline.get_bus().timed_pop_filtered(10 * gst.SECOND, kinds)
    told = pipeline.get_by_name("end").get_static_pad("sink").get_current_caps().to_string()
    pipeline.set_state(gst.State.NULL)
    assert message.type == gst.MessageType.EOS
    assert "interlace-mode=(string)progressive" in told and "colorimetry=(string)bt601" in told


def test_a_v4l2_device_that_does_not_tell_is_not_corrected() -> None:
    device = Buffers(b"vivid", _SOE, busy=True)
    assert v4l2.timestamp_mark(0, device.ioctl) is Mark.MIDDLE
