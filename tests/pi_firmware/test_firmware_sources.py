"""Cameras: what is asked of a device is verified, and times of capture are true at the receiver."""

import errno
import subprocess
import sys

import numpy as np
import pytest
from receiving import Receiver
from schemes import clock

from pi_firmware.settings import CameraSettings
from pi_firmware.sources.schemes import v4l2

WITH_CLOCK = f"""
import sys
from pi_firmware.__main__ import main
from pi_firmware.sources import schemes
schemes.__path__.append({clock.__file__.rpartition("/")[0]!r})
sys.exit(main())
"""
"""The firmware with one more camera, which is one more file."""


@pytest.mark.parametrize("size", [(640, 480), (320, 240), (64, 64)])
def test_the_burnt_in_clock_is_read_back(size: tuple[int, int]) -> None:
    luma = np.full((size[1], size[0]), 100, np.uint8)
    for time_ns in (0, 1, 1_700_000_000_123_456_789, 2**64 - 1):
        clock.burn_in(luma, time_ns)
        assert clock.read_clock(luma) == time_ns


def test_capture_time_at_the_receiver_is_that_of_the_picture_within_a_millisecond() -> None:
    with Receiver(0, queue_frames=200) as receiver:
        process = subprocess.Popen(
            [
                sys.executable, "-c", WITH_CLOCK,
                "--set", "camera.uri=clock:?duration_s=2",
                "--set", f"link.port={receiver.port}",
                "--set", "telemetry.enabled=false",
                "--set", "encoder.bitrate_kbps=4000",
                "--set", "gate.enabled=false",
            ],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        frames = []
        while (frame := receiver.get(0.5)) or process.poll() is None:
            if frame:
                frames.append(frame)
        out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert [frame.sequence for frame in frames] == list(range(60)), out
    errors_ns = [frame.time_ns - clock.read_clock(frame.image) for frame in frames]
    # Whoever is not let run between the picture and its stamp is late by as much.
    assert sorted(map(abs, errors_ns))[53] < 1_000_000
    assert len({clock.read_clock(frame.image) for frame in frames}) == 60


class Device:
    """A V4L2 device's controls behind its ioctls: id to [low, high, step, value]."""

    def __init__(self, controls: dict[int, list[int]], sticks: bool = False) -> None:
        self.controls, self.sticks, self.asked = controls, sticks, []

    def ioctl(self, file: int, request: int, data: bytearray) -> None:
        control = int.from_bytes(data[:4], sys.byteorder)
        if control not in self.controls:
            raise OSError(errno.EINVAL, "Invalid argument")
        low, high, step, value = self.controls[control]
        if request == v4l2.VIDIOC_QUERYCTRL:
            name = b"control".ljust(32, b"\0")
            data[:] = v4l2._QUERYCTRL.pack(control, 1, name, low, high, step, value, 0)
        elif request == v4l2.VIDIOC_S_CTRL:
            wanted = int.from_bytes(data[4:8], sys.byteorder, signed=True)
            self.asked.append((control, wanted))
            if not self.sticks:
                self.controls[control][3] = wanted // step * step
        else:
            data[4:8] = self.controls[control][3].to_bytes(4, sys.byteorder, signed=True)


FIXED = CameraSettings(exposure_s=0.008, gain=20.0, white_balance="daylight")


def uvc() -> dict[int, list[int]]:
    return {
        0x009A0901: [0, 3, 1, 3], 0x009A0902: [3, 2047, 1, 250], 0x009A0903: [0, 1, 1, 1],
        0x00980913: [0, 255, 1, 0], 0x0098090C: [0, 1, 1, 1], 0x0098091A: [2000, 6500, 10, 4000],
        0x009A090A: [0, 250, 5, 0], 0x009A090C: [0, 1, 1, 1],
    }  # fmt: skip


def refusals(device: Device, camera: CameraSettings, focus: int | None = None) -> list[str]:
    control_requests = v4l2.control_requests(camera, focus)
    return [said for wish in control_requests if (said := v4l2.apply(wish, 0, device.ioctl))]


def test_what_the_configuration_fixes_is_set_in_the_device_and_confirmed() -> None:
    device = Device(uvc())
    assert refusals(device, FIXED, focus=30) == []
    assert device.asked == [
        (0x009A0903, 0), (0x009A0901, 1), (0x009A0902, 80), (0x00980913, 20),
        (0x0098090C, 0), (0x0098091A, 5500), (0x009A090C, 0), (0x009A090A, 30),
    ]  # fmt: skip


def test_a_camera_left_to_itself_is_asked_for_its_rate_only() -> None:
    device = Device(uvc())
    assert refusals(device, CameraSettings()) == []
    assert device.asked == [(0x009A0903, 0)]


def test_a_refusal_names_the_key_and_the_devices_range() -> None:
    (said,) = refusals(Device(uvc()), CameraSettings(exposure_s=0.5))
    assert said == "camera.exposure_s: the device takes 3 to 2047, not 5000"
    stuck = Device(uvc(), sticks=True)
    assert "camera.gain: the device says 0 after it was set to 20" in refusals(stuck, FIXED)
    bare = Device({})
    assert "camera.white_balance: the device has no such control" in refusals(bare, FIXED)
