"""The payload's state: from the camera through the gate and the encoder to the link."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from pi_firmware import encoder, gstreamer, link
from pi_firmware.battery import Monitor, open_gauge
from pi_firmware.gate import Decision, Gate, measure
from pi_firmware.settings import Settings
from pi_firmware.sources import open_source
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire import annexb, messages, sei
from pi_firmware.wire.errors import BlimpError, StreamError
from pi_firmware.wire.video import MAX_IDR_INTERVAL_NS

_POLL_NS = 50_000_000
_START_LIMIT_NS = 5_000_000_000
_FLUSH_LIMIT_S = 10.0


@dataclass
class Counters:
    """Frames so far: `captured` = `gated` + those encoded; `sent` of these have left."""

    captured: int = 0
    gated: int = 0
    heartbeats: int = 0
    sent: int = 0

    def __str__(self) -> str:
        return (
            f"{self.captured} captured, {self.gated} gated, {self.sent} sent"
            f" ({self.heartbeats} as heartbeat)"
        )


class Payload:
    """One flight of the payload: build it, `run` it, `close` it.

    Raises `BlimpError` with one line for whatever cannot be opened.
    """

    def __init__(self, settings: Settings) -> None:
        encoder.require(settings.encoder)
        gauge = open_gauge(settings.battery.uri, settings.battery)
        self.settings = settings
        self.counters = Counters()
        self.ssrc = link.draw_ssrc(settings.link)
        self._gate = Gate(settings.gate)
        self._source = open_source(settings.camera)
        self._gst = gstreamer.load()
        self._video = gstreamer.load_video()
        self._in_encoder: dict[int, sei.FrameInfo] = {}
        self._last_idr_ns = 0
        self._error: Exception | None = None
        try:
            self._pipeline = self._build()
            self._telemetry = Telemetry(settings.payload_id, settings.telemetry)
            self._battery = Monitor(
                settings.battery, gauge, publish=self._telemetry.battery, announce=self._announce
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
            self._play()
            self._source.start()
            self._battery.start(on_critical=stop.set)
            self._supervise(stop)
        except BlimpError as error:
            self._announce(messages.EVENT_FAILED, str(error))
            raise
        if self._source.cut_reason:
            self._announce(messages.EVENT_SOURCE_CUT, self._source.cut_reason)
        name = messages.EVENT_STOPPED if stop.is_set() else messages.EVENT_END_OF_STREAM
        self._announce(name, str(self.counters))

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
        self._pipeline.set_state(self._gst.State.NULL)
        self._source.close()
        self._battery.stop()
        self._telemetry.close()
        self._battery.shut_down()

    def _build(self) -> Any:
        settings = self.settings
        encoding = encoder.description(settings.encoder, settings.camera, self._source.rate_hz)
        pipeline = gstreamer.launch(
            f"{self._source.elements()} ! {encoding} "
            "! video/x-h264,stream-format=byte-stream,alignment=au "
            "! appsink name=encoded emit-signals=true sync=false async=false "
            f"{link.description(settings.link, self.ssrc)}"
        )
        self._link = link.Link(pipeline, settings.link)
        self._encoder = pipeline.get_by_name("encoder")
        pad = self._encoder.get_static_pad("sink")
        pad.add_probe(self._gst.PadProbeType.BUFFER, self._on_captured)
        encoded = pipeline.get_by_name("encoded")
        encoded.connect("new-sample", self._on_encoded)
        encoded.connect("eos", lambda _: self._link.end())
        self._source.attach(pipeline)
        return pipeline

    def _on_captured(self, pad: Any, probe: Any) -> Any:
        """The gate, on the camera's thread: decides whether the frame reaches the encoder."""
        try:
            return self._gate_frame(pad, probe.get_buffer())
        except Exception as error:  # a callback cannot raise: the main thread does it
            self._error = self._error or error
            return self._gst.PadProbeReturn.DROP

    def _gate_frame(self, pad: Any, buffer: Any) -> Any:
        running_ns = _running_ns(self._gst, pad, buffer)
        stamp = self._source.stamp(running_ns)
        measured = measure(self._luma(buffer))
        decision = self._gate.decide(measured.entropy_bits, running_ns)
        info = sei.FrameInfo(
            sequence=self.counters.captured,
            time_ns=stamp.time_ns,
            clock_ns=stamp.clock_ns,
            entropy_bits=measured.entropy_bits,
            sharpness=measured.sharpness,
            exposure_s=stamp.exposure_s,
            gain=stamp.gain,
            heartbeat=decision is Decision.HEARTBEAT,
        )
        self.counters.captured += 1
        self.counters.heartbeats += info.heartbeat
        if decision is Decision.GATED:
            self.counters.gated += 1
        else:
            self._in_encoder[running_ns] = info
            self._keep_idr_interval(running_ns)
        self._tell_gate(info, decision)
        drop = decision is Decision.GATED
        return self._gst.PadProbeReturn.DROP if drop else self._gst.PadProbeReturn.OK

    def _keep_idr_interval(self, running_ns: int) -> None:
        """Asks for an IDR where gated frames would make the encoder's own one come too late."""
        period_ns = 1e9 / self._source.rate_hz
        if running_ns - self._last_idr_ns + period_ns / 2 > MAX_IDR_INTERVAL_NS:
            event = self._video.video_event_new_upstream_force_key_unit(
                self._gst.CLOCK_TIME_NONE, True, 0
            )
            self._encoder.get_static_pad("src").send_event(event)

    def _on_encoded(self, sink: Any) -> Any:
        """On the encoder's thread: puts the frame's numbers into its access unit and sends it."""
        try:
            sample = sink.emit("pull-sample")
            buffer = sample.get_buffer()
            running_ns = sample.get_segment().to_running_time(self._gst.Format.TIME, buffer.pts)
            access_unit = buffer.extract_dup(0, buffer.get_size())
            if annexb.is_idr(access_unit):
                self._last_idr_ns = running_ns
            for earlier in [ns for ns in list(self._in_encoder) if ns < running_ns]:
                del self._in_encoder[earlier]  # the encoder keeps order: it dropped this one
            info = self._in_encoder.pop(running_ns)
            stamped = annexb.insert_before_slice(access_unit, sei.encode(info))
            if self._link.send(stamped, running_ns):
                self.counters.sent += 1
            return self._gst.FlowReturn.OK
        except Exception as error:  # a callback cannot raise: the main thread does it
            self._error = self._error or error
            return self._gst.FlowReturn.ERROR

    def _luma(self, buffer: Any) -> np.ndarray[Any, np.dtype[np.uint8]]:
        camera = self.settings.camera
        meta = self._video.buffer_get_video_meta(buffer)
        stride = meta.stride[0] if meta else -(-camera.width_px // 4) * 4
        offset = meta.offset[0] if meta else 0
        plane = buffer.extract_dup(offset, stride * camera.height_px)
        rows = np.frombuffer(plane, np.uint8).reshape(camera.height_px, stride)
        return rows[:, : camera.width_px]

    def _supervise(self, stop: threading.Event) -> None:
        bus = self._pipeline.get_bus()
        kinds = self._gst.MessageType.ERROR | self._gst.MessageType.EOS
        flush_until: float | None = None
        while True:
            message = bus.timed_pop_filtered(_POLL_NS, kinds)
            if self._error is not None:
                raise self._error
            if message is not None and message.type == self._gst.MessageType.ERROR:
                raise StreamError(f"video pipeline: {message.parse_error()[0].message}")
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

    def _play(self) -> None:
        if self._pipeline.set_state(self._gst.State.PLAYING) == self._gst.StateChangeReturn.FAILURE:
            message = self._pipeline.get_bus().pop_filtered(self._gst.MessageType.ERROR)
            text = message.parse_error()[0].message if message else "it does not start"
            raise StreamError(f"video pipeline: {text}")
        self._pipeline.get_state(_START_LIMIT_NS)

    def _tell_gate(self, info: sei.FrameInfo, decision: Decision) -> None:
        counters = self.counters
        self._telemetry.gate(
            messages.Gate(
                time_ns=time.time_ns(),
                capture_ns=info.time_ns,
                sequence=info.sequence,
                passed=decision is not Decision.GATED,
                heartbeat=info.heartbeat,
                entropy_bits=info.entropy_bits,
                sharpness=info.sharpness,
                captured=counters.captured,
                gated=counters.gated,
                heartbeats=counters.heartbeats,
                sent=counters.sent,
                ssrc=self.ssrc,
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


def _running_ns(gst: Any, pad: Any, buffer: Any) -> int:
    """The running time of a buffer that passes a pad, whatever the pad's segment is."""
    event = pad.get_sticky_event(gst.EventType.SEGMENT, 0)
    return int(event.parse_segment().to_running_time(gst.Format.TIME, buffer.pts))
