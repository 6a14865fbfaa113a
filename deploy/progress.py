"""Progress in bytes: a bar with rate and rest on a terminal, plain lines in a log."""

from __future__ import annotations

import sys
import time

from tqdm import tqdm

_LINE_EVERY_S = 10.0


class Progress:
    """Counts bytes of `total` on standard error, under a label."""

    def __init__(self, label: str, total: int) -> None:
        self._label, self._total, self._done = label, total, 0
        self._start_s = self._said_s = time.monotonic()
        # Without a terminal there is no bar (disable=None).
        self._bar = tqdm(
            total=total, desc=label, unit="B", unit_scale=True, leave=False, disable=None
        )

    def advance(self, size: int) -> None:
        """So many bytes more are done."""
        self._done += size
        self._bar.update(size)
        if self._bar.disable and time.monotonic() - self._said_s >= _LINE_EVERY_S:
            self._said_s = time.monotonic()
            self._say(f"of {self._total / 1e6:.1f} MB")

    def _say(self, what: str) -> None:
        elapsed_s = time.monotonic() - self._start_s
        rate = self._done / 1e6 / max(elapsed_s, 1e-6)
        figures = f"{self._done / 1e6:.1f} {what} in {elapsed_s:.1f} s ({rate:.1f} MB/s)"
        print(f"{self._label}: {figures}", file=sys.stderr, flush=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._bar.close()
        self._say("MB" if kind is None else "MB, not finished")
