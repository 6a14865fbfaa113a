"""The suite's own impairing relay between payload and ground: one flight's link by its case."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from ground_station.replay.cases.case import Link
from ground_station.replay.cases.outcome import Outage

sys.path.append(str(Path(__file__).resolve().parents[2] / "faults"))

from impaired_link import ImpairedLink, Impairment, LinkCounts

_SHARED = [field.name for field in dataclasses.fields(Impairment)]


class ProxyLink:
    """Relays the video through `ImpairedLink`; `Rig.link`'s form: a port in, a port out.

    `host` and `port` are where the payload sends to (0: a free one).
    """

    kind = "proxy"

    def __init__(self, link: Link, host: str = "127.0.0.1", port: int = 0) -> None:
        self._link, self._host, self._port = link, host, port
        self._impaired: ImpairedLink | None = None

    @contextlib.contextmanager
    def __call__(self, receiver_port: int) -> Iterator[int]:
        link = self._link
        with ImpairedLink(
            receiver_port,
            Impairment(**{name: getattr(link, name) for name in _SHARED}),
            seed=link.seed,
            host=self._host,
            port=self._port,
            outages=[(at_s, for_s) for at_s, for_s in link.outages],
        ) as impaired:
            self._impaired = impaired
            yield impaired.port

    def injected(self) -> str:
        """What it was told to do, in one line."""
        return told(self._link)

    def counts(self) -> dict[str, int]:
        """What became of the packets; empty before the flight."""
        return dataclasses.asdict(self._impaired.counts if self._impaired else LinkCounts())

    def outages(self) -> list[Outage]:
        """When nothing passed, on this machine's wall clock; only those that have begun."""
        if self._impaired is None or (first_s := self._impaired.first_s) is None:
            return []
        now_s = time.monotonic()
        first_ns = time.time_ns() - round(1e9 * (now_s - first_s))
        return [
            Outage(first_ns + round(1e9 * at_s), first_ns + round(1e9 * (at_s + for_s)))
            for at_s, for_s in self._link.outages
            if first_s + at_s < now_s
        ]


def told(link: Link) -> str:
    """A link's settings that differ from a clean one's, with the seed."""
    changed = [f"{name}={getattr(link, name)}" for name in link.changed()]
    return f"{link.kind}, seed {link.seed}: {', '.join(changed) or 'clean'}"
