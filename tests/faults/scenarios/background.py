"""What a hostile peer does again and again, on a thread of its own, until it is told to stop."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable


class Background:
    """Calls `act` every `period_s` until `end`; what it raises ends it and is kept in `failure`.

    `acts` counts those that did not say False, nor raise `in_vain`, as when nobody is there.
    """

    def __init__(
        self, act: Callable[[], object], period_s: float, *in_vain: type[Exception]
    ) -> None:
        self.failure: Exception | None = None
        self.acts = 0
        self._act, self._period_s, self._in_vain = act, period_s, in_vain
        self._closing = threading.Event()
        self._cleanup = contextlib.ExitStack()
        self._thread = threading.Thread(target=self._run, name="hostile", daemon=True)

    def at_end(self, cleanup: Callable[[], object]) -> Background:
        """Also called at the end."""
        self._cleanup.callback(cleanup)
        return self

    def start(self) -> Background:
        """Begins."""
        self._thread.start()
        return self

    def end(self) -> None:
        """Ends it."""
        self._closing.set()
        self._thread.join(10.0)
        with contextlib.suppress(Exception):
            self._cleanup.close()

    def _run(self) -> None:
        try:
            while not self._closing.wait(self._period_s):
                with contextlib.suppress(*self._in_vain):
                    self.acts += self._act() is not False
        except Exception as error:
            self.failure = error
