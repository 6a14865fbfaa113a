"""The frames' way through the payload: camera, gate, encoder, link, each in GStreamer's threads.

Python sees of a frame its luma at low resolution, its timestamps and its finished access unit; the
picture itself never enters it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pi_firmware import encoder, gstreamer, link, measuring
from pi_firmware.gate import Decision, Gate, Verdict, measure
from pi_firmware.settings import Settings
from pi_firmware.sources.base import Source
from pi_firmware.wire import annexb, sei
from pi_firmware.wire.errors import StreamError
from pi_firmware.wire.video import MAX_IDR_INTERVAL_NS

_START_LIMIT_NS = 5_000_000_000


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


Decided = Callable[[sei.FrameInfo, Verdict], None]


class Media:
    """The pipeline of one flight: `play` it, look at `error` and `bus` meanwhile, `stop` it.

    `decided` is called with each captured frame and the gate's verdict, on the camera's thread.
    Raises `BlimpError` with one line for what cannot be built.
    """

    def __init__(self, settings: Settings, source: Source, ssrc: int, decided: Decided) -> None:
        self.counters = Counters()
        self.error: Exception | None = None
        """What failed on one of the pipeline's threads."""
        self._settings = settings
        self._source = source
        self._decided = decided
        self._gate = Gate(settings.gate)
        self._gst = gstreamer.load()
        self._verdict: Verdict | None = None
        self._in_encoder: dict[int, sei.FrameInfo] = {}
        self._last_idr_ns = 0
        self._last_passed_ns: int | None = None
        self._pipeline = self._build(ssrc)

    @property
    def bus(self) -> Any:
        """The pipeline's messages, its errors and its end among them."""
        return self._pipeline.get_bus()

    def play(self) -> None:
        """Sets the pipeline to playing; raises `StreamError` with one line."""
        gst = self._gst
        if self._pipeline.set_state(gst.State.PLAYING) == gst.StateChangeReturn.FAILURE:
            message = self.bus.pop_filtered(gst.MessageType.ERROR)
            text = message.parse_error()[0].message if message else "it does not start"
            raise StreamError(f"video pipeline: {self._source.explain(text)}")
        self._pipeline.get_state(_START_LIMIT_NS)

    def stop(self) -> None:
        """Stops the pipeline, whatever is inside."""
        self._pipeline.set_state(self._gst.State.NULL)

    def set_bitrate(self, kbps: int) -> int:
        """Asks the encoder for this bit rate, within the configured bounds; returns the one set."""
        return self._encoder.set_bitrate(kbps)

    def limit_bitrate(self, kbps: int) -> int:
        """Holds the encoder to this bit rate from now on; returns the one now set."""
        return self._encoder.limit_bitrate(kbps)

    def force_idr(self) -> None:
        """Makes the next frame an IDR."""
        self._encoder.force_idr()

    def link_report(self, lost: float, round_trip_s: float) -> None:
        """What the ground saw of late: the share of packets lost, 0 to 1, and the round trip."""
        self._encoder.link_report(lost, round_trip_s)

    def _build(self, ssrc: int) -> Any:
        settings, source = self._settings, self._source
        encoding = encoder.description(
            settings.encoder, settings.camera, source.rate_hz, dmabuf=source.dmabuf
        )
        pipeline = gstreamer.launch(
            f"{source.elements()} ! {measuring.description(settings.camera)} ! {encoding} "
            "! video/x-h264,stream-format=byte-stream,alignment=au "
            "! appsink name=encoded emit-signals=true sync=false async=false "
            f"{link.description(settings.link, ssrc)}"
        )
        self._link = link.Link(pipeline, settings.link)
        element = pipeline.get_by_name("encoder")
        self._encoder = encoder.Encoder(element, settings.encoder, source.rate_hz)
        measuring.attach(pipeline, settings.camera, self._on_luma)
        element.get_static_pad("sink").add_probe(self._gst.PadProbeType.BUFFER, self._on_frame)
        encoded = pipeline.get_by_name("encoded")
        encoded.connect("new-sample", self._on_encoded)
        encoded.connect("eos", lambda _: self._link.end())
        source.attach(pipeline)
        return pipeline

    def _on_luma(self, luma: NDArray[np.uint8], running_ns: int) -> None:
        """The gate, on the camera's thread, before the frame itself goes on."""
        try:
            self._verdict = self._judge(luma, running_ns)
        except Exception as error:  # a callback cannot raise: the main thread does it
            self.error = self.error or error

    def _on_frame(self, pad: Any, probe: Any) -> Any:
        """Whether the frame that was just judged reaches the encoder."""
        verdict, self._verdict = self._verdict, None
        if verdict is None and self.error is None:
            self.error = StreamError("a frame came to the encoder that the gate had not seen")
        result = self._gst.PadProbeReturn
        passes = verdict is not None and verdict.decision is not Decision.GATED
        return result.OK if passes else result.DROP

    def _judge(self, luma: NDArray[np.uint8], running_ns: int) -> Verdict:
        stamp = self._source.stamp(running_ns)
        measured = measure(luma)
        verdict = self._gate.decide(measured, running_ns)
        info = sei.FrameInfo(
            sequence=self.counters.captured,
            time_ns=stamp.time_ns,
            clock_ns=stamp.clock_ns,
            entropy_bits=measured.entropy_bits,
            sharpness=measured.sharpness,
            exposure_s=stamp.exposure_s,
            gain=stamp.gain,
            heartbeat=verdict.decision is Decision.HEARTBEAT,
        )
        self.counters.captured += 1
        self.counters.heartbeats += info.heartbeat
        if verdict.decision is Decision.GATED:
            self.counters.gated += 1
        else:
            self._in_encoder[running_ns] = info
            self._keep_idr_interval(running_ns)
        self._decided(info, verdict)
        return verdict

    def _keep_idr_interval(self, running_ns: int) -> None:
        """Asks for an IDR after a gap, and where gated frames or losses want one sooner."""
        period_ns = 1e9 / self._source.rate_hz
        gap_ns = running_ns - (running_ns if self._last_passed_ns is None else self._last_passed_ns)
        self._last_passed_ns = running_ns
        after_gap = gap_ns > max(1e9 * self._settings.gate.idr_after_s, 1.5 * period_ns)
        late = running_ns - self._last_idr_ns + period_ns / 2 > MAX_IDR_INTERVAL_NS
        if self._encoder.next_is_due() or after_gap or late:
            self._encoder.force_idr()

    def _on_encoded(self, sink: Any) -> Any:
        """On the encoder's thread: puts the frame's numbers into its access unit and sends it."""
        try:
            sample = sink.emit("pull-sample")
            buffer = sample.get_buffer()
            running_ns = sample.get_segment().to_running_time(self._gst.Format.TIME, buffer.pts)
            access_unit = buffer.extract_dup(0, buffer.get_size())
            if annexb.is_idr(access_unit):
                self._last_idr_ns = running_ns
                self._encoder.saw_idr()
            for earlier in [ns for ns in list(self._in_encoder) if ns < running_ns]:
                del self._in_encoder[earlier]  # the encoder keeps order: it dropped this one
            info = self._in_encoder.pop(running_ns)
            stamped = annexb.insert_before_slice(access_unit, sei.encode(info))
            if self._link.send(stamped, running_ns):
                self.counters.sent += 1
            return self._gst.FlowReturn.OK
        except Exception as error:  # a callback cannot raise: the main thread does it
            self.error = self.error or error
            return self._gst.FlowReturn.ERROR
