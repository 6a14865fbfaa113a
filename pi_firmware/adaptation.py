"""Which bit rate and which IDR interval the link bears, by what the ground station saw of it."""

from __future__ import annotations

from pi_firmware.settings import EncoderSettings
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
        """A bit rate within the bounds."""
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
