"""Forward correction inside each frame (RFC 5109), as much as the losses that are reported need.

GStreamer's own encoder numbers its packets among the video's and gives each correction neighbours
to cover, of which a burst takes several. This one has a stream of its own and covers each packet
several times. While no losses are to be expected, Python sees no packet.
"""

from __future__ import annotations

import math
import secrets
import struct
import threading
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import combinations, cycle, islice
from typing import Any

from pi_firmware import gstreamer
from pi_firmware.settings import LinkSettings
from pi_firmware.wire import ulpfec, video
from pi_firmware.wire.messages import LinkReport

_RTP_BYTES = 12
_TOLERATED = 0.001
"""The share of frames that may fail: each costs those up to the next IDR, 8 on average."""
_LEAST_LOSS, _MOST_LOSS = 1e-4, 0.5
_MOST_BURST = 50.0
_MOST = 16
"""Corrections of one block: what they cover is chosen among thousands of sets."""
_FOLLOWS_S = 4.0
"""Time constant of the losses: few packets tell a second's, and those that are over come back."""
_TELLING = 10
"""So many missing packets tell whether asking for them again helps."""
_FADES = 0.9
"""A frame's weight among the newest, of the one's after it."""
_STEP = 1.25
"""Losses, rounded up, and bursts go by steps of this factor: few sizes have to be found."""


def correction_ssrc(ssrc: int) -> int:
    """The SSRC of the corrections: as random as the stream's own, and never that or 0."""
    return ssrc ^ 0x4000_0000 or 1


@lru_cache(maxsize=512)
def size(packets: int, loss: float, burst: float, most: int) -> int:
    """How many corrections, 0 to `most`, a frame of so many packets needs.

    `loss` is the share of packets lost, `burst` how many are lost in a row (Gilbert's model). More
    than there are corrections cannot be had back, and of just as many not all sets. 0 where even
    `most` would leave a third of the frames that fail.
    """
    fails = []
    for given, odds in enumerate(islice(_odds(loss, burst), packets, packets + most + 1)):
        sets = 0.0 if packets == 1 or given < 2 else 0.25 if given == 2 else 0.5
        fails.append(math.fsum(odds[given + 1 :]) + sets * odds[given])
        if fails[-1] <= _TOLERATED:
            return given
    return most if fails[-1] <= fails[0] / 3 else 0


def _odds(loss: float, burst: float) -> Iterator[list[float]]:
    """How likely it is that 0, 1, 2, … of no packet, of one, of two, … in a row are lost."""
    ends = 1.0 / max(burst, 1.0)
    begins = min(1.0, loss * ends / (1.0 - loss))
    # By the state of the next packet, which does not count yet.
    good, bad = [1.0 - loss], [loss]
    while True:
        yield [g + b for g, b in zip(good, bad, strict=True)]
        after_good, after_bad = [*good, 0.0], [0.0, *bad]
        steps = list(zip(after_good, after_bad, strict=True))
        good = [g * (1.0 - begins) + b * ends for g, b in steps]
        bad = [g * begins + b * (1.0 - ends) for g, b in steps]


@lru_cache(maxsize=512)
def layout(packets: int, corrections: int) -> tuple[tuple[int, ...], ...]:
    """Which packets each correction covers.

    Any two packets are covered differently, and where there are corrections enough by an odd number
    of at least three: then any three losses can be had back (Hsiao 1970).
    """
    first = 3 if corrections < 6 else 5
    order = (
        *range(first, corrections + 1, 2),
        *range(first - 2, 1, -2),
        *range(2, corrections + 1, 2),
        1,
    )
    sets = (rows for weight in order for rows in _spread(corrections, weight))
    covered: list[list[int]] = [[] for _ in range(corrections)]
    for place, rows in enumerate(islice(cycle(sets), packets)):
        for row in rows:
            covered[row].append(place)
    return tuple(tuple(places) for places in covered if places)


@lru_cache(maxsize=64)
def _spread(count: int, chosen: int) -> list[tuple[int, ...]]:
    """All choices, neighbours far from each other, so that each is as often among the first."""
    sets = list(combinations(range(count), chosen))
    step = next(
        step
        for step in range(round(0.618 * len(sets)) or 1, len(sets) + 1)
        if math.gcd(step, len(sets)) == 1 or len(sets) == 1
    )
    return [sets[place * step % len(sets)] for place in range(len(sets))]


def protect(frame: Sequence[bytes], corrections: int) -> Iterator[bytes]:
    """The payloads of so many corrections of a frame's RTP packets, which are 48 at most."""
    first, timestamp = struct.unpack_from(">xxHI", frame[0])
    values = [ulpfec.bits(packet[1], timestamp, packet[_RTP_BYTES:]) for packet in frame]
    for places in layout(len(frame), corrections) if corrections else ():
        value = 0
        for place in places:
            value ^= values[place]
        sequences = [(first + place) & 0xFFFF for place in places]
        size_bytes = max(len(frame[place]) for place in places) - _RTP_BYTES
        yield ulpfec.Correction(sequences, value, size_bytes).encode()


class Forecast:
    """The losses to be expected that nothing else fixes; times are seconds of any one clock.

    What the ground asks for again and gets is recovered: how much that is, its reports tell, also
    while corrections are there before.
    """

    def __init__(self, link: LinkSettings, *, sends_again: bool) -> None:
        self._assumed = link.assumed_loss
        self._left, self._told = 0.0 if sends_again else 1.0, 0
        self._loss = self._bursts = 0.0
        self._heard_s = -math.inf
        self._before: tuple[str, int, int] | None = None
        self.loss, self.burst = self._assumed, 1.0
        """The share of packets, 0 to 0.5, and how many of them are lost in a row."""

    def report(self, report: LinkReport, now_s: float) -> None:
        """Takes a report that comes now; one with a number that cannot be changes nothing."""
        dropped, burst = report.dropped or 0.0, report.burst or 1.0
        if not (report.corrects and 0.0 <= dropped <= 1.0 and 1.0 <= burst < math.inf):
            return
        since_s = max(0.0, now_s - self._heard_s)
        weight = -math.expm1(-since_s / _FOLLOWS_S)
        self._loss += weight * (dropped - self._loss)
        self._bursts += weight * (dropped / burst - self._bursts)
        self._heard_s = now_s
        answered, lost = self._since_last(report)
        if answered + lost > 0:
            self._told = min(self._told + answered + lost, _TELLING)
            weight = min(1.0, (answered + lost) / self._told)
            self._left += weight * (lost / (answered + lost) - self._left)
        self.loss = min(_MOST_LOSS, max(self._assumed, self._loss * self._left))
        if self._bursts:
            self.burst = min(self._loss / self._bursts, _MOST_BURST)

    def _since_last(self, report: LinkReport) -> tuple[int, int]:
        """Packets that came again as they were asked for, and those that were lost for good."""
        ground, answered, lost = self._before or (report.ground, 0, 0)
        since = report.answered - answered, report.packets_lost - lost
        self._before = report.ground, report.answered, report.packets_lost
        return since if ground == report.ground and min(since) >= 0 else (0, 0)


class Sender:
    """Makes the RTP packets that correct frames, as many as its `forecast` wants.

    They are of an SSRC and sequence of their own.
    """

    def __init__(self, link: LinkSettings, ssrc: int, *, sends_again: bool) -> None:
        self.ssrc = correction_ssrc(ssrc)
        self.forecast = Forecast(link, sends_again=sends_again)
        self._most = link.correction
        self._sequence = secrets.randbelow(0x8000)
        self._video_bytes = self._bytes = 0.0

    @property
    def wanted(self) -> bool:
        """Whether any frame needs corrections."""
        return self.forecast.loss > _LEAST_LOSS

    @property
    def share(self) -> float:
        """Of corrections beside the video that is sent, of late."""
        return self._bytes / self._video_bytes if self.wanted and self._video_bytes else 0.0

    def of(self, frame: Sequence[bytes]) -> Iterator[bytes]:
        """Those of a frame's RTP packets; blocks of a large frame are of one size."""
        blocks, sent = -(-len(frame) // ulpfec.MOST_PROTECTED), 0
        for block in range(blocks):
            part = frame[block * len(frame) // blocks : (block + 1) * len(frame) // blocks]
            for payload in protect(part, self._size(len(part))):
                self._sequence = (self._sequence + 1) & 0xFFFF
                head = struct.pack(">BBH", 0x80, video.CORRECTION_PAYLOAD_TYPE, self._sequence)
                sent += len(payload)
                yield head + part[0][4:8] + self.ssrc.to_bytes(4, "big") + payload
        self._video_bytes = _FADES * self._video_bytes + sum(map(len, frame))
        self._bytes = _FADES * self._bytes + sent

    def _size(self, packets: int) -> int:
        loss = max(self.forecast.loss, _LEAST_LOSS)  # a report may just have ended the losses
        loss = _STEP ** math.ceil(math.log(loss, _STEP))
        burst = _STEP ** round(math.log(self.forecast.burst, _STEP))
        most = min(_MOST, math.ceil(self._most * packets))
        return size(packets, min(loss, _MOST_LOSS), burst, most)


class ForwardCorrection:
    """Has a running pipeline send corrections behind each frame, while the reports want any.

    Only then do the payloader's packets leave room for them.
    """

    def __init__(self, pipeline: Any, sender: Sender) -> None:
        self._gst = gstreamer.load()
        self._payloader = pipeline.get_by_name("payloader")
        self._pad = self._payloader.get_static_pad("src")
        self.sender = sender
        self._frame: list[bytes] = []
        self._probe: int | None = None
        self._lock = threading.Lock()
        self._switch()

    def report(self, report: LinkReport, now_s: float) -> float:
        """Takes what the ground saw, on any thread; the share that corrections are of late."""
        with self._lock:
            self.sender.forecast.report(report, now_s)
            self._switch()
            return self.sender.share

    def _switch(self) -> None:
        wanted = self.sender.wanted
        if wanted == (self._probe is not None):
            return
        if self._probe is None:
            self._frame = []
            kinds = self._gst.PadProbeType.BUFFER | self._gst.PadProbeType.BUFFER_LIST
            self._probe = self._pad.add_probe(kinds, self._pass)
        else:
            self._pad.remove_probe(self._probe)
            self._probe = None
        room_bytes = ulpfec.OVERHEAD_BYTES if wanted else -ulpfec.OVERHEAD_BYTES
        self._payloader.set_property("mtu", self._payloader.get_property("mtu") - room_bytes)

    def _pass(self, pad: Any, info: Any) -> Any:
        """Lets packets through, and behind a frame's last one its corrections."""
        is_list = bool(info.type & self._gst.PadProbeType.BUFFER_LIST)
        packets = info.get_buffer_list() if is_list else info.get_buffer()
        buffers = [packets.get(k) for k in range(packets.length())] if is_list else [packets]
        came = [buffer.extract_dup(0, buffer.get_size()) for buffer in buffers]
        if self._frame and self._frame[0][4:8] != came[0][4:8]:  # its timestamp: no marker came
            self._frame = []
        self._frame += came
        if not came[-1][1] & 0x80:  # the marker of a frame's last packet
            return self._gst.PadProbeReturn.OK
        frame, self._frame = self._frame, []
        peer = pad.get_peer()
        (peer.chain_list if is_list else peer.chain)(packets)
        for correction in self.sender.of(frame):
            peer.chain(self._gst.Buffer.new_wrapped(correction))
        return self._gst.PadProbeReturn.DROP
