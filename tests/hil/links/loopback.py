"""No link between payload and ground: the port that the ground listens on."""

from __future__ import annotations

import contextlib
from contextlib import AbstractContextManager

from ground_station.replay.cases.outcome import Outage


class LoopbackLink:
    """`Rig.link`'s form; nothing is injected."""

    kind = "loopback"

    def __call__(self, receiver_port: int) -> AbstractContextManager[int]:
        return contextlib.nullcontext(receiver_port)

    def injected(self) -> str:
        """In one line."""
        return "loopback: nothing"

    def counts(self) -> dict[str, int]:
        """Nobody counts here."""
        return {}

    def outages(self) -> list[Outage]:
        """None are made."""
        return []
