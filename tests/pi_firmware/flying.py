"""The payload's program as a process, with somebody who receives and somebody who is systemd."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from receiving import Receiver

from ground_station.stream.telemetry import PayloadState, TelemetryListener

LIMIT_S = 30.0
STALLING = Path(__file__).with_name("stalling_encoder.py")
ALL_FRAMES = "gate.enabled=false"


class Flying:
    """The program as a process, with somebody who receives and somebody who is systemd."""

    def __init__(self, stack: ExitStack, tmp_path: Path) -> None:
        self.folder = tmp_path
        self.receiver = stack.enter_context(Receiver(port=0))
        self.listener = stack.enter_context(TelemetryListener(["tcp/127.0.0.1:0"]))
        self.notify = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        self.notify.bind(str(tmp_path / "notify"))
        self.notify.setblocking(False)
        self.process: subprocess.Popen[str] | None = None
        stack.callback(self.kill)
        self.environment = {
            **os.environ,
            "NOTIFY_SOCKET": str(tmp_path / "notify"),
            "WATCHDOG_USEC": "8000000",
        }

    def start(self, *settings: str, stall: tuple[int, int] | None = None) -> None:
        program = ["-m", "pi_firmware"]
        if stall is not None:
            program = [str(STALLING), *map(str, stall)]
        endpoints = json.dumps(self.listener.endpoints)
        given = [f"link.port={self.receiver.port}", f"telemetry.connect={endpoints}", *settings]
        self.process = subprocess.Popen(
            [sys.executable, *program, *(part for one in given for part in ("--set", one))],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=self.environment,
        )

    def state(self, condition: Callable[[PayloadState], bool]) -> PayloadState:
        found = self.listener.wait("blimp-1", condition, LIMIT_S)
        assert found is not None
        return found

    def has(self, name: str) -> PayloadState:
        return self.state(lambda state: any(e.name == name for e in state.events))

    def said(self) -> list[str]:
        """What systemd was told since the last call."""
        lines = []
        while True:
            try:
                lines.append(self.notify.recv(4096).decode())
            except BlockingIOError:
                return lines

    def kill(self) -> None:
        """Ends what a test has left running."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def end(self, status: int = 0) -> str:
        """Ends the program; the counters in its last line."""
        assert self.process is not None
        if status == 0 and self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        out, err = self.process.communicate(timeout=LIMIT_S)
        assert self.process.returncode == status, err
        assert "Traceback" not in err
        return err if status else out.splitlines()[-1]


def numbers(counters: str) -> dict[str, int]:
    return {name: int(n) for n, name in re.findall(r"(\d+) (captured|gated|sent|disc)", counters)}
