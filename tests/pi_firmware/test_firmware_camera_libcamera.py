"""`libcamera:`: what is asked of it is verified, and what it tells of a frame is passed on."""

import dataclasses
import os
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from receiving import Receiver

from pi_firmware import gstreamer, uri
from pi_firmware.settings import CameraSettings
from pi_firmware.sources import live, open_source
from pi_firmware.sources.schemes import libcamera
from pi_firmware.sources.schemes.libcamera import LibcameraSource
from pi_firmware.wire.errors import SourceError

ROOT = Path(__file__).parents[2]
VIRTUAL = ROOT / "out" / "virtual_camera"


def asked(camera: CameraSettings, mode: str = "normal") -> dict[str, Any]:
    return {name: control.value for name, control in libcamera.controls(camera, mode).items()}


def test_what_the_configuration_fixes_is_asked_of_libcamera() -> None:
    assert asked(CameraSettings(exposure_s=0.008, gain=2.0, focus_m=4.0)) == {
        "exposure-time-mode": "manual", "exposure-time": 8000,
        "analogue-gain-mode": "manual", "analogue-gain": 2.0, "ae-enable": False,
        "af-mode": "manual", "lens-position": 0.25,
    }  # fmt: skip
    assert asked(CameraSettings()) == {}
    assert asked(CameraSettings(white_balance="cloudy")) == {"awb-mode": "cloudy"}
    assert asked(CameraSettings(), "short") == {"ae-exposure-mode": "short"}
    assert "ae-enable" not in asked(CameraSettings(exposure_s=0.008))


def test_only_the_modes_of_newer_libcameras_may_be_missing() -> None:
    everything = CameraSettings(exposure_s=0.01, gain=2, white_balance="cloudy", focus_m=4)
    found = libcamera.controls(everything, "short").items()
    optional = {name for name, control in found if control.optional}
    assert optional == {"exposure-time-mode", "analogue-gain-mode"}


def test_a_value_that_came_back_otherwise_does_not_agree() -> None:
    assert libcamera.agrees(8000, 8000) and not libcamera.agrees(8000, 0)
    assert libcamera.agrees(1 / 3, float(np.float32(1 / 3)))
    assert libcamera.agrees("manual", SimpleNamespace(value_nick="manual"))
    assert not libcamera.agrees("manual", SimpleNamespace(value_nick="auto"))
    assert libcamera.agrees(False, False) and not libcamera.agrees(False, True)


class Element:
    """libcamerasrc as far as a frame's stamp needs it: properties, and a place for errors."""

    def __init__(self, **properties: float) -> None:
        self.properties = properties
        self.posted: list[str] = []

    def find_property(self, name: str) -> object | None:
        return self.properties.get(name.replace("-", "_"))

    def get_property(self, name: str) -> float:
        return self.properties[name.replace("-", "_")]


CAPTURED_NS = 1_700_000_000_000_000_000


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Opens a source without a libcamera: with an element of ours, stamping one fixed instant."""

    def build(element: Element, text: str = "libcamera:", **settings: float) -> LibcameraSource:
        monkeypatch.setattr(gstreamer, "require", lambda *_: None)
        monkeypatch.setattr(live, "wall_at", lambda *_: CAPTURED_NS)
        monkeypatch.setattr(libcamera, "post_error", lambda to, text: to.posted.append(text))
        camera = dataclasses.replace(CameraSettings(), **settings)
        source = LibcameraSource(uri.parse(text, "camera.uri"), camera)
        source._element = element
        return source

    return build


def test_a_frame_carries_the_exposure_and_gain_of_the_cameras_metadata(opened: Any) -> None:
    source = opened(Element(exposure_time=12_500, analogue_gain=3.5))
    stamp = source.stamp(0)
    assert (stamp.exposure_s, stamp.gain) == (0.0125, 3.5)
    silent = opened(Element(exposure_time=0, analogue_gain=0.0)).stamp(0)
    assert (silent.exposure_s, silent.gain) == (None, None)
    assert opened(Element()).stamp(0).exposure_s is None
    assert silent.time_ns == silent.clock_ns == CAPTURED_NS


def test_time_of_capture_is_the_middle_of_the_middle_rows_exposure(opened: Any) -> None:
    element = Element(exposure_time=12_000, analogue_gain=1.0)
    stamp = opened(element, "libcamera:?readout_s=0.020").stamp(0)
    # The first row has just been exposed: the middle one is 10 ms later, its middle 6 ms before.
    assert stamp.time_ns == stamp.clock_ns == CAPTURED_NS + 4_000_000
    element.properties["exposure_time"] = 30_000
    assert opened(element, "libcamera:?readout_s=0.020").stamp(0).time_ns == CAPTURED_NS - 5_000_000


def test_an_exposure_that_the_camera_does_not_keep_ends_it_in_one_line(opened: Any) -> None:
    element = Element(exposure_time=20_000, analogue_gain=1.0)  # asked for, and not yet limited
    source = opened(element, exposure_s=0.02)
    for _ in range(5):
        source.stamp(0)
    element.properties["exposure_time"] = 16_600
    for _ in range(40):
        source.stamp(0)
    said = "camera.exposure_s: the camera says 0.0166 after it was set to 0.02"
    assert str(source.error) == f"camera.uri 'libcamera:': {said}"
    assert element.posted == [str(source.error)]
    assert source.explain(element.posted[0]) == element.posted[0]


@pytest.mark.parametrize(("exposure_us", "gain"), [(19_980, 2.03), (20_100, 1.97), (0, 0.0)])
def test_a_sensors_own_steps_and_silence_end_nothing(
    opened: Any, exposure_us: int, gain: float
) -> None:
    element = Element(exposure_time=exposure_us, analogue_gain=gain)
    source = opened(element, exposure_s=0.02, gain=2.0)
    for _ in range(100):
        source.stamp(0)
    assert source.error is None and element.posted == []


def test_a_profile_without_an_automatic_is_refused(opened: Any) -> None:
    with pytest.raises(SourceError, match="exposure_mode has no effect"):
        opened(Element(), "libcamera:?exposure_mode=short", exposure_s=0.01, gain=1.0)


@pytest.mark.parametrize("text", ["libcamera:", "v4l2:/dev/video0"])
def test_an_exposure_longer_than_a_frame_is_refused(text: str) -> None:
    with pytest.raises(SourceError) as caught:
        open_source(CameraSettings(uri=text, exposure_s=0.05))
    said = "camera.exposure_s is 0.05; a frame lasts 0.03333 s at camera.rate_hz 30"
    assert str(caught.value) == f"camera.uri '{text}': {said}"


def fly_virtual_camera(port: int, *settings: str) -> subprocess.Popen[str]:
    """The payload in the Debian 13 whose libcamera has a virtual camera."""
    if not (VIRTUAL / ".stamp").exists():
        pytest.skip("out/virtual_camera is missing: run `make virtual-camera` (as root)")
    if os.geteuid() != 0:
        pytest.skip("the virtual camera runs in a root file system of its own: only as root")
    program = VIRTUAL / "root" / "opt" / "blimp" / "pi_firmware"
    shutil.rmtree(program, ignore_errors=True)
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "pi_firmware", program, ignore=ignore)
    command = [
        "chroot", str(VIRTUAL / "root"), "env", "-i", "PATH=/usr/bin:/bin", "PYTHONPATH=/opt/blimp",
        "LD_PRELOAD=/usr/local/lib/dma_buffers.so", "LIBCAMERA_LOG_LEVELS=*:ERROR",
        "/usr/bin/python3", "-m", "pi_firmware",
    ]  # fmt: skip
    for setting in (f"link.port={port}", "telemetry.enabled=false", *settings):
        command += ["--set", setting]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_libcamera_flies_with_its_sensors_times() -> None:
    with Receiver(0, queue_frames=200) as receiver:
        process = fly_virtual_camera(receiver.port, "camera.uri=libcamera:", "gate.enabled=false")
        frames = [frame for _ in range(60) if (frame := receiver.get(20.0))]
        process.terminate()
        out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert [frame.sequence for frame in frames] == list(range(60)), out
    assert frames[0].image.shape == (480, 640) and frames[0].image.std() > 10
    gaps_ms = np.diff([frame.time_ns for frame in frames]) / 1e6
    assert gaps_ms.min() > 0 and np.median(gaps_ms) == pytest.approx(1000 / 30, abs=1)
    assert all(frame.time_ns < frame.arrival_ns < frame.time_ns + 10**9 for frame in frames)
    assert frames[0].exposure_s is None  # this camera's metadata has none


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        (["camera.uri=libcamera:none"], "libcamera has no such camera"),
        (["camera.uri=libcamera:", "camera.width_px=320"], "does not deliver 320x480 at 30 Hz"),
        (["camera.uri=libcamera:", "camera.rate_hz=25"], "rate_hz is 25; the camera offers 30 Hz"),
        (["camera.uri=libcamera:", "camera.rate_hz=90"], "rate_hz is 90; the camera offers 60 Hz"),
        (["camera.uri=libcamera:", "camera.exposure_s=0.01"], "exposure_s: the camera has no such"),
        (["camera.uri=libcamera:", "camera.white_balance=cloudy"], "white_balance: the camera has"),
        (["camera.uri=libcamera:?exposure_mode=short"], "exposure_mode: the camera has no such"),
    ],
)
def test_what_a_libcamera_refuses_is_one_line(settings: list[str], named: str) -> None:
    process = fly_virtual_camera(9, *settings)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert err.count("\n") == 1 and named in err
