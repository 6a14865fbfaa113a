"""H.264 for the link, and which bit rate and IDR interval the link bears.

There are no B-frames, parameter sets come with every IDR, and the level fits the size.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings, EncoderSettings
from pi_firmware.wire.delay import StandingDelay
from pi_firmware.wire.errors import StreamError
from pi_firmware.wire.messages import LinkReport

_DROPPED_MOST = 0.10  # draft-ietf-rmcat-gcc-02, section 6: more is overflow, below 2 % is nothing
_DROPPED_LEAST = 0.02
_FACTOR = 0.85  # of what the link carried when it was full: its queue drains (section 5.5's beta)
_LESS = 0.95  # of the bit rate is asked for at most when it was too much
_AT_ONCE = 0.5  # of the bit rate, at least, is taken for carried at first
_DRAINS = 0.85  # of the queue must be left at most from one judgement to the next
_DRAIN = 0.5  # the most that is held back besides, for a queue of half a second and more
_SETTLE_S = 0.3
"""From a new bit rate to when it is judged, where the round trip is not longer."""
_LOSS_S = 1.0  # what `LinkReport.dropped` is of
_LOSSY_S = 2.0
"""Without a queue this much is lost for so long: of few packets a tenth is lost by chance, too."""
_RISE, _RISE_NEAR, _RISE_SLOPE = 0.20, 0.03, 0.5
"""Of the bit rate, a second: the second where the link was full, more by the third of how far the
bit rate is from there, as a share of it, and never more than the first."""
_FULL_FOR_S = 30.0  # then that says nothing any more
_USEFUL, _USEFUL_KBPS = 1.5, 50.0


class Adaptation:
    """Bit rate and IDR interval within the configured bounds; times are seconds of any one clock.

    Where the ground measures the link's queue: Google congestion control's delay-based half
    (draft-ietf-rmcat-gcc-02, section 5) with the queue itself in its trend's place. A queue above
    `max_queue_s`, or more than 10 % lost while others come, is over-use: 85 % of what came through,
    less while the queue drains. Otherwise it rises, by steps near the rate that was too much and by
    a share far from it; never far above what the encoder makes of it. Fewer losses without a queue
    are the radio's own and lower nothing, and where nothing comes at all, nothing is learned.

    Where an older ground does not: that draft's loss-based half (section 6). Below 2 % loss 5 %
    more, above 10 % less by half the loss, and 15 % less at a round trip above `max_round_trip_s`.

    IDR interval: the shortest at 5 % loss and more, the `longest` without loss, frames.
    """

    def __init__(self, encoder: EncoderSettings, longest: int | None = None) -> None:
        self._settings = encoder
        self._longest = encoder.gop_frames if longest is None else longest
        self.bitrate_kbps = float(encoder.bitrate_kbps)
        self.ceiling_kbps = encoder.bitrate_kbps
        self.gop_frames = self._longest
        self._heard_s: float | None = None
        self._full_kbps: float | None = None
        """What the link carried when it was last full."""
        self._lowered_s = float("-inf")
        self._drains_from_s: float | None = None
        """The queue when it was last judged; None: none is draining."""
        self._lossy_since_s: float | None = None

    def limited(self, kbps: float) -> float:
        settings = self._settings
        return max(settings.min_bitrate_kbps, min(self.ceiling_kbps, kbps))

    def report(self, report: LinkReport, now_s: float) -> None:
        """Takes a report that comes now; one with a number that cannot be changes nothing."""
        if not _is_sound(report):
            return
        since_s = 0.0 if self._heard_s is None else min(max(now_s - self._heard_s, 0.0), 1.0)
        self._heard_s = now_s
        self._set_interval(report.lost)
        if report.received_kbps is None or report.dropped is None:
            self._follow_losses(report.lost, report.round_trip_s or 0.0)
        elif report.queue_s is not None and report.received_kbps > 0.0:
            self._follow_queue(report, now_s, since_s)

    def _set_interval(self, lost: float) -> None:
        shortest = min(self._settings.min_gop_frames, self._longest)
        span = self._longest - shortest
        self.gop_frames = round(self._longest - min(1.0, lost / 0.05) * span)

    def _follow_losses(self, lost: float, round_trip_s: float) -> None:
        factor = 1.05 if lost < _DROPPED_LEAST else 1.0
        if lost > _DROPPED_MOST:
            factor = 1.0 - 0.5 * lost
        if round_trip_s > self._settings.max_round_trip_s:
            factor = min(factor, _FACTOR)
        self.bitrate_kbps = self.limited(self.bitrate_kbps * factor)

    def _follow_queue(self, report: LinkReport, now_s: float, since_s: float) -> None:
        came_kbps, queue_s = report.received_kbps or 0.0, report.queue_s or 0.0
        dropped, most_s = report.dropped or 0.0, self._settings.max_queue_s
        settle_s = max(_SETTLE_S, min(report.round_trip_s or 0.0, 1.0))
        has_settled = now_s - self._lowered_s >= settle_s
        is_lossy = self._is_lossy(dropped, queue_s, now_s)
        if self._full_kbps is not None and self._drains_from_s is not None:
            drains = queue_s < _DRAINS * self._drains_from_s or queue_s <= most_s
            if not drains and has_settled:
                self._lower(min(came_kbps, self._full_kbps), queue_s, now_s)
            elif queue_s <= most_s / 2 or (has_settled and self._drains_from_s <= most_s):
                self._drains_from_s = None
                self._stay_below(self._full_kbps, 0.0)
            else:
                if has_settled:
                    self._drains_from_s, self._lowered_s = queue_s, now_s
                self._stay_below(self._full_kbps, queue_s)
        elif (queue_s > most_s and has_settled) or is_lossy:
            # An encoder may make more than it was asked for: less is asked for in any case. When a
            # busy board stands still, little comes, which says nothing of the link: a queue that
            # stays is judged again soon.
            most_kbps = self.bitrate_kbps * _LESS / _FACTOR
            full_kbps = max(min(came_kbps, most_kbps), self.bitrate_kbps * _AT_ONCE)
            self._lower(full_kbps, queue_s, now_s)
        elif queue_s <= most_s / 2:
            self._raise(came_kbps, dropped, now_s, since_s)

    def _is_lossy(self, dropped: float, queue_s: float, now_s: float) -> bool:
        """Whether more is lost than a radio's own share: at once where there is a queue, too."""
        if dropped <= _DROPPED_MOST:
            self._lossy_since_s = None
            return False
        if self._lossy_since_s is None:
            self._lossy_since_s = now_s
        if now_s - self._lowered_s < _LOSS_S:  # it may be of before
            return False
        queues = queue_s > self._settings.max_queue_s / 2
        return queues or now_s - self._lossy_since_s >= _LOSSY_S

    def _lower(self, full_kbps: float, queue_s: float, now_s: float) -> None:
        self._full_kbps, self._lowered_s = full_kbps, now_s
        self._drains_from_s = queue_s if queue_s > self._settings.max_queue_s / 2 else None
        self._lossy_since_s = None
        self._stay_below(full_kbps, queue_s)

    def _stay_below(self, full_kbps: float, queue_s: float) -> None:
        """Below what the link carries, and the more so the longer its queue is."""
        self.bitrate_kbps = self.limited(_FACTOR * full_kbps * (1.0 - min(_DRAIN, queue_s)))

    def _raise(self, came_kbps: float, dropped: float, now_s: float, since_s: float) -> None:
        if now_s - self._lowered_s > _FULL_FOR_S:
            self._full_kbps = None
        kbps, full_kbps = self.bitrate_kbps, self._full_kbps
        rise = _RISE
        if full_kbps is not None:
            rise = min(rise, _RISE_NEAR + _RISE_SLOPE * abs(kbps / full_kbps - 1.0))
        if dropped > _DROPPED_LEAST:
            rise = _RISE_NEAR if full_kbps is None else 0.0
        useful_kbps = _USEFUL * came_kbps + _USEFUL_KBPS
        risen_kbps = min(kbps * (1.0 + rise * since_s), max(kbps, useful_kbps))
        self.bitrate_kbps = self.limited(risen_kbps)


def _is_sound(report: LinkReport) -> bool:
    """Whether all numbers can be; comparisons with NaN are false."""
    measured = (report.round_trip_s, report.received_kbps, report.queue_s)
    shares = (report.lost, 0.0 if report.dropped is None else report.dropped)
    inf = float("inf")
    return all(0.0 <= share <= 1.0 for share in shares) and all(
        value is None or 0.0 <= value < inf for value in measured
    )


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
        self._since_idr = 0


def require(encoder: EncoderSettings) -> None:
    """Raises `StreamError` naming the encoder and its package when it is not installed."""
    gstreamer.require((encoder.name, "h264parse"), f"encoder.name '{encoder.name}'")
