"""The payload's program as a process of its own, which a fault may befall."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

LIMIT_S = 30.0
STOP_S = 5.0
_I2C = Path(__file__).parents[1] / "i2c"
_COUNTS = re.compile(r"(\d+) (captured|gated|sent|discarded)")


def free_port(kind: socket.SocketKind) -> int:
    """A port on which nobody listens now."""
    with socket.socket(socket.AF_INET, kind) as tried:
        tried.bind(("127.0.0.1", 0))
        return int(tried.getsockname()[1])


@dataclass(frozen=True)
class Ended:
    """How a process ended: exit status (negative: by that signal), what it wrote, and when."""

    status: int
    out: str
    err: str
    took_s: float

    @property
    def counts(self) -> dict[str, int]:
        """The frame counters of the last line that it printed; empty without one."""
        lines = [line for line in self.out.splitlines() if line.startswith("frames: ")]
        found = {name: int(number) for number, name in _COUNTS.findall(lines[-1])} if lines else {}
        return {"discarded": 0, **found} if found else {}

    def assert_in_order(self) -> None:
        """Exit status 0 in time, and no exception that nobody handled on any thread."""
        assert self.status == 0, f"status {self.status}: {self.err}"
        self.assert_no_accident()
        assert self.took_s < STOP_S, f"ended after {self.took_s:.1f} s"

    def assert_no_accident(self) -> None:
        """No traceback, no panic of a native thread, no GLib complaint."""
        for word in ("Traceback", "panicked", "CRITICAL", "Exception ignored"):
            assert word not in self.err + self.out, self.err


class PayloadProcess:
    """`python -m pi_firmware` with `--set` for each setting; a context manager that kills it.

    What it writes goes to files in `folder`, so that a talkative one never waits for a reader.
    Gauges on I2C are those of `tests/i2c/smbus2.py`.
    `env` is added to the environment (LD_PRELOAD of a shim), `prefix` goes before the command
    (`unshare`, `nice`).
    """

    def __init__(
        self,
        folder: Path,
        *settings: str,
        arguments: Sequence[str] = (),
        env: Mapping[str, str] | None = None,
        prefix: Sequence[str] = (),
    ) -> None:
        command = [*prefix, sys.executable, "-m", "pi_firmware", *arguments]
        for setting in settings:
            command += ["--set", setting]
        folder.mkdir(parents=True, exist_ok=True)
        self._out, self._err = folder / "stdout.txt", folder / "stderr.txt"
        with self._out.open("w") as out, self._err.open("w") as err:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                env={**os.environ, "PYTHONPATH": str(_I2C), **(env or {})},
            )

    def __enter__(self) -> PayloadProcess:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()

    @property
    def pid(self) -> int:
        """The process's id."""
        return self.process.pid

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self.process.poll() is None

    def written(self) -> str:
        """What it has written so far, on both."""
        return self._out.read_text() + self._err.read_text()

    def wait_written(self, text: str) -> None:
        """Waits until it has written this; fails when it ends without, or beyond any patience."""
        until_s = time.monotonic() + LIMIT_S
        while text not in self.written():
            assert self.running and time.monotonic() < until_s, self.written()
            time.sleep(0.02)

    def end(self, number: signal.Signals | None = signal.SIGTERM) -> Ended:
        """Sends a signal (None: it ends by itself) and waits for the end."""
        asked_s = time.monotonic()
        if number is not None:
            self.process.send_signal(number)
        status = self.process.wait(LIMIT_S)
        took_s = time.monotonic() - asked_s
        return Ended(status, self._out.read_text(), self._err.read_text(), took_s)
