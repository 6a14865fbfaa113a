"""A link that loses packets."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from ground_station.arrays import Bools
from ground_station.experiments.disturbance import Disturbance
from pi_firmware.wire import annexb, config

PACKET_BYTES = 1200
"""Of video in an RTP packet, as the payload's packetizer makes them."""


@dataclass(frozen=True)
class Packets(Disturbance):
    """Packets are lost one by one, and nothing is sent again.

    A unit that misses a packet is useless, and so is all after it up to the next IDR, because each
    picture is predicted from the one before. A live link sends lost packets again and asks for an
    IDR, which a recording cannot: it loses far less.
    """

    packet_loss: float = config.key(
        0.0, "share of the video's packets lost; what needs them is not seen", low=0.0, high=1.0
    )

    def arrivals(self, units: Callable[[], Iterable[bytes]], seed: int) -> Bools | None:
        rng = np.random.default_rng(seed)
        whole = False
        result = []
        for unit in units():
            packets = -(-len(unit) // PACKET_BYTES)
            complete = bool((rng.random(packets) >= self.packet_loss).all())
            whole = complete and (whole or annexb.is_idr(unit))
            result.append(whole)
        return np.array(result, dtype=bool)


DISTURBANCE = Packets
