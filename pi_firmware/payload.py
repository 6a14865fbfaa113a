"""The payload's state: from the camera through the gate and the encoder to the link."""

from __future__ import annotations

import threading
import time

from pi_firmware import encoder, gstreamer, link
from pi_firmware.autopilot import open_autopilot
from pi_firmware.battery import Monitor, open_gauge
from pi_firmware.gate import Decision, Verdict
from pi_firmware.media import Counters, Media
from pi_firmware.settings import Settings
from pi_firmware.sources import open_source
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire import messages, sei
from pi_firmware.wire.errors import BlimpError, StreamError

_POLL_NS = 50_000_000
_FLUSH_LIMIT_S = 10.0


class Payload:
    """One flight of the payload: build it, `run` it, `close` it.

    Raises `BlimpError` with one line for whatever cannot be opened.
    """

    def __init__(self, settings: Settings) -> None:
        encoder.require(settings.encoder)
        gauge = open_gauge(settings.battery.uri, settings.battery)
        self._autopilot = open_autopilot(
            settings.autopilot, lambda state: self._telemetry.autopilot(state)
        )
        self.settings = settings
        self.ssrc = link.draw_ssrc(settings.link)
        self._source = open_source(settings.camera)
        self._gst = gstreamer.load()
        try:
            self.media = Media(settings, self._source, self.ssrc, self._tell_gate)
            self._telemetry = Telemetry(settings.payload_id, settings.telemetry)
            self._battery = Monitor(
                settings.battery,
                gauge,
                publish=self._telemetry.battery,
                announce=self._announce,
                on_low=self.media.limit_bitrate,
            )
        except BaseException:
            self._source.close()
            raise

    def run(self, stop: threading.Event) -> None:
        """Flies until the source ends or `stop` is set, then sends what is still inside.

        Raises `BlimpError` when camera, encoder or link fail on the way.
        """
        self._announce(messages.EVENT_STARTED, f"streaming {self.settings.camera.uri}")
        try:
            self.media.play()
            self._source.start()
            self._battery.start(on_critical=stop.set)
            self._autopilot.start()
            self._telemetry.on_pose(self._autopilot.on_pose)
            self._supervise(stop)
        except BlimpError as error:
            self._announce(messages.EVENT_FAILED, str(error))
            raise
        if self._source.cut_reason:
            self._announce(messages.EVENT_SOURCE_CUT, self._source.cut_reason)
        name = messages.EVENT_STOPPED if stop.is_set() else messages.EVENT_END_OF_STREAM
        self._announce(name, str(self.counters))

    @property
    def counters(self) -> Counters:
        """Frames so far."""
        return self.media.counters

    @property
    def cut_reason(self) -> str:
        """Why the source ended early, in words; empty when it did not."""
        return self._source.cut_reason

    @property
    def listening(self) -> tuple[str, ...]:
        """Telemetry endpoints that this payload listens on."""
        return self._telemetry.listening

    def close(self) -> None:
        """Stops the pipeline and releases everything."""
        self._source.stop()
        self.media.stop()
        self._source.close()
        self._autopilot.stop()
        self._battery.stop()
        self._telemetry.close()
        self._battery.shut_down()

    def _supervise(self, stop: threading.Event) -> None:
        bus = self.media.bus
        kinds = self._gst.MessageType.ERROR | self._gst.MessageType.EOS
        flush_until: float | None = None
        while True:
            message = bus.timed_pop_filtered(_POLL_NS, kinds)
            if self.media.error is not None:
                raise self.media.error
            if message is not None and message.type == self._gst.MessageType.ERROR:
                reason = self._source.explain(message.parse_error()[0].message)
                raise StreamError(f"video pipeline: {reason}")
            if message is not None:
                if self._source.error is not None:
                    raise self._source.error
                return
            now = time.monotonic()
            if stop.is_set() and flush_until is None:
                self._source.stop()
                flush_until = now + _FLUSH_LIMIT_S
            if flush_until is not None and now > flush_until:
                raise StreamError(f"the encoder did not end within {_FLUSH_LIMIT_S:g} s")

    def _tell_gate(self, info: sei.FrameInfo, verdict: Verdict) -> None:
        counters = self.counters
        self._telemetry.gate(
            messages.Gate(
                time_ns=time.time_ns(),
                capture_ns=info.time_ns,
                sequence=info.sequence,
                passed=verdict.decision is not Decision.GATED,
                heartbeat=info.heartbeat,
                entropy_bits=info.entropy_bits,
                sharpness=info.sharpness,
                captured=counters.captured,
                gated=counters.gated,
                heartbeats=counters.heartbeats,
                sent=counters.sent,
                ssrc=self.ssrc,
                reason=verdict.reason,
                difference=verdict.difference,
            )
        )

    def _announce(self, name: str, text: str) -> None:
        camera, counters = self.settings.camera, self.counters
        values = {
            "ssrc": self.ssrc,
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "captured": counters.captured,
            "gated": counters.gated,
            "heartbeats": counters.heartbeats,
            "sent": counters.sent,
        }
        self._telemetry.event(
            messages.Event(time_ns=time.time_ns(), name=name, text=text, values=values)
        )
