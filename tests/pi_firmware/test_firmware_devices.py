"""Devices are chosen by URI; what is unknown or not there yet is said in one line."""

import numpy as np
import pytest

from pi_firmware import battery, encoder, gstreamer, sources, uri
from pi_firmware.settings import CameraSettings, EncoderSettings
from pi_firmware.sources.schemes.replay import RateGrid
from pi_firmware.wire.errors import BlimpError, StreamError


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("webcam:0", "unknown scheme (available: libcamera:, replay:, test:, v4l2:)"),
        ("v4l2:video0", "expected v4l2:/dev/videoN"),
        ("v4l2:/dev/video77", "/dev/video77': No such file"),
        ("v4l2:/dev/null?focus=3", "focus: the device has no such control"),
        ("v4l2:/dev/video0?focus=-1", "focus is '-1'; allowed: 0 to 65535"),
        ("libcamera:?fps=30", "unknown option 'fps'"),
        ("flight.mcap", "expected scheme:path"),
        ("replay:", "expected replay:FLIGHT.mcap"),
        ("replay:/no/such.mcap", "/no/such.mcap: No such file"),
        ("replay:a.mcap?speed=0", "speed is '0'; allowed: 0.1 to 10"),
        ("replay:a.mcap?rate_hz=nan", "rate_hz is 'nan'; allowed: 1 to 120"),
        ("replay:a.mcap?pace=1", "pace is '1'; allowed: realtime, stepped"),
        ("replay:a.mcap?pace=stepped&speed=2", "speed is for pace=realtime only"),
        ("replay:a.mcap?max_hz=60", "max_hz is for pace=stepped only"),
        ("replay:a.mcap?pace=stepped&max_hz=0", "max_hz is '0'; allowed: 0.1 to 1000"),
        ("replay:a.mcap?step=1", "unknown option 'step'"),
        ("replay:a.mcap?loop=1&loop=0", "'loop' is given twice"),
        ("replay:a.mcap?loop", "not name=value"),
        ("test:?pattern=cat", "pattern is 'cat'; allowed: zone-plate"),
        ("test:/dev/video0", "takes no path"),
        ("test:?gone_for_s=2", "gone_for_s needs gone_at_s"),
        ("test:?hang_at_s=-1", "hang_at_s is '-1'; allowed: 0.01 to 86400"),
        ("v4l2:/dev/video0?readout_s=2", "readout_s is '2'; allowed: 0 to 1"),
        ("v4l2:/dev/video0?exposure_mode=short", "unknown option 'exposure_mode'"),
    ],
)
def test_a_camera_that_cannot_be_opened_is_named(text: str, named: str) -> None:
    with pytest.raises(BlimpError) as caught:
        sources.open_source(CameraSettings(uri=text))
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_options_are_split_from_the_path() -> None:
    parsed = uri.parse("replay:/a/b.mcap?rate_hz=5&loop=1", "camera.uri")
    assert (parsed.scheme, parsed.path) == ("replay", "/a/b.mcap")
    assert parsed.options == {"rate_hz": "5", "loop": "1"}


def test_the_fake_battery_empties_in_its_minutes() -> None:
    gauge = battery.open_gauge("fake:?minutes=10&percentage=0.8&capacity_mAh=500")
    readings = [gauge.read(10**18 + minute * 60 * 10**9) for minute in range(10)]
    shares = [reading.percentage for reading in readings]
    assert shares[0] == pytest.approx(0.8)
    assert shares[4] == pytest.approx(0.4)
    assert shares[8] == pytest.approx(0.0, abs=1e-9) and shares[9] == 0.0
    voltages = [reading.voltage for reading in readings[:9]]
    assert voltages == sorted(voltages, reverse=True)
    assert all(3.0 < voltage < 4.3 for voltage in voltages)
    assert readings[0].current == pytest.approx(-3.0)  # 0.5 Ah in ten minutes
    assert readings[9].current == 0.0


@pytest.mark.parametrize(
    ("size", "rate_hz", "level"),
    [
        ((640, 480), 30, "3"),  # 1200 macroblocks, 36,000 a second, of 1,620 and 40,500
        ((640, 480), 5, "3"),
        ((640, 480), 60, "3.1"),
        ((1280, 720), 30, "3.1"),
        ((1280, 720), 60, "3.2"),
        ((1920, 1080), 30, "4"),
        ((1920, 1080), 60, "4.2"),
        ((320, 240), 30, "3"),
    ],
)
def test_the_level_fits_size_and_rate(size: tuple[int, int], rate_hz: float, level: str) -> None:
    assert encoder.h264_level(*size, rate_hz) == level


def test_a_size_beyond_every_level_is_refused() -> None:
    with pytest.raises(StreamError, match=r"fits no H\.264 level"):
        encoder.h264_level(1920, 1088, 121)


def test_the_pis_encoder_is_told_its_level_and_repeats_its_parameter_sets() -> None:
    text = encoder.description(EncoderSettings(name="v4l2h264enc"), CameraSettings(), 30.0)
    assert text == (
        'v4l2h264enc name=encoder extra-controls="controls,repeat_sequence_header=1,'
        'h264_i_frame_period=15,video_bitrate=2000000" ! '
        "video/x-h264,stream-format=byte-stream,alignment=au,profile=main,level=(string)3 ! "
        "h264parse config-interval=-1"
    )


def test_the_pis_encoder_reads_a_cameras_dmabufs_where_they_are() -> None:
    settings = EncoderSettings(name="v4l2h264enc", bitrate_kbps=800)
    text = encoder.description(settings, CameraSettings(), 30.0, dmabuf=True)
    assert text == (
        'v4l2h264enc name=encoder output-io-mode=dmabuf-import extra-controls="controls,'
        'repeat_sequence_header=1,h264_i_frame_period=15,video_bitrate=800000" ! '
        "video/x-h264,stream-format=byte-stream,alignment=au,profile=main,level=(string)3 ! "
        "h264parse config-interval=-1"
    )


def test_x264_has_no_b_frames_and_an_idr_a_second_at_a_low_rate() -> None:
    text = encoder.description(EncoderSettings(), CameraSettings(), 5.0)
    assert "bframes=0" in text and "tune=zerolatency" in text
    assert "key-int-max=5 " in text and "level=(string)3 " in text


def test_an_encoder_that_is_not_installed_is_named_with_its_package() -> None:
    gst = gstreamer.load()
    if gst.ElementFactory.find("v4l2h264enc") is not None:
        pytest.skip("this machine has v4l2h264enc")
    with pytest.raises(StreamError) as caught:
        encoder.require(EncoderSettings(name="v4l2h264enc"))
    assert "'v4l2h264enc'" in str(caught.value)
    assert "gstreamer1.0-plugins-good" in str(caught.value)


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 15.0])
def test_a_slower_camera_takes_every_nth_frame_whatever_the_jitter(rate_hz: float) -> None:
    grid = RateGrid(rate_hz)
    jitter = [(index * 7919) % 3_000_000 - 1_500_000 for index in range(120)]
    times = [10**18 + index * 33_333_333 + jitter[index] for index in range(120)]
    taken = [index for index, time_ns in enumerate(times) if grid.takes(time_ns)]
    assert taken == list(range(0, 120, round(30 / rate_hz)))


def test_a_camera_as_fast_as_the_recording_takes_every_frame() -> None:
    for rate_hz in (30.0, 60.0):
        grid = RateGrid(rate_hz)
        assert all(grid.takes(10**18 + index * 33_366_700) for index in range(300))


def test_a_camera_at_two_thirds_of_the_rate_takes_two_of_three() -> None:
    grid = RateGrid(20.0)
    taken = [grid.takes(10**18 + index * 33_333_333) for index in range(90)]
    assert sum(taken) == 60


def test_a_gap_in_the_recording_is_a_gap_in_the_capture() -> None:
    grid = RateGrid(5.0)
    seconds = [*np.arange(0, 0.95, 1 / 30), *np.arange(3, 3.95, 1 / 30)]
    taken = [round(t, 1) for t in seconds if grid.takes(10**18 + int(t * 1e9))]
    assert taken == [0.0, 0.2, 0.4, 0.6, 0.8, 3.0, 3.2, 3.4, 3.6, 3.8]
