"""The board's light: a code of short blinks, steady at the start, a heartbeat when all is well."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

_NAMES = ("ACT", "led0")  # of today's kernels and of older ones
_ON_S, _OFF_S, _PAUSE_S = 0.2, 0.3, 1.5


class StatusLed:
    """The light below `root`/sys; a board without one is dark and nothing fails."""

    def __init__(self, root: Path, sleep: Callable[[float], object] = time.sleep) -> None:
        self._sleep = sleep
        folders = [root / "sys/class/leds" / name for name in _NAMES]
        self._folder = next((folder for folder in folders if folder.is_dir()), None)
        self._trigger: str | None = None

    def heartbeat(self) -> None:
        """All is well: the kernel blinks twice a second; without its trigger the light is on."""
        if not self._set_trigger("heartbeat"):
            self.steady()

    def steady(self) -> None:
        """It is starting."""
        if self._set_trigger("none"):
            self._light(True)

    def blink(self, count: int) -> None:
        """`count` short blinks and the pause after them; it takes as long as that does."""
        self._set_trigger("none")
        for _ in range(count):
            self._light(True)
            self._sleep(_ON_S)
            self._light(False)
            self._sleep(_OFF_S)
        self._sleep(_PAUSE_S)

    def _set_trigger(self, name: str) -> bool:
        if self._trigger == name:
            return True
        if self._write("trigger", name):
            self._trigger = name
            return True
        return False

    def _light(self, on: bool) -> None:
        self._write("brightness", "255" if on else "0")

    def _write(self, file: str, text: str) -> bool:
        if self._folder is None:
            return False
        try:
            (self._folder / file).write_text(text)
        except OSError:
            return False
        return True
