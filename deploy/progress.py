"""Progress in bytes: a bar with rate and rest on a terminal, plain lines in a log."""

from __future__ import annotations

import shutil
import sys
import time

_BAR_EVERY_S, _LINE_EVERY_S = 0.1, 10.0
_BAR_WIDTH = 20


class Progress:
    """Counts bytes of `total` on standard error, under a label."""

    def __init__(self, label: str, total: int) -> None:
        self._label, self._total, self._done = label, total, 0
        self._start_s = self._said_s = time.monotonic()
        self._terminal = sys.stderr.isatty()

    def advance(self, size: int) -> None:
        """So many bytes more are done."""
        self._done += size
        now_s = time.monotonic()
        if now_s - self._said_s >= (_BAR_EVERY_S if self._terminal else _LINE_EVERY_S):
            self._said_s = now_s
            self._write_line(now_s - self._start_s)

    def _write_line(self, elapsed_s: float) -> None:
        share = self._done / self._total if self._total else 1.0
        rate = self._done / max(elapsed_s, 1e-6)
        rest_s = (self._total - self._done) / rate if rate else 0.0
        figures = f"{_mega(self._done)} of {_mega(self._total)} MB, {_mega(rate)} MB/s"
        left = f"{int(rest_s) // 60}:{int(rest_s) % 60:02d} left"
        if not self._terminal:
            self._write(f"{self._label}: {figures}, {left}\n")
            return
        bar = ("#" * int(share * _BAR_WIDTH)).ljust(_BAR_WIDTH, ".")
        line = f"{self._label} [{bar}] {share:4.0%}  {figures}, {left}"
        self._write("\r" + line[: shutil.get_terminal_size().columns - 1] + "\x1b[K")

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        clear = "\r\x1b[K" if self._terminal else ""
        elapsed_s = time.monotonic() - self._start_s
        rate = _mega(self._done / max(elapsed_s, 1e-6))
        end = "" if kind is None else ", not finished"
        self._write(
            f"{clear}{self._label}: {_mega(self._done)} MB in {elapsed_s:.1f} s"
            f" ({rate} MB/s){end}\n"
        )

    @staticmethod
    def _write(text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()


def _mega(size: float) -> str:
    return f"{size / 1e6:.1f}" if size < 100e6 else f"{size / 1e6:.0f}"
