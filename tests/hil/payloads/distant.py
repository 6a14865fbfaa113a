"""A flight on a machine at the other end of SSH: its firmware's words, its state, its end."""

from __future__ import annotations

import contextlib
import subprocess
import threading
from collections import deque
from pathlib import Path
from typing import Any

from payloads.target import SshError, parsed, reason

_END_S = 90.0
"""In which the board has undone all after the line's end."""


class Flight:
    """A firmware that flies on another machine; it ends with the line to it."""

    def __init__(self, command: list[str], program: bytes, folder: Path, host: str) -> None:
        self._host = host
        self._said: deque[str] = deque(maxlen=200)
        self._ended: dict[str, Any] | None = None
        self._changed = threading.Condition()
        self._started = False
        # Of its own session: Ctrl-C at the ground ends the flight by the line's end, in order.
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
        except OSError as error:
            raise SshError(f"ssh: {error.strerror or error}") from None
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(program)
            self._process.stdin.flush()
        self._errors: deque[bytes] = deque(maxlen=20)
        self._readers = [
            threading.Thread(target=self._read, args=(folder / "firmware.log",), daemon=True),
            threading.Thread(target=self._read_errors, daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, log: Path) -> None:
        assert self._process.stdout is not None
        with log.open("w") as file:
            for line in self._process.stdout:
                told = parsed(line)
                with self._changed:
                    if told is not None and "line" in told:
                        text = str(told["line"])
                        self._said.append(text)
                        self._started |= text.startswith("payload ")
                        file.write(text + "\n")
                        file.flush()
                    elif told is not None and "ended" in told:
                        self._ended = told
                    self._changed.notify_all()
        self._process.wait()
        with self._changed:
            self._changed.notify_all()

    def _read_errors(self) -> None:
        assert self._process.stderr is not None
        self._errors.extend(self._process.stderr)

    def wait_started(self, limit_s: float) -> None:
        """Waits until the firmware has loaded; raises `SshError` when it fails or takes longer."""
        with self._changed:
            self._changed.wait_for(lambda: self._started or not self.running(), limit_s)
        self.check()
        if not self._started:
            last = self._said[-1] if self._said else "it said nothing"
            raise SshError(f"{self._host}: the firmware did not start within {limit_s:g} s: {last}")

    @property
    def usage(self) -> dict[str, Any]:
        """What the board says of the whole flight once it has ended: `memory_bytes`, `cpu_ns`."""
        return {k: v for k, v in (self._ended or {}).items() if k in ("memory_bytes", "cpu_ns")}

    def running(self) -> bool:
        """Whether it may still send."""
        return self._ended is None and self._process.poll() is None

    def pid(self) -> int | None:
        """It is not on this machine."""
        return None

    def check(self) -> None:
        """Raises `SshError` when the firmware ended with an error, or the line broke."""
        if self._ended is not None:
            if status := self._ended["ended"]:
                said = next((line for line in reversed(self._said) if line), "nothing")
                raise SshError(
                    f"{self._host}: the firmware ended with status {status}: {said[:300]}"
                )
        elif (code := self._process.poll()) is not None:
            for reader in self._readers:
                reader.join(2)
            if self._ended is None:
                raise SshError(reason(self._host, code, b"".join(self._errors)))

    def end(self) -> None:
        """Ends the line and waits until the board has undone all; once more does nothing."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for reader in self._readers:
            reader.join(2)
