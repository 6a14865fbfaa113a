"""What the receiver counts."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Counters:
    """What came in and what became of it.

    Datagrams are `packets` of the stream, `retransmissions` or `corrections` of it, of
    `other_streams`, or `garbage`; where keys are asked for, also `refused` (not authentic) or
    `replayed` (authentic, but not for the first time).
    A packet that was sent came by itself (`packets` less `packets_late`, which came again or after
    they were given up), is one of `packets_recovered` (missing, asked for, and sent again in time),
    of `packets_corrected` (missing, and found from corrections in time), or one of `packets_lost`.
    `packets_asked` are those that were asked for, each once.
    Every access unit of which anything arrived is one of `decoded` (as it was sent), `damaged` (in
    parts, which are known), `withheld` (nothing of it can be shown before the next IDR), `failed`
    (the decoder refused it) or `unstamped` (without capture time).
    `idrs` are those of them that were an IDR, as far as what came tells.
    `overrun` packets were thrown away unread because those before them took too long to decode;
    they come to be lost.
    """

    packets: int = 0
    packets_lost: int = 0
    packets_late: int = 0
    packets_asked: int = 0
    packets_recovered: int = 0
    packets_corrected: int = 0
    retransmissions: int = 0
    corrections: int = 0
    garbage: int = 0
    other_streams: int = 0
    refused: int = 0
    replayed: int = 0
    malformed: int = 0
    access_units: int = 0
    idrs: int = 0
    decoded: int = 0
    damaged: int = 0
    withheld: int = 0
    failed: int = 0
    unstamped: int = 0
    overrun: int = 0

    @property
    def received(self) -> int:
        """Frames that can be shown, in whole or in parts."""
        return self.decoded + self.damaged
