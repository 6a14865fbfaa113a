"""What each process of the service needs: its end, few complaints, and heaps that do not grow."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import threading
import time
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


_SAID_EVERY_S = 60.0


class RateLimitedLog:
    """Says a text of each name at most once a minute, through `log(name, text)`."""

    def __init__(
        self, log: Callable[[str, str], object], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._log, self._clock = log, clock
        self._said_s: dict[str, float] = {}
        self._held: dict[str, int] = {}

    def __call__(self, name: str, text: str) -> bool:
        """Whether it was said and not only counted."""
        now_s = self._clock()
        last_s = self._said_s.get(name)
        if last_s is not None and now_s - last_s < _SAID_EVERY_S:
            self._held[name] = self._held.get(name, 0) + 1
            return False
        held = self._held.pop(name, 0)
        self._said_s[name] = now_s
        self._log(name, f"{text} ({held} more since the last line)" if held else text)
        return True


# How glibc keeps a process's memory (mallopt(3)), so that it does not grow by fragments; elsewhere
# than on glibc nothing happens.

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # glibc's malloc.h
_LARGE = 8 * 1024 * 1024


def few_heaps() -> None:
    """At most two heaps for all threads.

    Each payload brings threads of its own, glibc gives them up to eight heaps a core, and what one
    leaves in each of them adds up: 29 flights in an hour grew the intake by 8 MB.
    """
    _set_malloc(_ARENA_MAX, 2)


def large_blocks_apart() -> None:
    """Blocks of 8 MB and more lie beside the heap, and are given back when they are freed.

    Else glibc raises that limit to the largest block that was ever freed. A search of the whole map
    takes two of 14 MB, each time others: where what was left of the last ones had been used for
    something small, the heap grew by 17 MB, in two hours of flight twice. No frame has such blocks:
    localizing takes the same time, where a limit of 2 MB costs a twentieth more.
    """
    _set_malloc(_MMAP_THRESHOLD, _LARGE)
    _set_malloc(_TRIM_THRESHOLD, 2 * _LARGE)  # as glibc would, or each frame pays for its end


def _set_malloc(parameter: int, value: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(parameter, value)
