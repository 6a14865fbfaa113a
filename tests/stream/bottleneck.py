"""A flight over a narrow link without a program or a clock: encoder, link, both ends' judgement.

Frames have the sizes that x264 was seen to give (an IDR each 15 frames, of 5 to 7 P frames' size),
packets go through the impaired link's own bottleneck, and what comes is measured and reported by
the ground's own code to the payload's own. Everything is drawn with a seed.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from impaired_link import Bottleneck, Impairment

from ground_station.stream.arrivals import Arrivals
from ground_station.stream.feedback import PERIOD_S, Urgency
from ground_station.stream.rtp import Packet
from pi_firmware.encoder import Adaptation
from pi_firmware.settings import EncoderSettings
from pi_firmware.wire.messages import LinkReport

RATE_HZ = 30.0
GOP = 15
MTU = 1400
HEADER = 12
_P_SHARE = 1 / (GOP + 4.6)
"""Of a group's bits; an IDR has 5.6 P frames' size."""
_LOOK_S = 0.02

World = Callable[[float], Impairment]
"""What the link does, by the time since the start, s."""


@dataclass
class Flown:
    """Of each frame: when it was made, the bit rate asked for, the queue it found, its packets."""

    at_s: list[float] = field(default_factory=list)
    asked_kbps: list[float] = field(default_factory=list)
    queue_s: list[float] = field(default_factory=list)
    lost: list[float] = field(default_factory=list)
    sent: list[float] = field(default_factory=list)
    reports: list[tuple[float, LinkReport]] = field(default_factory=list)

    def between(self, from_s: float, to_s: float, what: list[float]) -> list[float]:
        """One of the lists, of the frames of this time."""
        return [value for at_s, value in zip(self.at_s, what, strict=True) if from_s <= at_s < to_s]


def fly(
    settings: EncoderSettings,
    world: World,
    duration_s: float,
    *,
    seed: int = 0,
    delay_s: float = 0.02,
    makes: float = 1.0,
) -> Flown:
    """Flies so long; the encoder makes this share of the bit rate that it was asked for."""
    draw = random.Random(seed)
    link, arrivals, urgency = Bottleneck(), Arrivals(), Urgency()
    adaptation = Adaptation(settings, GOP)
    flown = Flown()
    under_way: list[tuple[float, int, Packet]] = []
    told: deque[tuple[float, LinkReport]] = deque()
    sequence, due_s, looked_s = draw.randrange(1 << 16), PERIOD_S, 0.0
    start_ticks, lost_of_late = draw.randrange(1 << 32), deque([(0, 0)], maxlen=60)
    for number in range(round(duration_s * RATE_HZ)):
        at_s = number / RATE_HZ
        while looked_s < at_s:
            looked_s += _LOOK_S
            under_way.sort(key=lambda entry: entry[:2])
            while under_way and under_way[0][0] <= looked_s:
                arrivals.add(under_way.pop(0)[2])
            is_due = looked_s >= due_s
            due_s += PERIOD_S if is_due else 0.0
            now_ns = round(looked_s * 1e9)
            if is_due or (urgency.wants_look(looked_s) and urgency.is_due(arrivals.flow(now_ns))):
                report = _report(arrivals, now_ns, lost_of_late)
                urgency.reported(report, looked_s)
                flown.reports.append((looked_s, report))
                told.append((looked_s + delay_s, report))
            while told and told[0][0] <= looked_s:
                adaptation.report(told.popleft()[1], looked_s)
        does = world(at_s)
        kbps = adaptation.bitrate_kbps
        share = _P_SHARE * (draw.uniform(5.0, 6.2) if number % GOP == 0 else draw.uniform(0.7, 1.3))
        size = max(200, round(makes * kbps * 1000 / 8 * share * GOP / RATE_HZ))
        encoded_s = at_s + 0.004 + 0.004 * (number % GOP == 0) + draw.random() * 0.003
        flown.at_s.append(at_s)
        flown.asked_kbps.append(kbps)
        ticks = (start_ticks + round(at_s * 90_000)) & 0xFFFFFFFF
        lost = sent = 0
        found_s: float | None = None
        while size > 0:
            payload = bytes(min(size, MTU - HEADER))
            size -= len(payload)
            waits_s = link.wait_s(len(payload) + HEADER, encoded_s, does)
            sent += 1
            if found_s is None:
                own_s = (len(payload) + HEADER) * 8e-3 / does.rate_kbps if does.rate_kbps else 0.0
                found_s = does.queue_s if waits_s is None else max(0.0, waits_s - own_s)
            if waits_s is None or draw.random() < does.loss:
                lost += 1
            else:
                came_s = encoded_s + waits_s + does.delay_s + draw.random() * does.jitter_s
                packet = Packet(sequence, ticks, 7, size <= 0, payload, round(came_s * 1e9))
                under_way.append((came_s, sequence, packet))
            sequence = (sequence + 1) & 0xFFFF
        flown.queue_s.append(found_s or 0.0)
        flown.lost.append(lost)
        flown.sent.append(sent)
        lost_of_late.append((lost, sent))
    return flown


def _report(arrivals: Arrivals, now_ns: int, of_late: deque[tuple[int, int]]) -> LinkReport:
    flow = arrivals.flow(now_ns)
    sent = sum(sent for _, sent in of_late)
    return LinkReport(
        time_ns=now_ns,
        ground="main",
        video_port=5600,
        ssrc=7,
        lost=sum(lost for lost, _ in of_late) / sent if sent else 0.0,
        round_trip_s=0.04,
        received_kbps=flow.received_kbps if flow else None,
        queue_s=flow.queue_s if flow else None,
        dropped=flow.dropped if flow else None,
    )
