"""What became of a session's frames, counted on by the localizer that is started after one died."""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from pathlib import Path

from ground_station.service.bus_messages import FrameMessage
from ground_station.service.localizing.derive import Accounts
from pi_firmware.wire import files

_KEEP_S = 0.25


class Accounting:
    """Counts the frames of a payload's session, which the intake numbers as it shows them.

    What was processed lately when a localizer was killed counts as skipped after it.
    """

    def __init__(self, path: Path) -> None:
        self.accounts = Accounts()
        self._path = path
        self._ssrc = self._shown = -1
        self._kept_s = float("-inf")
        with contextlib.suppress(OSError, ValueError):
            self._ssrc, self._shown, processed, localized = map(int, path.read_text().split())
            self.accounts = Accounts(processed, localized)

    def frame(self, note: FrameMessage) -> None:
        """A frame comes: those of its session before it that were not taken are skipped."""
        if note.ssrc != self._ssrc or note.shown <= self._shown:
            self.accounts = Accounts()
        self._ssrc, self._shown = note.ssrc, note.shown
        skipped = max(0, note.shown - 1 - self.accounts.processed)
        self.accounts = replace(self.accounts, skipped=skipped)

    def skip(self) -> None:
        """It could not be taken."""
        self.accounts = replace(self.accounts, skipped=self.accounts.skipped + 1)

    def take(self, *, localized: bool) -> None:
        """It was processed."""
        own = self.accounts
        own = replace(own, processed=own.processed + 1, localized=own.localized + localized)
        self.accounts, now_s = own, time.monotonic()
        if now_s - self._kept_s < _KEEP_S:
            return
        self._kept_s = now_s
        kept = f"{self._ssrc} {self._shown} {own.processed} {own.localized}"
        with contextlib.suppress(OSError):  # the run's folder is full
            files.write(self._path, kept.encode())
