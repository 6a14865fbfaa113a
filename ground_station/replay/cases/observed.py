"""A stand that is watched: what its payload says last, and what its process takes."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ground_station.replay.cases.resources import Side, Watch
from ground_station.replay.rig import Rig, Running
from ground_station.stream.telemetry import PayloadState, TelemetryListener
from pi_firmware.wire import messages


class Observed:
    """Watches one flight; a context manager around it. `stand` is what is to be flown on."""

    def __init__(self, stand: Rig) -> None:
        self._telemetry: TelemetryListener | None = None
        self._payload: Watch | None = None
        self._ground = Watch(os.getpid())
        self._made = stand
        self.stand = dataclasses.replace(stand, telemetry=self._listen, payload=self._fly)

    def __enter__(self) -> Observed:
        self._ground.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._ground.__exit__()

    @property
    def health(self) -> messages.Health | None:
        """The payload's last health message."""
        return state.health if (state := self._state()) is not None else None

    @property
    def refused(self) -> int | None:
        """Its messages that were not as agreed; None when it said nothing."""
        return state.refused if (state := self._state()) is not None else None

    @property
    def payload_side(self) -> Side | None:
        """The firmware's resources; None where it ran on another machine."""
        return None if self._payload is None else self._payload.side()

    @property
    def ground_side(self) -> Side:
        """This process's: receiver and localizer."""
        return self._ground.side()

    def _state(self) -> PayloadState | None:
        return None if self._telemetry is None else self._telemetry.state(self._made.payload_id)

    def _listen(self) -> TelemetryListener:
        self._telemetry = self._made.telemetry()
        return self._telemetry

    @contextlib.contextmanager
    def _fly(self, config: dict[str, Any], folder: Path) -> Iterator[Running]:
        with contextlib.ExitStack() as stack:
            flying = stack.enter_context(self._made.payload(config, folder))
            pid = flying.pid()
            if pid is not None:
                self._payload = stack.enter_context(Watch(pid))
            yield flying
