"""Progress of a long job: a bar on a terminal, plain lines in a log; and its end by Ctrl-C."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType

from tqdm import tqdm

_LINE_EVERY_S = 10.0
_SILENT: ContextVar[bool] = ContextVar("silent", default=False)


@contextmanager
def silent() -> Iterator[None]:
    """In this thread, jobs within the block say nothing: they are steps of a job that does."""
    before = _SILENT.set(True)
    try:
        yield
    finally:
        _SILENT.reset(before)


@contextmanager
def stop_noted(*numbers: int) -> Iterator[list[bool]]:
    """Inside, these signals only set the list's one element, so that a step is done whole or not.

    A second Ctrl-C is obeyed. Signals come to the main thread only: in others nothing is set.
    """
    noted = [False]
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return

    def note(number: int, _frame: FrameType | None) -> None:
        if noted[0] and number == signal.SIGINT:
            raise KeyboardInterrupt
        noted[0] = True

    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Progress:
    """Counts steps of `total` (None: unknown) on standard error, under a label."""

    def __init__(self, label: str, total: int | None) -> None:
        self._label, self._total, self._done = label, total, 0
        self._start_s = self._said_s = time.monotonic()
        self._silent = _SILENT.get()
        terminal = sys.stderr.isatty() and not self._silent
        self._bar = tqdm(total=total, desc=label, leave=False) if terminal else None

    def step(self, total: int | None = None) -> None:
        """One more is done, of no more than `total`, which may be known only now."""
        if total is not None and self._total is None:
            self._total = total
            if self._bar is not None:
                self._bar.total = total
        if self._done == self._total:
            return
        self._done += 1
        if self._bar is not None:
            self._bar.update()
        elif time.monotonic() - self._said_s >= _LINE_EVERY_S:
            self._said_s = time.monotonic()
            self._write_line(
                f"{self._label}: {self._done}" + (f" of {self._total}" if self._total else "")
            )

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._start_s

    def _write_line(self, text: str) -> None:
        if self._silent:
            return
        print(text, file=sys.stderr, flush=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
        if kind is None:
            self._write_line(f"{self._label}: {self._done} in {self.elapsed_s:.1f} s")
