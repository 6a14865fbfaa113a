"""The pictures of a recording, decoded ahead of their time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pi_firmware import gstreamer
from pi_firmware.wire.annexb import NAL_PPS, NAL_SPS, NO_PARAMETER_SETS, nal_types
from pi_firmware.wire.errors import BlimpError, RecordingError
from pi_firmware.wire.recording import FRAME_INFO_TOPIC, RecordingReader

_ELEMENTS = ("appsrc", "h264parse", "videoconvert")
DECODERS = ("avdec_h264", "v4l2h264dec", "openh264dec")
"""By preference: on a desk; the Pi's own, where its driver is there; and what each card carries."""
_PROPERTIES = {"avdec_h264": " max-threads=1"}  # frame threads would hold pictures back
_AHEAD_FRAMES = 4
_POLL_NS = 100_000_000


@dataclass(frozen=True)
class Picture:
    """One decoded frame: a `Gst.Buffer` of I420 and what the recording says about it."""

    time_ns: int
    buffer: Any
    exposure_s: float | None
    gain: float | None


class RecordingDecoder:
    """Decodes one recording from its first frame; iterate `pictures` once, then `close`."""

    def __init__(self, path: Path) -> None:
        gstreamer.require(_ELEMENTS, f"replay of {path}")
        decoder = gstreamer.first_of(DECODERS, f"replay of {path}")
        self.caps: Any = None
        """Of the decoded pictures, once the first one is out."""
        self.cut_reason = ""
        self._path = path
        self._reader = RecordingReader(path)
        self._details = _details(path)
        self._waiting: dict[int, tuple[int, float | None, float | None]] = {}
        self._error: BlimpError | None = None
        self._closed = threading.Event()
        self._pipeline = gstreamer.launch(
            "appsrc name=units format=time block=true max-bytes=0 max-buffers=8 "
            "caps=video/x-h264,stream-format=byte-stream,alignment=au "
            f"! h264parse ! {decoder}{_PROPERTIES.get(decoder, '')} "
            "! videoconvert ! video/x-raw,format=I420 "
            f"! appsink name=pictures sync=false max-buffers={_AHEAD_FRAMES}"
        )
        self._units = self._pipeline.get_by_name("units")
        self._sink = self._pipeline.get_by_name("pictures")
        self._feeder = threading.Thread(target=self._feed, name="replay-feeder", daemon=True)

    def pictures(self) -> Iterator[Picture]:
        """All pictures in file order; raises `BlimpError` where the recording cannot be played."""
        gst = gstreamer.load()
        self._pipeline.set_state(gst.State.PLAYING)
        self._feeder.start()
        count = 0
        while not self._closed.is_set():
            sample = self._sink.emit("try-pull-sample", _POLL_NS)
            if sample is None:
                self._raise_errors()
                if self._sink.get_property("eos"):
                    break
                continue
            self.caps = sample.get_caps()
            buffer = sample.get_buffer()
            found = self._waiting.pop(buffer.pts, None)
            if found is not None:
                count += 1
                yield Picture(found[0], buffer, found[1], found[2])
        self._feeder.join()
        if not self._closed.is_set():
            self._raise_errors()
            if count == 0:
                raise RecordingError(f"{self._path}: no frame of its video decodes")

    def close(self) -> None:
        """Ends decoding, wherever it is."""
        self._closed.set()
        self._pipeline.set_state(gstreamer.load().State.NULL)
        if self._feeder.is_alive():
            self._feeder.join()

    def _feed(self) -> None:
        gst = gstreamer.load()
        first_ns: int | None = None
        missing = {NAL_SPS, NAL_PPS}
        try:
            for sample in self._reader.video():
                if first_ns is None:
                    first_ns = sample.time_ns
                if missing:
                    missing -= set(nal_types(sample.data))
                pts = sample.time_ns - first_ns
                if pts < 0:
                    continue
                self._waiting[pts] = (sample.time_ns, *self._details(sample.time_ns))
                buffer = gst.Buffer.new_wrapped(sample.data)
                buffer.pts = buffer.dts = pts
                if self._units.emit("push-buffer", buffer) != gst.FlowReturn.OK:
                    return
            if first_ns is None:
                raise RecordingError(f"{self._path}: the recording has no video")
            if missing:
                raise RecordingError(f"{self._path}: {NO_PARAMETER_SETS}")
            self.cut_reason = self._reader.cut_reason if self._reader.cut else ""
        except BlimpError as error:
            self._error = error
        finally:
            self._units.emit("end-of-stream")

    def _raise_errors(self) -> None:
        if self._error is not None:
            raise self._error
        if failure := gstreamer.failure(self._pipeline):
            raise RecordingError(f"{self._path}: {failure}")


Details = Callable[[int], tuple[float | None, float | None]]


def _details(path: Path) -> Details:
    """A function from rising capture times to (exposure_s, gain), read alongside the video."""
    entries = RecordingReader(path).json(FRAME_INFO_TOPIC)
    ahead = next(entries, None)

    def at(time_ns: int) -> tuple[float | None, float | None]:
        nonlocal ahead
        while ahead is not None and ahead[0] < time_ns:
            ahead = next(entries, None)
        if ahead is None or ahead[0] != time_ns:
            return None, None
        return _number(ahead[1].get("exposure_s")), _number(ahead[1].get("gain"))

    return at


def _number(value: Any) -> float | None:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number else None
