"""Battery gauges, chosen by URI."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from pi_firmware import uri
from pi_firmware.battery.fake import FakeGauge
from pi_firmware.wire.messages import Battery

WHAT = "battery.uri"
NOT_YET = ("i2c",)


class Gauge(Protocol):
    """Anything that can say how much charge is left."""

    def read(self, time_ns: int) -> Battery:
        """One reading, stamped with the payload's clock."""
        ...


_GAUGES: dict[str, Callable[[uri.Uri], Gauge]] = {"fake": FakeGauge}


def open_gauge(text: str) -> Gauge:
    """The gauge that a URI names; raises `SourceError` with one line."""
    parsed = uri.parse(text, WHAT)
    if parsed.scheme in NOT_YET:
        raise parsed.fail(f"{parsed.scheme}: is not available yet (available: {_available()})")
    if parsed.scheme not in _GAUGES:
        raise parsed.fail(f"unknown scheme (available: {_available()})")
    return _GAUGES[parsed.scheme](parsed)


def _available() -> str:
    return ", ".join(f"{scheme}:" for scheme in _GAUGES)
