"""The command line that long runs share, and a Ctrl-C that ends them in order."""

from __future__ import annotations

import argparse
import math
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import NoReturn

MOST_HOURS = 1000.0


class Parser(argparse.ArgumentParser):
    """Refuses in one line, with status 2."""

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message}", file=sys.stderr)
        sys.exit(2)


def number(low: float, high: float) -> Callable[[str], float]:
    """An argument's type: a number from `low` to `high`."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number from {low:g} to {high:g}")
        return value

    return read


def on_interrupt() -> threading.Event:
    """An event that the first Ctrl-C sets; the second ends the program at once."""
    asked = threading.Event()

    def ask(_: int, __: FrameType | None) -> None:
        asked.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        print("\ninterrupted: what was measured is judged", file=sys.stderr, flush=True)

    signal.signal(signal.SIGINT, ask)
    return asked
