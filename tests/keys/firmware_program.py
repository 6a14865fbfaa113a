"""The payload's real program with a folder of certificates."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

LIMIT_S = 60.0
LOOK_S = 0.5
# The clock's task looks twice a second instead of each ten; all else is as it flies.
_PROGRAM = f"""
import sys
from pi_firmware import supervision
supervision._CLOCK_S, supervision._SILENCE_S = {LOOK_S}, 0.5
from pi_firmware.__main__ import main
sys.exit(main())
"""


class Program:
    """The program, connected to these endpoints; a context manager that ends it.

    `said` are its lines on standard error.
    """

    def __init__(
        self,
        certificates: Path,
        connect: Sequence[str],
        port: int = 9,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        quoted = ", ".join(f'"{to}"' for to in connect)
        settings = (
            "camera.uri=test:", "camera.width_px=320", "camera.height_px=240",
            "camera.rate_hz=15", f"link.port={port}", f"telemetry.certificates={certificates}",
            f"telemetry.connect=[{quoted}]", "wifi.interface=",
        )  # fmt: skip
        self._command = [sys.executable, "-c", _PROGRAM]
        self._command += [word for setting in settings for word in ("--set", setting)]
        self._environment = environment
        self.said: list[str] = []
        self._changed = threading.Condition()

    def __enter__(self) -> Program:
        self._process = subprocess.Popen(
            self._command, env=self._environment, stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self._process.wait(LIMIT_S)
        finally:
            self._process.kill()
            self._reader.join()

    def wait(self, words: str) -> str:
        """The first line with these words."""

        def found() -> str | None:
            return next((line for line in self.said if words in line), None)

        with self._changed:
            assert self._changed.wait_for(lambda: found() is not None, LIMIT_S), (words, self.said)
        return found() or ""

    def _read(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            with self._changed:
                self.said.append(line.rstrip())
                self._changed.notify_all()
