"""How a process of the service ends: in order when it is told to, and not later than it may."""

from __future__ import annotations

import os
import signal
import threading

LIMIT_S = 1.5


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
