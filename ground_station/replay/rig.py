"""Where a flight takes place: where the ground listens, what flies, and what lies between."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from ground_station.replay.firmware import FirmwareProcess
from ground_station.service.settings import TelemetrySettings, VideoSettings


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
    """What `replay` flies on; any part may be another's.

    `video` and `telemetry` are where the ground listens, as in `station.toml`; a port of 0 is any
    free one. `link` takes the ground's video port and gives the one that the payload sends to.
    `payload` takes the firmware's configuration, as its payload.toml has it, and a folder for its
    files; it may change what another machine needs differently: addresses, certificates, where the
    recording lies. `on_first_frame` is called when the first frame is there.
    """

    payload: Callable[[dict[str, Any], Path], AbstractContextManager[Running]]
    link: Callable[[int], AbstractContextManager[int]] = contextlib.nullcontext
    video: VideoSettings = field(default_factory=lambda: VideoSettings(port=0))
    telemetry: TelemetrySettings = field(
        default_factory=lambda: TelemetrySettings(listen=["tcp/127.0.0.1:0"])
    )
    payload_id: str = "replay"
    """The payload's name in telemetry; a card's certificate has one of its own."""
    start_timeout_s: float = 30.0
    """From the started firmware to its first frame; more where the processor is emulated."""
    on_first_frame: Callable[[], None] = lambda: None


LOOPBACK = Rig(FirmwareProcess)
"""The firmware as a process of this machine, with ports of its own."""
