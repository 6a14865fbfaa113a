"""The payload's firmware as a process of its own on this machine, started as a user would."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections import deque
from pathlib import Path
from typing import Any

import tomli_w

from ground_station.errors import GroundStationError


class FirmwareError(GroundStationError):
    """The firmware did not start, or ended with an error."""


class FirmwareProcess:
    """`python -m pi_firmware` with a configuration of ours; a context manager that ends it.

    Its standard error is kept (the last 200 lines) and written beside the configuration.
    """

    def __init__(self, config: dict[str, Any], folder: Path) -> None:
        self._config, self._folder = config, folder
        self._lines: deque[str] = deque(maxlen=200)
        self._process: subprocess.Popen[str] | None = None
        self._reader: threading.Thread | None = None

    def __enter__(self) -> FirmwareProcess:
        path = self._folder / "payload.toml"
        path.write_bytes(tomli_w.dumps(self._config).encode())
        self._process = subprocess.Popen(
            [sys.executable, "-m", "pi_firmware", "--config", str(path)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        )
        self._reader = threading.Thread(target=self._read, name="firmware-log", daemon=True)
        self._reader.start()
        return self

    def _read(self) -> None:
        assert self._process is not None and self._process.stderr is not None
        with (self._folder / "firmware.log").open("w") as log:
            for line in self._process.stderr:
                self._lines.append(line.rstrip())
                log.write(line)
                log.flush()

    def running(self) -> bool:
        """Whether the process is alive."""
        return self._process is not None and self._process.poll() is None

    def pid(self) -> int | None:
        """The process's id; None before its start."""
        return None if self._process is None else self._process.pid

    def check(self) -> None:
        """Raises `FirmwareError` with the firmware's own last line when it ended with an error."""
        status = None if self._process is None else self._process.poll()
        if status:
            if self._reader is not None:
                self._reader.join(timeout=2)
            said = next((line for line in reversed(self._lines) if line), "nothing")
            raise FirmwareError(f"the firmware ended with status {status}: {said}")

    def __exit__(self, *_: object) -> None:
        assert self._process is not None and self._reader is not None
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._reader.join(timeout=2)
