"""As much of systemd as the payload's unit needs: Type=notify, Restart=always, a status line."""

from __future__ import annotations

import signal
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from deploy.board.releases.service import Seen, judge

_LOOK_S = 0.05
_END_S = 10.0
_RESTART_S = 0.2  # the unit waits longer, for nothing that is tested here
_CREDENTIALS = struct.Struct("3i")  # pid, uid, gid: unix(7)


class Manager:
    """Runs one program; a context manager. Has the methods of `service.Service`.

    What it shows is the text that `systemctl show` gives, judged by the card's own code.
    """

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], folder: Path
    ) -> None:
        self._command, self._environment = list(command), dict(environment)
        self._notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._notify.bind(str(folder / "notify"))
        self._notify.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self._notify.settimeout(_LOOK_S)
        self._environment["NOTIFY_SOCKET"] = str(folder / "notify")
        self._log = (folder / "journal").open("ab")
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._ready_us: int | None = None
        self._restarts = self._status = 0
        self._said, self._ended_s = "", 0.0
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Manager:
        self.restart()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        with self._lock:
            self._stop()
        self._notify.close()
        self._log.close()

    def restart(self) -> None:
        """`systemctl reset-failed` and `systemctl restart`."""
        with self._lock:
            self._stop()
            self._restarts = self._status = 0
            self._start()

    def watch(self) -> None:
        """The watcher is the test's."""

    def seen(self) -> Seen:
        """`systemctl show`, as the card reads it."""
        with self._lock:
            active = self._ready_us is not None
            shown = (
                f"ActiveState={'active' if active else 'activating'}\nNRestarts={self._restarts}\n"
                f"ActiveEnterTimestampMonotonic={self._ready_us or 0}\nStatusText={self._said}\n"
                f"ExecMainStatus={self._status}\n"
            )
        return judge(shown, time.monotonic())

    def _start(self) -> None:
        self._ready_us, self._said, self._ended_s = None, "", 0.0
        self._process = subprocess.Popen(
            self._command, env=self._environment, stdout=self._log, stderr=self._log
        )

    def _stop(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def _run(self) -> None:
        while not self._over.is_set():
            line, sender = self._hear()
            with self._lock:
                if self._process is None or sender != self._process.pid:
                    line = ""  # NotifyAccess=main: what one that has ended said late is of no other
                if line == "READY=1":
                    self._ready_us = time.monotonic_ns() // 1000
                elif line.startswith("STATUS="):
                    self._said = line.removeprefix("STATUS=")
                if self._process is not None and self._process.poll() is not None:
                    self._status, self._ready_us = self._process.returncode, None
                    self._ended_s = self._ended_s or time.monotonic()
                    if time.monotonic() - self._ended_s >= _RESTART_S:
                        self._restarts += 1
                        self._start()

    def _hear(self) -> tuple[str, int]:
        """The next line of a program and its process, or nothing for a moment."""
        try:
            line, control, _, _ = self._notify.recvmsg(4096, socket.CMSG_SPACE(_CREDENTIALS.size))
        except TimeoutError:
            return "", 0
        return line.decode(), _CREDENTIALS.unpack(control[0][2])[0]
