"""Starts and stops recordings, and takes frames and telemetry without ever waiting for a disk."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping

from pi_firmware.recording.flight import FlightRun, Telemetry
from pi_firmware.settings import RecordingSettings
from pi_firmware.wire import messages, sei
from pi_firmware.wire.recorder import recorder
from pi_firmware.wire.recorder.durable import DurableFile, OpenFile


class Recorder(recorder.Recorder):
    """Records video and telemetry into `recording.folder`, one recording at a time.

    The next file begins at an IDR, without a gap, when one is full or the clock was set. The
    camera's calibration is not in it: the payload does not know it. `payload` is put into each
    file, as the metadata table of that name.
    """

    run_type = FlightRun

    def __init__(
        self,
        settings: RecordingSettings,
        announce: Callable[[str, str], None],
        *,
        force_idr: Callable[[], object] = lambda: None,
        payload: Mapping[str, str] | None = None,
        open_file: OpenFile = DurableFile,
    ) -> None:
        head = {"payload": payload} if payload else {}
        super().__init__(settings, announce, force_idr=force_idr, head=head, open_file=open_file)

    def unit(self, info: sei.FrameInfo, access_unit: bytes) -> None:
        """Records an access unit when a recording is made; never waits and never raises."""
        run = self._run
        if run is not None:
            with contextlib.suppress(Exception):
                run.queue.unit(info, access_unit)

    def message(self, kind: str, message: messages.Message) -> None:
        """Records a message on `/blimp/<kind>`, likewise; from any thread."""
        run = self._run
        if run is not None and isinstance(message, messages.Message):
            with contextlib.suppress(Exception):
                run.queue.put(Telemetry(kind, message, time.monotonic()))
