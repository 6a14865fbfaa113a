"""What the payload says of itself, made into messages."""

from __future__ import annotations

import time

from pi_firmware.gate import Decision, Verdict
from pi_firmware.media import Counters
from pi_firmware.settings import Settings
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire import messages, sei


class Reporter:
    """Turns verdicts and events into messages with the counters of their moment.

    Safe from any thread. `counters` are set once there are some.
    """

    def __init__(self, settings: Settings, ssrc: int, telemetry: Telemetry) -> None:
        self.counters = Counters()
        self._settings = settings
        self._ssrc = ssrc
        self._telemetry = telemetry

    def gate(self, info: sei.FrameInfo, verdict: Verdict) -> None:
        """The gate's decision on a frame."""
        self._telemetry.publish(
            messages.Gate(
                time_ns=time.time_ns(),
                capture_ns=info.time_ns,
                sequence=info.sequence,
                passed=verdict.decision is not Decision.GATED,
                heartbeat=info.heartbeat,
                entropy_bits=info.entropy_bits,
                sharpness=info.sharpness,
                ssrc=self._ssrc,
                reason=verdict.reason,
                difference=verdict.difference,
                **vars(self.counters),
            ),
        )

    def announce(self, name: str, text: str) -> None:
        """An event, with the counters and the stream's properties."""
        camera = self._settings.camera
        values = {
            "ssrc": self._ssrc,
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            **vars(self.counters),
        }
        self._telemetry.publish(
            messages.Event(time_ns=time.time_ns(), name=name, text=text, values=values),
        )
