"""Where a flight takes place: who opens the ground's ends, what flies, and what lies between."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from ground_station.replay.firmware import FirmwareProcess
from ground_station.stream.receiver import Receiver
from ground_station.stream.telemetry import TelemetryListener


class Running(Protocol):
    """A payload that was started."""

    def check(self) -> None:
        """Raises a `BlimpError` with one line when it has failed."""
        ...

    def running(self) -> bool:
        """Whether it may still send."""
        ...

    def pid(self) -> int | None:
        """Its process on this machine; None when it runs elsewhere."""
        ...


@dataclass(frozen=True)
class Rig:
    """Makes a flight's parties, each a context manager that ends what it began.

    `receiver` takes how many frames may wait for the localizer. `link` takes the receiver's UDP
    port and gives the one that the payload sends to. `payload` takes the firmware's configuration,
    as its payload.toml has it, and a folder for its files; it may change what another machine needs
    differently: addresses, certificates, where the recording lies.
    """

    receiver: Callable[[int], Receiver]
    telemetry: Callable[[], TelemetryListener]
    link: Callable[[int], AbstractContextManager[int]]
    payload: Callable[[dict[str, Any], Path], AbstractContextManager[Running]]
    payload_id: str = "replay"
    """The payload's name in telemetry; a card's certificate has one of its own."""
    start_timeout_s: float = 30.0
    """From the started firmware to its first frame; more where the processor is emulated."""


LOOPBACK = Rig(
    receiver=lambda queue_frames: Receiver(port=0, queue_frames=queue_frames),
    telemetry=lambda: TelemetryListener(["tcp/127.0.0.1:0"]),
    link=contextlib.nullcontext,
    payload=FirmwareProcess,
)
"""The firmware as a process of this machine, with ports of its own."""
