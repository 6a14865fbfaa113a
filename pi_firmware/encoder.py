"""H.264 for the link: no B-frames, parameter sets with every IDR, a level that fits the size."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any

from pi_firmware import gstreamer
from pi_firmware.adaptation import Adaptation
from pi_firmware.settings import CameraSettings, EncoderSettings
from pi_firmware.wire.delay import StandingDelay
from pi_firmware.wire.errors import StreamError
from pi_firmware.wire.messages import LinkReport

# H.264, table A-1: level, macroblocks a second, macroblocks a frame. 3.0 is the least used here.
_LEVELS = (
    ("3", 40_500, 1_620),
    ("3.1", 108_000, 3_600),
    ("3.2", 216_000, 5_120),
    ("4", 245_760, 8_192),
    ("4.2", 522_240, 8_704),
    ("5.1", 983_040, 36_864),
)

_VBV_MS = 300
"""x264 gives a frame no more than half of this time's bits: a larger IDR is a queue by itself.

With its own 600 ms an IDR takes 0.27 s of the link at 300 and 680 kbit/s, with this 0.155 s, for
0.3 to 0.5 dB of the mean PSNR (300 frames of the sample flight, IDRs 15 frames apart).
"""


def h264_level(width_px: int, height_px: int, rate_hz: float) -> str:
    """The lowest level from 3.0 on that fits size and rate (H.264, table A-1).

    Raises `StreamError` when none does.
    """
    frame = -(-width_px // 16) * -(-height_px // 16)
    for name, per_second, per_frame in _LEVELS:
        if frame <= per_frame and frame * rate_hz <= per_second:
            return name
    raise StreamError(f"{width_px}x{height_px} at {rate_hz:g} Hz fits no H.264 level up to 5.1")


def gop_frames(encoder: EncoderSettings, rate_hz: float) -> int:
    """Frames from IDR to IDR: as configured, but never more than a second's."""
    return max(1, min(encoder.gop_frames, int(rate_hz)))


def description(
    encoder: EncoderSettings, camera: CameraSettings, rate_hz: float, *, dmabuf: bool = False
) -> str:
    """The encoder's part of the pipeline, from raw pictures to whole access units in Annex B.

    `dmabuf`: the source hands out dmabufs, which the Pi's encoder then reads where they are.
    """
    level = h264_level(camera.width_px, camera.height_px, rate_hz)
    gop = gop_frames(encoder, rate_hz)
    caps = f"video/x-h264,stream-format=byte-stream,alignment=au,profile=main,level=(string){level}"
    if encoder.name == "x264enc":
        element = (
            "x264enc name=encoder tune=zerolatency speed-preset=veryfast bframes=0 threads=1 "
            f"byte-stream=true aud=false key-int-max={gop} bitrate={encoder.bitrate_kbps} "
            f"vbv-buf-capacity={_VBV_MS}"
        )
    else:
        # The Pi's driver defaults to level 1.0, whose frames it then cannot fit: the caps say more.
        element = (
            f"v4l2h264enc name=encoder {'output-io-mode=dmabuf-import ' if dmabuf else ''}"
            'extra-controls="controls,repeat_sequence_header=1,'
            f'h264_i_frame_period={gop},video_bitrate={encoder.bitrate_kbps * 1000}"'
        )
    return f"{element} ! {caps} ! h264parse config-interval=-1"


class Encoder:
    """The encoder's element in a running pipeline: bit rate and IDRs while it works.

    Thread-safe as far as its callers need: the camera's thread asks for IDRs and counts, the
    encoder's tells of frames that came, any other sets the bit rate.
    """

    def __init__(self, element: Any, encoder: EncoderSettings, rate_hz: float) -> None:
        self._gst = gstreamer.load()
        self._video = gstreamer.load_video()
        self._element = element
        self._settings = encoder
        self._longest = gop_frames(encoder, rate_hz)
        self._adaptation = Adaptation(encoder, self._longest)
        self._lateness, self._lock = StandingDelay(), threading.Lock()
        self._since_idr = 0
        self._beside_kbps = 0.0
        """What is sent again and corrections, beside what the encoder makes."""
        self.bitrate_kbps = encoder.bitrate_kbps
        """The bit rate last asked for."""

    def set_bitrate(self, kbps: int) -> int:
        """Has no more than this sent, within the configured bounds; returns what is asked for.

        That is less by what is sent beside.
        """
        self._adaptation.bitrate_kbps = self._adaptation.limited(kbps)
        own_kbps = self._adaptation.bitrate_kbps - self._beside_kbps
        limited = round(self._adaptation.limited(own_kbps))
        if limited != self.bitrate_kbps:
            self.bitrate_kbps = limited
            if self._settings.name == "x264enc":
                self._element.set_property("bitrate", limited)
            else:
                text = f"controls,video_bitrate={limited * 1000}"
                controls = self._gst.Structure.from_string(text)[0]
                self._element.set_property("extra-controls", controls)
        return limited

    def limit_bitrate(self, kbps: int) -> int:
        """Never more than this from now on, whatever the link bears; returns the one now set."""
        self._adaptation.ceiling_kbps = min(kbps, self._settings.bitrate_kbps)
        return self.set_bitrate(round(self._adaptation.bitrate_kbps))

    def link_report(self, report: LinkReport, corrections: float = 0.0) -> None:
        """Adapts to what the ground saw, unless `encoder.adapt` is false.

        `corrections` are sent beside the video, as a share of it.
        """
        if self._settings.adapt:
            self._adaptation.report(self._of_the_link(report), time.monotonic())
            again_kbps = report.retransmitted_kbps or 0.0
            own_kbps = (self._adaptation.bitrate_kbps - max(again_kbps, 0.0)) / (1.0 + corrections)
            self._beside_kbps = self._adaptation.bitrate_kbps - max(own_kbps, 0.0)
            self.set_bitrate(round(self._adaptation.bitrate_kbps))

    def _of_the_link(self, report: LinkReport) -> LinkReport:
        """The report without what frames waited on this board, where a busy one is late itself."""
        with self._lock:
            own_s = self._lateness.standing_s(time.monotonic_ns())
        if report.queue_s is None or not own_s:
            return report
        return replace(report, queue_s=report.queue_s - min(own_s, max(report.queue_s, 0.0)))

    def gave(self, clock_ns: int) -> None:
        """A frame of this instant on the monotonic clock came out."""
        now_ns = time.monotonic_ns()
        with self._lock:
            self._lateness.add(now_ns, now_ns - clock_ns)

    def force_idr(self) -> None:
        """Makes the next frame an IDR."""
        event = self._video.video_event_new_upstream_force_key_unit(
            self._gst.CLOCK_TIME_NONE, True, 0
        )
        self._element.get_static_pad("src").send_event(event)
        self._since_idr = 0

    def next_is_due(self) -> bool:
        """Counts a frame that goes in; whether losses want it to be an IDR.

        The encoder's own interval stays the longest one: x264 cannot change it while it runs.
        """
        self._since_idr += 1
        return self._since_idr > self._adaptation.gop_frames < self._longest

    def saw_idr(self) -> None:
        """An IDR came out."""
        self._since_idr = 0


def require(encoder: EncoderSettings) -> None:
    """Raises `StreamError` naming the encoder and its package when it is not installed."""
    gstreamer.require((encoder.name, "h264parse"), f"encoder.name '{encoder.name}'")
