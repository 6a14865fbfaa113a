"""What systemd is told: the sd_notify protocol, without a library.

One datagram of `NAME=value` lines to the socket that the service manager names (sd_notify(3),
sd_watchdog_enabled(3)).
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import MutableMapping

_SEND_LIMIT_S = 1.0  # systemd's queue is full only when it is busy; a flight does not wait for it
_LONGEST_STATUS = 500
_CONTROL = re.compile(r"[\x00-\x1f\x7f]+")
_FOREVER_USEC = 2**64 - 1


class Notifier:
    """Speaks to the service manager that `environment` names; without one it does nothing.

    Its variables are taken out of the environment: a child must not speak for this program.
    `watchdog_s` is how long it waits for `alive`, s; None: it does not watch this program. Nothing
    raises, and nothing waits longer than 1 s. Safe from any thread.
    """

    def __init__(self, environment: MutableMapping[str, str] = os.environ) -> None:
        name = environment.pop("NOTIFY_SOCKET", "")
        interval = environment.pop("WATCHDOG_USEC", "")
        process = environment.pop("WATCHDOG_PID", "")
        self.watchdog_s: float | None = None
        self._address: bytes | None = None
        self._socket: socket.socket | None = None
        if name[:1] not in ("/", "@") or len(name) == 1:
            return
        # '@' stands for the NUL of Linux's abstract names.
        self._address = b"\0" + os.fsencode(name[1:]) if name[0] == "@" else os.fsencode(name)
        try:
            kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC
            self._socket = socket.socket(socket.AF_UNIX, kind)
            self._socket.settimeout(_SEND_LIMIT_S)
        except OSError:
            return
        usec = int(interval) if re.fullmatch(r"[0-9]{1,20}", interval, re.ASCII) else 0
        if 0 < usec < _FOREVER_USEC and process in ("", str(os.getpid())):
            self.watchdog_s = usec / 1e6

    def ready(self) -> bool:
        """The program runs; False when it could not be said."""
        return self._send("READY=1")

    def status(self, text: str) -> bool:
        """One line for `systemctl status`; line breaks and other control characters go."""
        return self._send(f"STATUS={_CONTROL.sub(' ', text)[:_LONGEST_STATUS]}")

    def alive(self) -> bool:
        """Feeds the watchdog."""
        return self._send("WATCHDOG=1")

    def stopping(self) -> bool:
        """The program ends in order."""
        return self._send("STOPPING=1")

    def _send(self, message: str) -> bool:
        if self._socket is None or self._address is None:
            return False
        try:
            # By name each time: a connected socket would not outlive systemd's own restart.
            self._socket.sendto(message.encode(errors="replace"), self._address)
        except (OSError, ValueError):
            return False
        return True
