"""`replay:FLIGHT.mcap`, a recorded flight as if the camera saw it now, at its pace or stepped."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.base import Source, Stamp, Window
from pi_firmware.sources.decoding import Picture, RecordingDecoder
from pi_firmware.uri import Uri
from pi_firmware.wire.errors import BlimpError, RecordingError

PACES = ("realtime", "stepped")
MAX_STEPS_HZ = 120.0
"""Frames a second of the stepped pace where `max_hz` says nothing.

UDP has no back-pressure, so this is what keeps a receiver from being flooded: at the default bit
rate 120 frames a second are the packets of a flight at 8 Mbit/s. Of 2,000 frames of the sample
flight over loopback none was lost at it, nor at the 146 to 153 a second of two cores without it,
with a receive buffer of 4 MB as with one of 208 kB.
"""


class RealTime:
    """Each frame at its recorded instant, `speed` times as fast, on the pipeline's clock."""

    ahead_frames = 4
    """How many frames may wait in front of the pipeline."""

    def __init__(self, speed: float, now: Callable[[], int], stopping: threading.Event) -> None:
        self._speed = speed
        self._now = now
        self._stopping = stopping
        self._start: tuple[int, int] | None = None

    def turn(self, time_ns: int) -> int | None:
        """Waits for the turn of the frame captured at `time_ns`, the first frame's being at once.

        Returns its running time in the pipeline, ns; None when the waiting was interrupted.
        """
        if self._start is None:
            self._start = self._now(), time_ns
        start_ns, first_ns = self._start
        due_ns = start_ns + int((time_ns - first_ns) / self._speed)
        interrupted = self._stopping.wait(max(0, due_ns - self._now()) / 1e9)
        return None if interrupted else due_ns


class Stepped:
    """Each frame when the pipeline has taken the one before, at most `max_hz` a second.

    With a window it also waits for whoever works on the frames.

    Running time is the recording's, not the clock's: whatever is measured in it (heartbeats, IDR
    intervals, the encoder's bit rate) comes out as in a flight, the same in each run.
    """

    ahead_frames = 1

    def __init__(
        self, max_hz: float, stopping: threading.Event, window: Window | None = None
    ) -> None:
        self._least_s = 1 / max_hz
        self._stopping = stopping
        self._window = window
        self._first_ns: int | None = None
        self._previous_s = -self._least_s

    def turn(self, time_ns: int) -> int | None:
        """As `RealTime.turn`."""
        if self._first_ns is None:
            self._first_ns = time_ns
        else:
            wait_s = self._previous_s + self._least_s - time.monotonic()
            if wait_s > 0 and self._stopping.wait(wait_s):
                return None
        if self._window is not None and not self._window.wait(self._stopping):
            return None
        self._previous_s = time.monotonic()
        return None if self._stopping.is_set() else time_ns - self._first_ns


_OPTIONS = ("rate_hz", "start_s", "duration_s", "loop", "pace", "speed", "max_hz", "ahead")
_OF_PACE = {"realtime": ("speed",), "stepped": ("max_hz", "ahead")}


class RateGrid:
    """Which frames of a recording a camera with a lower rate would have taken.

    The slower camera's instants lie on a grid from the first frame on; each instant gets the frame
    nearest to it, so that jitter in the recorded times does not shift the choice.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = 1e9 / rate_hz
        self._first_ns: int | None = None
        self._previous_ns = 0
        self._taken = 0

    def takes(self, time_ns: int) -> bool:
        """Whether the frame captured at `time_ns` is taken; times must rise."""
        if self._first_ns is None:
            self._first_ns = self._previous_ns = time_ns
            return True
        half_interval_ns = min(time_ns - self._previous_ns, self._period_ns) / 2
        self._previous_ns = time_ns
        instant = int((time_ns - self._first_ns + half_interval_ns) / self._period_ns)
        if instant <= self._taken:
            return False
        self._taken = instant
        return True


class ReplaySource(Source):
    """Decodes ahead, waits for each frame's turn, then hands it to the pipeline.

    `time_ns` of a frame is the recording's own, so that it meets the recorded ground truth exactly;
    `clock_ns` is the payload's clock when the frame was handed over. In a loop, recorded times go
    on rising by the length of a round. No frame is lost up to the encoder, at either pace: appsrc
    blocks while its queue is full.
    """

    def __init__(self, uri: Uri, camera: CameraSettings) -> None:
        uri.only(*_OPTIONS)
        if not uri.path:
            raise uri.fail("expected replay:FLIGHT.mcap")
        self.rate_hz = uri.number("rate_hz", camera.rate_hz, 1, 120)
        self._path = Path(uri.path)
        self._start_ns = int(1e9 * uri.number("start_s", 0.0, 0.0, 1e6))
        self._duration_ns = int(1e9 * uri.number("duration_s", 1e6, 0.01, 1e6))
        self._loop = uri.choice("loop", "0", ("0", "1")) == "1"
        self._stopping = threading.Event()
        self._pace = self._chosen_pace(uri)
        self._decoder: RecordingDecoder | None = None
        self._stamps: dict[int, Stamp] = {}
        self._thread = threading.Thread(target=self._run, name="replay", daemon=True)
        pictures = self._taken_pictures()
        try:
            # The first picture tells its size before anything is sent.
            first = next(pictures, None)
            if first is None:
                raise RecordingError(
                    f"{self._path}: no frames after start_s={self._start_ns / 1e9}"
                )
            self._pictures = chain([first], pictures)
            self._caps = self._checked_caps(camera)
        except BaseException:
            self.close()
            raise

    def elements(self) -> str:
        return (
            "appsrc name=source is-live=true format=time block=true max-bytes=0 "
            f'max-buffers={self._pace.ahead_frames} caps="{self._caps}"'
        )

    def attach(self, pipeline: Any) -> None:
        self._pipeline = pipeline

    def start(self) -> None:
        self._thread.start()

    def stamp(self, running_ns: int) -> Stamp:
        return self._stamps.pop(running_ns)

    def stop(self) -> None:
        self._stopping.set()

    def close(self) -> None:
        self._stopping.set()
        if self._decoder is not None:
            self._decoder.close()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        source = self._pipeline.get_by_name("source")
        gst = gstreamer.load()
        try:
            for picture in self._pictures:
                running_ns = self._pace.turn(picture.time_ns)
                if running_ns is None:
                    break
                self._stamps[running_ns] = Stamp(
                    picture.time_ns, time.time_ns(), picture.exposure_s, picture.gain
                )
                buffer = picture.buffer.copy()
                buffer.pts, buffer.dts = running_ns, gst.CLOCK_TIME_NONE
                if source.emit("push-buffer", buffer) != gst.FlowReturn.OK:
                    break
        except BlimpError as error:
            self.error = error
        finally:
            source.emit("end-of-stream")

    def _chosen_pace(self, uri: Uri) -> RealTime | Stepped:
        name = uri.choice("pace", "realtime", PACES)
        for pace, options in _OF_PACE.items():
            for option in options:
                if option in uri.options and pace != name:
                    raise uri.fail(f"{option} is for pace={pace} only")
        if name == "stepped":
            max_hz = uri.number("max_hz", MAX_STEPS_HZ, 0.1, 1000.0)
            if "ahead" in uri.options:
                self.window = Window(int(uri.number("ahead", 1, 1, 1000)))
            return Stepped(max_hz, self._stopping, self.window)
        return RealTime(uri.number("speed", 1.0, 0.1, 10.0), self._running_ns, self._stopping)

    def _running_ns(self) -> int:
        return int(self._pipeline.get_clock().get_time() - self._pipeline.get_base_time())

    def _taken_pictures(self) -> Iterator[Picture]:
        """The pictures that the camera takes, round after round, with rising times."""
        grid = RateGrid(self.rate_hz)
        shift_ns = 0
        while True:
            self._decoder = RecordingDecoder(self._path)
            first_ns = previous_ns = last_ns = None
            for picture in self._decoder.pictures():
                if first_ns is None:
                    first_ns = picture.time_ns
                since_ns = picture.time_ns - first_ns - self._start_ns
                if since_ns >= self._duration_ns:
                    break
                previous_ns, last_ns = last_ns, picture.time_ns
                shifted_ns = picture.time_ns + shift_ns
                if since_ns >= 0 and grid.takes(shifted_ns):
                    yield Picture(shifted_ns, picture.buffer, picture.exposure_s, picture.gain)
            self.cut_reason = self._decoder.cut_reason
            self._decoder.close()
            if not self._loop or first_ns is None or last_ns is None or previous_ns is None:
                return
            round_start_ns = first_ns + self._start_ns
            shift_ns += last_ns - round_start_ns + (last_ns - previous_ns)

    def _checked_caps(self, camera: CameraSettings) -> str:
        assert self._decoder is not None
        caps = self._decoder.caps
        structure = caps.get_structure(0)
        width, height = structure.get_value("width"), structure.get_value("height")
        if (width, height) != (camera.width_px, camera.height_px):
            raise RecordingError(
                f"{self._path}: its pictures are {width}x{height}, camera.width_px x height_px is "
                f"{camera.width_px}x{camera.height_px}"
            )
        rate = Fraction(self.rate_hz).limit_denominator(1001)
        text = f"video/x-raw,format=I420,width={width},height={height}"
        if structure.has_field("colorimetry"):
            text += f",colorimetry={structure.get_value('colorimetry')}"
        return f"{text},framerate={rate.numerator}/{rate.denominator}"


SOURCE = ReplaySource
