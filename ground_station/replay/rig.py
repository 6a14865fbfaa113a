"""Where a flight takes place: where the ground listens, what flies, and what lies between."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import tomli_w

from ground_station.errors import GroundStationError
from ground_station.service.settings import TelemetrySettings, VideoSettings


class FirmwareError(GroundStationError):
    """The firmware did not start, or ended with an error."""


class FirmwareProcess:
    """`python -m pi_firmware` with a configuration of ours; a context manager that ends it.

    What it says is written beside the configuration. `prefix` are words before the command,
    of a program that becomes it.
    """

    def __init__(self, config: dict[str, Any], folder: Path, prefix: Sequence[str] = ()) -> None:
        self._log, path = folder / "firmware.log", folder / "payload.toml"
        path.write_bytes(tomli_w.dumps(config).encode())
        self._command = [*prefix, sys.executable, "-m", "pi_firmware", "--config", str(path)]

    def __enter__(self) -> FirmwareProcess:
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )
        return self

    def running(self) -> bool:
        """Whether the process is alive."""
        return self._process.poll() is None

    def pid(self) -> int | None:
        """The process's id."""
        return self._process.pid

    def check(self) -> None:
        """Raises `FirmwareError` with the firmware's own last line when it ended with an error."""
        if status := self._process.poll():
            lines = self._log.read_text(errors="replace").strip().splitlines()
            said = lines[-1] if lines else "nothing"
            raise FirmwareError(f"the firmware ended with status {status}: {said}")

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


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
