"""How long each frame of a recording was exposed, from the messages beside its video."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from ground_station.recording.frames import plausible_exposure_s
from pi_firmware.wire import sei
from pi_firmware.wire.recording import FRAME_INFO_TOPIC, RecordingReader, VideoSample

_AHEAD = 64
"""Messages looked through for one frame's: writers put it within a chunk of the frame's video."""


class Exposures:
    """The exposures of a recording, read along with its video by a reader of its own.

    A frame's message is the one logged at its capture time; where it is missing or tells nothing
    plausible, the access unit's own SEI is asked. A message that is no JSON object tells nothing.
    """

    def __init__(self, path: Path) -> None:
        self._messages = self._read(RecordingReader(path))
        self._known: dict[int, float | None] = {}

    def of(self, sample: VideoSample) -> float | None:
        """The exposure of the picture in an access unit, seconds; None where nothing tells it."""
        for _ in range(_AHEAD):
            if sample.time_ns in self._known or (message := next(self._messages, None)) is None:
                break
            self._known[message[0]] = message[1]
        exposure_s = self._known.get(sample.time_ns)
        if exposure_s is None and (info := sei.find(sample.data)) is not None:
            exposure_s = plausible_exposure_s(info.exposure_s)
        return exposure_s

    @staticmethod
    def _read(reader: RecordingReader) -> Iterator[tuple[int, float | None]]:
        for _, record in reader.messages({FRAME_INFO_TOPIC}):
            try:
                message = json.loads(record.data)
            except (ValueError, RecursionError):
                message = None
            value = message.get("exposure_s") if isinstance(message, dict) else None
            yield record.log_time, plausible_exposure_s(value)
