"""The frames' way from the camera through the gate and the encoder, in GStreamer's threads.

Python sees of a frame its luma at low resolution, its timestamps and its finished access unit; the
picture itself never enters it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pi_firmware import encoder, gstreamer
from pi_firmware.gate import Gate, Measure, Verdict, attach_luma, luma_branch, measure
from pi_firmware.settings import Settings
from pi_firmware.sources.base import Source
from pi_firmware.wire import annexb, sei
from pi_firmware.wire.errors import StreamError
from pi_firmware.wire.video import MAX_IDR_INTERVAL_NS

_START_LIMIT_NS = 5_000_000_000
_STOP_LIMIT_S = 5.0


@dataclass
class Counters:
    """Frames so far: `captured` = `gated` + those that went to the encoder.

    Of these `sent` have left the payload, `discarded` never will, and the others are inside.
    """

    captured: int = 0
    gated: int = 0
    heartbeats: int = 0
    sent: int = 0
    discarded: int = 0

    def __str__(self) -> str:
        lost = f", {self.discarded} discarded" if self.discarded else ""
        return (
            f"{self.captured} captured, {self.gated} gated, {self.sent} sent"
            f" ({self.heartbeats} as heartbeat){lost}"
        )


@dataclass(frozen=True)
class Unit:
    """A frame that left the encoder: its numbers, and its access unit with them inside.

    `clock_ns` is the frame's instant on the system's monotonic clock.
    """

    info: sei.FrameInfo
    data: bytes
    clock_ns: int
    idr: bool


Decided = Callable[[sei.FrameInfo, Verdict], None]
Leave = Callable[[Unit], bool]


class Media:
    """Camera and encoder from their start to their end: `play`, look at `error` and `bus`, `stop`.

    Bit rate and IDRs are the `encoder`'s. `decided` is called with each captured frame and the
    gate's verdict, on the camera's thread; `leave` with each finished one, on the encoder's, and
    says whether it was sent. `counters` may go on from an earlier one's. Raises `BlimpError` with
    one line for what cannot be built.
    """

    def __init__(
        self,
        settings: Settings,
        source: Source,
        counters: Counters,
        decided: Decided,
        leave: Leave,
    ) -> None:
        self.counters = counters
        self.error: Exception | None = None
        """What failed on one of the pipeline's threads."""
        self.encoded = 0
        """Frames that left the encoder since `play`."""
        self.last_captured_s: float | None = None
        """When the camera last delivered a picture that was not the one before, on
        `time.monotonic`'s clock; None before it did."""
        self.alive = False
        """Whether its picture has changed since `play`."""
        self._settings = settings
        self._source = source
        self._decided, self._leave = decided, leave
        self._gate = Gate(settings.gate)
        self._gst = gstreamer.load()
        self._verdict: Verdict | None = None
        self._last: Measure | None = None
        self._in_encoder: dict[int, tuple[sei.FrameInfo, float]] = {}
        self._last_idr_ns = 0
        self._last_passed_ns: int | None = None
        self._stopped = False
        self._attached: list[Callable[[], None]] = []
        """Takes off each callback that the pipeline holds: with one left, neither it nor its
        descriptors would ever be freed."""
        self._pipeline = self._build()

    @property
    def bus(self) -> Any:
        """The pipeline's messages, its errors and its end among them."""
        return self._pipeline.get_bus()

    @property
    def waiting_since_s(self) -> float | None:
        """Since when the encoder owes a frame, on `time.monotonic`'s clock; None: it owes none."""
        for _, entered_s in list(self._in_encoder.values()):
            return entered_s
        return None

    def play(self) -> None:
        """Sets the pipeline to playing; raises `StreamError` with one line."""
        gst = self._gst
        if self._pipeline.set_state(gst.State.PLAYING) == gst.StateChangeReturn.FAILURE:
            text = gstreamer.failure(self._pipeline) or "it does not start"
            raise StreamError(f"video pipeline: {self._source.explain(text)}")
        self._pipeline.get_state(_START_LIMIT_NS)

    def stop(self) -> bool:
        """Stops the pipeline, whatever is inside; False when something in it hangs.

        It then goes on hanging on a thread of its own, and only the process's end ends it.
        """
        stopping = threading.Thread(
            target=self._pipeline.set_state, args=(self._gst.State.NULL,), name="stop", daemon=True
        )
        stopping.start()
        stopping.join(_STOP_LIMIT_S)
        self._stopped = True  # what hangs may come back to life, and must count no more
        self.settle()
        if stopping.is_alive():
            return False
        while self._attached:
            self._attached.pop()()
        return True

    def settle(self) -> None:
        """Counts what is inside as discarded: called when nothing comes out any more.

        After the stream's end that is what an encoder took and never gave.
        """
        for running_ns in list(self._in_encoder):
            taken = self._in_encoder.pop(running_ns, None)
            if taken is not None:
                self._discard(taken[0].sequence)

    def _build(self) -> Any:
        settings, source = self._settings, self._source
        encoding = encoder.description(
            settings.encoder, settings.camera, source.rate_hz, dmabuf=source.dmabuf
        )
        pipeline = gstreamer.launch(
            f"{source.elements()} ! {luma_branch(settings.camera)} ! {encoding} "
            "! video/x-h264,stream-format=byte-stream,alignment=au "
            "! appsink name=encoded emit-signals=true sync=false async=false"
        )
        element = pipeline.get_by_name("encoder")
        self.encoder = encoder.Encoder(element, settings.encoder, source.rate_hz)
        luma = attach_luma(pipeline, settings.camera, self._on_luma)
        pad, sink = element.get_static_pad("sink"), pipeline.get_by_name("encoded")
        probe = pad.add_probe(self._gst.PadProbeType.BUFFER, self._on_frame)
        handler = sink.connect("new-sample", self._on_encoded)
        self._attached += [
            luma,
            lambda: pad.remove_probe(probe),
            lambda: sink.disconnect(handler),
        ]
        source.attach(pipeline)
        return pipeline

    def _on_luma(self, luma: NDArray[np.uint8], running_ns: int) -> None:
        """The gate, on the camera's thread, before the frame itself goes on."""
        if self._stopped:
            return
        try:
            self._verdict = self._judge(luma, running_ns)
        except Exception as error:  # a callback cannot raise: the main thread does it
            self.error = self.error or error

    def _on_frame(self, pad: Any, probe: Any) -> Any:
        """Whether the frame that was just judged reaches the encoder."""
        verdict, self._verdict = self._verdict, None
        if verdict is None and self.error is None and not self._stopped:
            self.error = StreamError("a frame came to the encoder that the gate had not seen")
        result = self._gst.PadProbeReturn
        return result.OK if verdict is not None and verdict.passed else result.DROP

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
            heartbeat=verdict.heartbeat,
        )
        self.counters.captured += 1
        self.counters.heartbeats += info.heartbeat
        now_s = time.monotonic()
        if not self._repeats(measured):
            self.alive = self.last_captured_s is not None
            self.last_captured_s = now_s
        if not verdict.passed:
            self.counters.gated += 1
        else:
            if self._source.window is not None:
                self._source.window.passed(info.sequence)
            self._in_encoder[running_ns] = info, now_s
            self._keep_idr_interval(running_ns)
        self._decided(info, verdict)
        return verdict

    def _repeats(self, measured: Measure) -> bool:
        """Whether a picture is the one before, bit by bit: a camera that hangs and says nothing.

        A sensor's noise is never twice the same, but in a picture too dark or too bright to have
        any, which the gate's entropy tells.
        """
        before, self._last = self._last, measured
        rich = measured.entropy_bits >= self._settings.gate.min_entropy_bits
        return rich and before is not None and np.array_equal(before.blocks, measured.blocks)

    def _keep_idr_interval(self, running_ns: int) -> None:
        """Asks for an IDR after a gap, and where gated frames or losses want one sooner."""
        period_ns = 1e9 / self._source.rate_hz
        gap_ns = running_ns - (running_ns if self._last_passed_ns is None else self._last_passed_ns)
        self._last_passed_ns = running_ns
        after_gap = gap_ns > max(1e9 * self._settings.gate.idr_after_s, 1.5 * period_ns)
        late = running_ns - self._last_idr_ns + period_ns / 2 > MAX_IDR_INTERVAL_NS
        if self.encoder.next_is_due() or after_gap or late:
            self.encoder.force_idr()

    def _on_encoded(self, sink: Any) -> Any:
        """On the encoder's thread: puts the frame's numbers into its access unit and sends it."""
        if self._stopped:
            return self._gst.FlowReturn.EOS
        try:
            sample = sink.emit("pull-sample")
            buffer = sample.get_buffer()
            running_ns = sample.get_segment().to_running_time(self._gst.Format.TIME, buffer.pts)
            access_unit = buffer.extract_dup(0, buffer.get_size())
            idr = annexb.is_idr(access_unit)
            if idr:
                self._last_idr_ns = running_ns
                self.encoder.saw_idr()
            for earlier in [ns for ns in list(self._in_encoder) if ns < running_ns]:
                dropped, _ = self._in_encoder.pop(earlier)  # the encoder keeps the order
                self._discard(dropped.sequence)
            info, _ = self._in_encoder.pop(running_ns)
            stamped = annexb.insert_before_slice(access_unit, sei.encode(info))
            self.encoded += 1
            clock_ns = self._pipeline.get_base_time() + running_ns
            self.encoder.gave(clock_ns)
            if self._leave(Unit(info, stamped, clock_ns, idr)):
                self.counters.sent += 1
            else:
                self._discard(info.sequence)
            return self._gst.FlowReturn.OK
        except Exception as error:  # a callback cannot raise: the main thread does it
            self.error = self.error or error
            return self._gst.FlowReturn.ERROR

    def _discard(self, sequence: int) -> None:
        self.counters.discarded += 1
        if self._source.window is not None:
            self._source.window.gone(sequence)
