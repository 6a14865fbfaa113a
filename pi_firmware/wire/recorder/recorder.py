"""Starts and stops recordings; who hands over frames never waits for a disk."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Mapping

from pi_firmware.wire import messages
from pi_firmware.wire.errors import RecordingError
from pi_firmware.wire.recorder.file import DurableFile, OpenFile
from pi_firmware.wire.recorder.folder import Limits
from pi_firmware.wire.recorder.run import Run

_START_LIMIT_S = 15.0
"""A slow card from which the writer's modules are read for the first time is waited for."""

_STOP_LIMIT_S = 8.0


class Recorder:
    """Records into `recording.folder`, one recording at a time.

    A recording is one file or several; what goes into them is `run_type`'s. A power cut costs what
    came in the last `sync_s`. Full, broken or slow disks end or thin out the recording and nothing
    else.

    `announce` gets events: started for each file, ended once for each recording, with the reason
    when nobody asked for it. `force_idr` asks for an IDR, so that a file begins soon. `head` are
    metadata tables of each file. Both may be called on the recorder's thread or that of `start` and
    `stop`.
    """

    run_type: Callable[..., Run] = Run

    def __init__(
        self,
        settings: Limits,
        announce: Callable[[str, str], None],
        *,
        force_idr: Callable[[], object] = lambda: None,
        head: Mapping[str, Mapping[str, str]] | None = None,
        open_file: OpenFile = DurableFile,
    ) -> None:
        self._settings = settings
        self._announce = announce
        self._force_idr = force_idr
        self._head = head or {}
        self._open_file = open_file
        self._run: Run | None = None
        self._latest: Run | None = None
        self._hung: Run | None = None
        self._left_out = 0
        self._closed = False
        self._commands = threading.Lock()

    @property
    def file(self) -> str:
        """The name of the file being written, "" when none is."""
        run = self._run
        return run.name if run else ""

    @property
    def size_MB(self) -> float:
        """Its size, 1e6 bytes; 0 when none is written."""
        run = self._run
        return run.size_bytes / 1e6 if run else 0.0

    @property
    def dropped(self) -> int:
        """Frames since the program's start that no file has although it was recording.

        The disk was too slow or broke, or the clock was set between two IDRs.
        """
        latest = self._latest
        return self._left_out + (latest.left_out if latest else 0)

    @property
    def problem(self) -> str:
        """Why the newest recording ended, in words, when nobody asked for it."""
        return self._latest.reason if self._latest and not self._run else ""

    def start(self) -> str:
        """Begins a recording; the name of its first file. When one is made already: of its file.

        Raises `RecordingError` with one line: no folder is configured, it cannot be written, too
        little is free, the disk does not answer.
        """
        with self._commands:
            if self._closed:
                raise RecordingError("the recorder is closed")
            if self._run is not None:
                return self.file
            if not self._settings.folder:
                raise RecordingError("recording.folder is empty: nothing can be recorded")
            if self._hung is not None and self._hung.is_alive():
                raise RecordingError(
                    f"recording.folder '{self._settings.folder}': the disk has not yet answered"
                    " to the recording before"
                )
            run = self._begun()
            name = run.name
        self._try_announce(messages.EVENT_RECORDING_STARTED, name)
        with contextlib.suppress(Exception):
            self._force_idr()
        return name

    def stop(self, limit_s: float | None = None) -> str:
        """Ends the recording within some seconds; the last file's name, "" when there was none.

        The file is whole and on the card then. A disk that does not answer is left to itself, which
        the event says. A second call does nothing.
        """
        with self._commands:
            run, self._run = self._run, None
            limit_s = _STOP_LIMIT_S if limit_s is None else limit_s
            if run is not None and not run.end(limit_s):
                run.give_up()
                self._hung = run
                run.reason = f"the disk did not take its end within {limit_s:g} s"
                self._try_announce(messages.EVENT_RECORDING_ENDED, f"{run.name}: {run.reason}")
            return self._latest.name if self._latest else ""

    def close(self, limit_s: float | None = None) -> None:
        self._closed = True
        self.stop(limit_s)

    def _begun(self) -> Run:
        def report(goes_on: bool, text: str) -> None:
            if goes_on:
                self._try_announce(messages.EVENT_RECORDING_STARTED, text)
                return
            if self._run is run:
                self._run = None
            self._try_announce(messages.EVENT_RECORDING_ENDED, text)

        run = self.run_type(
            self._settings,
            report=report,
            force_idr=self._force_idr,
            head=self._head,
            open_file=self._open_file,
        )
        try:
            run.begin(_START_LIMIT_S)
        except RecordingError:
            self._hung = run
            raise
        if self._latest is not None:
            self._left_out += self._latest.left_out
        self._latest = self._run = run
        run.go()
        return run

    def _try_announce(self, name: str, text: str) -> None:
        """A link that fails to take an event ends no recording."""
        with contextlib.suppress(Exception):
            self._announce(name, text)
