"""How a process of the service ends: in order when it is told to, and not later than it may."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable

from ground_station.errors import GroundStationError
from pi_firmware.wire.errors import BlimpError

LIMIT_S = 1.5


class CannotGoOn(GroundStationError):
    """A process that cannot go on; a new one may."""

    restart = True


def ending(limit_s: float | None = LIMIT_S) -> threading.Event:
    """Is set by SIGTERM or SIGINT; the process has `limit_s` from then on, None: all it needs.

    Call it on the main thread, before modules that take long to load.
    """
    stop = threading.Event()

    def end(*_: object) -> None:
        if stop.is_set():
            return
        stop.set()
        if limit_s is not None:
            limit = threading.Timer(limit_s, os._exit, (0,))
            limit.daemon = True
            limit.start()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)
    return stop


def status_of(name: str, serve: Callable[..., int]) -> int:
    """A process's exit status: what `serve` gives for its arguments.

    A `BlimpError` is one line on standard error, and 2, or 3 where a new process may fix it.
    """
    try:
        return serve(*sys.argv[1:])
    except BlimpError as error:
        print(f"{name}: {error}", file=sys.stderr, flush=True)
        return 3 if error.restart else 2
