"""Where nothing is sent again or corrected, the localizer uses what losses left of the frames.

The sample flight through the payload's encoder settings, a link that loses packets by a seed, and
the ground's own assembly and localizer, without a clock: an IDR that is wished for comes two frames
later, and no other is wished for within 0.1 s.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from ground_station.geometry import poses
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.localization.extraction import extractor_for
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import load_preset
from ground_station.map import store
from ground_station.recording.flight import camera_of, trajectory_of
from ground_station.recording.h264 import Decoder
from ground_station.stream import rtp
from ground_station.stream.assembly import Assembly, ReceivedFrame
from ground_station.stream.counters import Counters
from pi_firmware.settings import EncoderSettings
from pi_firmware.wire import annexb, sei
from pi_firmware.wire.recording import RecordingReader

TESTS = Path(__file__).resolve().parents[1]
sys.path.append(str(TESTS / "stream"))
from numbered_flight import packets  # noqa: E402

SAMPLE = TESTS.parent / "maps/atrium"
FLIGHT = SAMPLE / "flight.mcap"
RATE_HZ, FRAMES, LOSS = 30, 200, 0.02
LATE, APART = 2, 3
"""Frames from a wish to its IDR, and from one wish to the next."""


def encoder() -> av.VideoCodecContext:
    """As `pi_firmware.encoder` sets x264."""
    usual = EncoderSettings()
    codec = av.CodecContext.create("libx264", "w")
    assert isinstance(codec, av.VideoCodecContext)
    codec.width, codec.height, codec.pix_fmt = 640, 480, "yuv420p"
    codec.time_base, codec.framerate = Fraction(1, RATE_HZ), Fraction(RATE_HZ)
    codec.thread_count, codec.bit_rate = 1, usual.bitrate_kbps * 1000
    codec.options = {
        "tune": "zerolatency", "preset": "veryfast", "profile": "main", "forced-idr": "1",
        "g": str(usual.gop_frames), "x264-params": f"vbv-maxrate={usual.bitrate_kbps}:"
        f"vbv-bufsize={usual.bitrate_kbps * 3 // 10}:bframes=0:sliced-threads=0",
    }  # fmt: skip
    return codec


@dataclass
class Link:
    """Loses packets, and tells when an IDR is wished for."""

    seed: int
    counters: Counters
    packets: int = 0

    def received(self) -> Iterator[ReceivedFrame]:
        """The frames that come of the flight's first ones."""
        draw, codec, decoder = random.Random(self.seed), encoder(), Decoder()
        assembly = Assembly(7, self.counters)
        wished, due, number = -APART, None, 0
        for index, sample in enumerate(RecordingReader(FLIGHT).video()):
            if index == FRAMES:
                return
            ((_, picture),) = decoder.decode(sample.data, index)
            picture = picture.reformat(format="yuv420p")
            forced = due is not None and index >= due
            picture.pts, picture.pict_type = index, int(forced)  # 1: an I picture
            due = None if forced else due
            info = sei.FrameInfo(index, sample.time_ns, sample.time_ns, 7.0, 10.0)
            (unit,) = codec.encode(picture)
            stamped = annexb.insert_before_slice(bytes(unit), sei.encode(info))
            short = self.counters.withheld + self.counters.damaged
            for datagram in packets([stamped], ssrc=7, first=number, mtu_bytes=1380):
                number += 1
                if draw.random() < LOSS:
                    continue
                timestamp = (3000 * index).to_bytes(4, "big")
                packet = rtp.parse(datagram[:4] + timestamp + datagram[8:], 0)
                assert packet is not None
                yield from assembly.push(replace(packet, arrival_ns=number * 1_000_000))
                yield from assembly.expire(number * 1_000_000 + 40_000_000)
            short = self.counters.withheld + self.counters.damaged - short
            if short and due is None and index - wished >= APART:
                wished, due = index, index + LATE


def test_most_frames_are_localized_past_losses_and_none_is_wrong() -> None:
    camera, truth, map_ = (
        camera_of(RecordingReader(FLIGHT)),
        trajectory_of(FLIGHT),
        store.load(SAMPLE),
    )
    settings = load_preset("default")
    settings = replace(settings, recovery=replace(settings.recovery, relocalize=True))
    assert camera is not None
    localizer = Localizer(map_, camera, extractor_for(map_.info, settings.features), settings)
    counters, found = Counters(), list[PoseEstimate]()
    damaged = 0
    for frame in Link(1, counters).received():
        estimate = localizer.process(
            frame.time_ns, frame.image, frame.sequence, None, frame.damaged
        )
        damaged += estimate.localized and frame.damaged is not None
        if estimate.localized:
            found.append(estimate)
    assert counters.packets_lost > 10 and damaged > 10
    assert len(found) >= 0.85 * FRAMES  # while whole frames are less
    assert counters.decoded < 0.85 * FRAMES
    for estimate in found:
        if estimate.state is State.TRACKING and estimate.wTc is not None:
            off = poses.log(poses.inverse(truth.at(estimate.time_ns)) @ estimate.wTc)
            assert np.linalg.norm(off[3:]) < 0.25 and np.rad2deg(np.linalg.norm(off[:3])) < 3
