"""The encoder follows the link within its bounds, and its properties while it runs."""

import math

import pytest

from pi_firmware import encoder, gstreamer
from pi_firmware.encoder import Adaptation, Encoder
from pi_firmware.settings import CameraSettings, EncoderSettings
from pi_firmware.wire import annexb

LIMITS = EncoderSettings(bitrate_kbps=2000, min_bitrate_kbps=300, gop_frames=15, min_gop_frames=10)


def test_a_good_link_keeps_the_configured_rate_and_the_longest_interval() -> None:
    adaptation = Adaptation(LIMITS)
    for _ in range(20):
        adaptation.report(0.0, 0.02)
    assert (adaptation.bitrate_kbps, adaptation.gop_frames) == (2000, 15)


def test_loss_lowers_the_rate_to_its_bound_and_a_good_link_raises_it_again() -> None:
    adaptation = Adaptation(LIMITS)
    adaptation.report(0.2, 0.02)
    assert adaptation.bitrate_kbps == pytest.approx(1800)
    adaptation.report(0.05, 0.02)
    assert adaptation.bitrate_kbps == pytest.approx(1800)
    for _ in range(60):
        adaptation.report(0.5, 0.02)
    assert adaptation.bitrate_kbps == 300
    adaptation.report(0.0, 0.02)
    assert adaptation.bitrate_kbps == pytest.approx(315)


@pytest.mark.parametrize(("lost", "frames"), [(0.0, 15), (0.02, 13), (0.05, 10), (0.9, 10)])
def test_the_more_is_lost_the_sooner_comes_an_idr(lost: float, frames: int) -> None:
    adaptation = Adaptation(LIMITS)
    adaptation.report(lost, 0.02)
    assert adaptation.gop_frames == frames


def test_a_long_round_trip_lowers_the_rate_without_any_loss() -> None:
    adaptation = Adaptation(LIMITS)
    adaptation.report(0.0, 0.5)
    assert adaptation.bitrate_kbps == pytest.approx(1700)


@pytest.mark.parametrize("report", [(math.nan, 0.1), (-0.1, 0.1), (1.5, 0.1), (0.1, math.nan)])
def test_a_report_that_cannot_be_changes_nothing(report: tuple[float, float]) -> None:
    adaptation = Adaptation(LIMITS)
    adaptation.report(*report)
    assert (adaptation.bitrate_kbps, adaptation.gop_frames) == (2000, 15)


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
