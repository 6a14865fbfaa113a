"""The encoder follows the link within its bounds, and its properties while it runs."""

import time
from dataclasses import replace

import pytest

from pi_firmware import encoder, gstreamer
from pi_firmware.encoder import Encoder
from pi_firmware.settings import CameraSettings, EncoderSettings
from pi_firmware.wire import annexb
from pi_firmware.wire.messages import LinkReport


class Element:
    """Where GStreamer's element would be; it notes the bit rates asked for."""

    def __init__(self) -> None:
        self.kbps: list[int] = []

    def set_property(self, name: str, value: int) -> None:
        self.kbps.append(value)


@pytest.mark.parametrize(("own_s", "kbps"), [(0.0, 1140), (0.12, 2000)])
def test_what_frames_wait_on_a_busy_board_is_no_queue_of_the_link(own_s: float, kbps: int) -> None:
    made = Encoder(Element(), EncoderSettings(), 30.0)
    for number in range(30):
        late_s = own_s if number else 0.0
        made.gave(time.monotonic_ns() - round((0.01 + late_s) * 1e9))
    seen = LinkReport(1, "main", 5600, lost=0.0, received_kbps=1500.0, queue_s=0.12, dropped=0.0)
    made.link_report(seen)
    assert made.bitrate_kbps == pytest.approx(kbps, rel=0.03)


def test_an_encoder_that_must_not_adapt_ignores_all() -> None:
    made = Encoder(Element(), EncoderSettings(adapt=False), 30.0)
    seen = LinkReport(1, "main", 5600, lost=0.9, received_kbps=100.0, queue_s=1.0, dropped=0.9)
    made.link_report(seen)
    assert made.bitrate_kbps == 2000


def test_no_frame_takes_more_than_a_sixth_of_a_seconds_bits() -> None:
    """An IDR of more would fill a narrow link's queue by itself."""
    gst = gstreamer.load()
    settings = EncoderSettings(bitrate_kbps=600)
    pipeline = gstreamer.launch(
        "videotestsrc pattern=zone-plate kx2=20 ky2=20 kt=1 num-buffers=60 "
        "! video/x-raw,format=I420,width=640,height=480,framerate=30/1 "
        f"! {encoder.description(settings, CameraSettings(), 30.0)} ! appsink name=units sync=false"
    )
    pipeline.set_state(gst.State.PLAYING)
    sink, sizes = pipeline.get_by_name("units"), []
    while (sample := sink.emit("try-pull-sample", 5 * gst.SECOND)) is not None:
        sizes.append(sample.get_buffer().get_size())
    pipeline.set_state(gst.State.NULL)
    assert len(sizes) == 60
    assert max(sizes) * 8 / 1000 < settings.bitrate_kbps / 6


def test_bit_rate_and_idr_are_those_asked_for_while_it_runs() -> None:
    gst = gstreamer.load()
    settings = EncoderSettings(bitrate_kbps=3000, gop_frames=30)
    camera = CameraSettings()
    pipeline = gstreamer.launch(
        "videotestsrc pattern=snow num-buffers=60 "
        "! video/x-raw,format=I420,width=640,height=480,framerate=30/1 "
        f"! {encoder.description(settings, camera, 30.0)} ! appsink name=units sync=false "
        "max-buffers=1"
    )
    controlled = Encoder(pipeline.get_by_name("encoder"), settings, 30.0)
    pipeline.set_state(gst.State.PLAYING)
    sink = pipeline.get_by_name("units")
    sizes, idrs = [], []
    while (sample := sink.emit("try-pull-sample", 5 * gst.SECOND)) is not None:
        buffer = sample.get_buffer()
        sizes.append(buffer.get_size())
        idrs.append(annexb.is_idr(buffer.extract_dup(0, buffer.get_size())))
        if len(sizes) == 10:
            controlled.force_idr()
        if len(sizes) == 40:
            assert controlled.set_bitrate(100) == 300
            assert controlled.bitrate_kbps == 300
    pipeline.set_state(gst.State.NULL)
    assert len(sizes) == 60
    assert idrs[0] and any(idrs[10:15])
    assert sum(sizes[50:60]) < 0.5 * sum(sizes[30:40])


def test_what_is_sent_again_is_part_of_the_bit_rate() -> None:
    element = Element()
    controlled = Encoder(element, EncoderSettings(bitrate_kbps=2000, min_bitrate_kbps=300), 30.0)
    report = LinkReport(1, "main", 5600, received_kbps=2000.0, queue_s=0.0, dropped=0.02)
    for again_kbps, asked_kbps in ((0.0, 2000), (150.0, 1850), (9e9, 300), (None, 2000)):
        controlled.link_report(replace(report, retransmitted_kbps=again_kbps))
        assert controlled.bitrate_kbps == asked_kbps
    assert element.kbps == [1850, 300, 2000]
    assert controlled.set_bitrate(1000) == 1000
    controlled.link_report(replace(report, retransmitted_kbps=-5.0))
    assert controlled.bitrate_kbps >= 1000


def test_corrections_are_part_of_the_bit_rate() -> None:
    controlled = Encoder(Element(), EncoderSettings(bitrate_kbps=2000, min_bitrate_kbps=300), 30.0)
    report = LinkReport(1, "main", 5600, received_kbps=2000.0, queue_s=0.0, dropped=0.02)
    for corrections, again_kbps, asked_kbps in (
        (0.0, 0.0, 2000), (0.25, 0.0, 1600), (0.25, 200.0, 1440), (0.0, 0.0, 2000),
    ):  # fmt: skip
        controlled.link_report(replace(report, retransmitted_kbps=again_kbps), corrections)
        assert controlled.bitrate_kbps == asked_kbps


def test_a_low_battery_holds_it_down_whatever_the_link_bears() -> None:
    element = Element()
    controlled = Encoder(element, EncoderSettings(bitrate_kbps=2000, min_bitrate_kbps=200), 30.0)
    controlled.set_bitrate(400)
    assert controlled.limit_bitrate(600) == 400  # a bad link already asked for less
    for _ in range(50):  # and a good one asks for more
        controlled.link_report(LinkReport(1, "main", 5600, round_trip_s=0.01))
    assert controlled.bitrate_kbps == element.kbps[-1] == 600
