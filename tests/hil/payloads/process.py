"""`process`: this checkout's firmware as a process of this machine, as `blimp replay` flies it."""

from __future__ import annotations

import dataclasses
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from ground_station.replay.rig import LOOPBACK, Rig, Running


class ProcessPayload:
    """A context manager for a whole suite; `payload` is one flight's."""

    name = "process"
    link_host = "127.0.0.1"
    link_port = 0

    def __enter__(self) -> ProcessPayload:
        return self

    def __exit__(self, *_: object) -> None: ...

    def describe(self) -> str:
        """For the outcome."""
        return "process: the firmware of this checkout"

    def recording(self, path: Path) -> Path:
        """What it flies for a recording: the same."""
        return path

    def stand(self, settings: tuple[str, ...], link: Any) -> Rig:
        """For one flight; `settings` are in the replay's configuration already."""
        return dataclasses.replace(LOOPBACK, link=link, payload=self.payload)

    def payload(self, config: dict[str, Any], folder: Path) -> AbstractContextManager[Running]:
        """The firmware."""
        return LOOPBACK.payload(config, folder)
