"""Camera and encoder, kept alive: what hangs or fails is closed and opened again, and counted."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from queue import Empty, SimpleQueue

from pi_firmware import gstreamer
from pi_firmware.media import Counters, Decided, Leave, Media
from pi_firmware.settings import CameraSettings, Settings
from pi_firmware.sources import Source, open_source
from pi_firmware.wire import messages
from pi_firmware.wire.errors import BlimpError, StreamError

_POLL_NS = 50_000_000
_START_FACTOR = 2.0  # a camera takes longer to its first frame than from frame to frame
_LONGEST_PAUSE_S = 2.0
ENCODER, CAMERA = "encoder", "camera"
_STARTED_ANEW = {
    CAMERA: messages.EVENT_CAMERA_RESTARTED,
    ENCODER: messages.EVENT_ENCODER_RESTARTED,
}


class UnrecoverableError(StreamError):
    """Starting again inside the process has not helped: the process must be."""

    restart = True


class Capture:
    """The camera and the encoder of a flight: `start`, `step` until it ends, `close`.

    A recording is not restarted: what fails there ends the flight. `announce` gets an event's
    name and text. Raises `BlimpError` with one line for what cannot be opened at first.
    """

    def __init__(
        self,
        settings: Settings,
        decided: Decided,
        leave: Leave,
        announce: Callable[[str, str], None],
    ) -> None:
        self.counters = Counters()
        self.restarts = dict.fromkeys(_STARTED_ANEW, 0)
        """How often the `CAMERA` and the `ENCODER` were restarted since the program's start."""
        self._settings = settings
        self._decided, self._leave, self._announce = decided, leave, announce
        self._gst = gstreamer.load()
        self._ceiling_kbps: int | None = None
        self._bitrate_kbps: int | None = None
        self._in_a_row = 0
        self._before = 0
        self._started_s = 0.0
        self._due_s: float | None = None
        self._trusted: Settings | None = None
        self._asked: SimpleQueue[tuple[CameraSettings, Future[None]]] = SimpleQueue()
        self._ending = False
        self._media: Media | None = None
        self._source: Source | None = None
        self._open()

    @property
    def live(self) -> bool:
        """Whether frames come from a camera, which goes on while we start it again."""
        return not self._settings.camera.uri.startswith("replay:")

    @property
    def camera(self) -> CameraSettings:
        """What the camera is asked for now."""
        return self._settings.camera

    @property
    def encoded(self) -> int:
        """Frames that left the encoder since the start."""
        media = self._media
        return self._before + (media.encoded if media else 0)

    @property
    def bitrate_kbps(self) -> int:
        """The bit rate last asked for."""
        media = self._media
        if media is None:
            return self._bitrate_kbps or self._settings.encoder.bitrate_kbps
        return media.encoder.bitrate_kbps

    @property
    def cut_reason(self) -> str:
        """Why a recording ended early, in words; empty when it did not."""
        return self._source.cut_reason if self._source else ""

    def start(self) -> None:
        """Begins to deliver; raises `BlimpError` with one line."""
        assert self._media is not None and self._source is not None
        self._started_s = time.monotonic()
        self._media.play()
        self._source.start()

    def step(self) -> bool:
        """Waits 50 ms at most for what happens and acts on it; False at the stream's end.

        Raises `BlimpError` for a fault that a restart does not fix, `UnrecoverableError` after too
        many.
        """
        self._serve()
        if self._due_s is not None:
            time.sleep(_POLL_NS / 1e9)
            if self._ending:
                return False
            if time.monotonic() >= self._due_s:
                self._reopen()
            return True
        media, source = self._media, self._source
        assert media is not None and source is not None
        kinds = self._gst.MessageType.ERROR | self._gst.MessageType.EOS
        message = media.bus.timed_pop_filtered(_POLL_NS, kinds)
        if media.error is not None:
            self._fail(CAMERA, _as_blimp_error(media.error))
        elif message is not None and message.type == self._gst.MessageType.EOS:
            if source.error is None:
                media.settle()
                return False
            self._give_up(source.error)
            return True
        elif message is not None:
            text = source.explain(message.parse_error()[0].message)
            if source.error is not None:
                self._give_up(source.error)
                return True
            what = ENCODER if message.src.get_name() == "encoder" else CAMERA
            self._fail(what, StreamError(f"video pipeline: {text}"))
        elif self.live and not self._ending:
            self._watch(media)
        return True

    def end(self) -> None:
        """Asks the camera to end; `step` returns False when the last frame has left."""
        self._ending = True
        if self._source is not None:
            # Not on this thread: a source that hangs does not take the message.
            threading.Thread(target=self._source.stop, name="end", daemon=True).start()

    def force_idr(self) -> None:
        media = self._media
        if media is not None:
            media.encoder.force_idr()

    def set_bitrate(self, kbps: int) -> int:
        """Asks for a bit rate within the configured bounds; returns the one asked for."""
        media = self._media
        if media is not None:
            return media.encoder.set_bitrate(kbps)
        self._bitrate_kbps = kbps
        return kbps

    def limit_bitrate(self, kbps: int) -> int:
        """Never more than this from now on, after restarts too; returns the one asked for now."""
        self._ceiling_kbps = kbps
        media = self._media
        return media.encoder.limit_bitrate(kbps) if media is not None else kbps

    def link_report(self, report: messages.LinkReport, corrections: float = 0.0) -> None:
        media = self._media
        if media is not None:
            media.encoder.link_report(report, corrections)

    def answered(self, sequence: int) -> None:
        """The ground is done with this frame and all before it."""
        source = self._source
        if source is not None and source.window is not None:
            source.window.answered(sequence)

    def ask_for(self, camera: CameraSettings) -> Future[None]:
        """Has the camera restarted with other settings; with the old ones when it refuses.

        From any thread: `step` does it. The result is there when it was done, or a `BlimpError`.
        """
        done: Future[None] = Future()
        self._asked.put((camera, done))
        return done

    def _serve(self) -> None:
        try:
            camera, done = self._asked.get_nowait()
        except Empty:
            return
        try:
            self._use(camera)
        except UnrecoverableError as error:
            done.set_exception(error)
            raise
        except BlimpError as error:
            done.set_exception(error)
        else:
            done.set_result(None)

    def _use(self, camera: CameraSettings) -> None:
        before = self._settings
        self.close()
        self._settings, self._trusted = dataclasses.replace(before, camera=camera), before
        try:
            self._open()
            self.start()
        except BlimpError:
            self.close()
            self._go_back(before)
            raise

    def _give_up(self, error: BlimpError) -> None:
        """The source says that opening it again would be no better: settings that were asked for on
        the way are taken back, and with those of the start the flight ends.
        """
        if self._trusted is None:
            raise error
        self.close()
        self._go_back(self._trusted)
        self._announce(messages.EVENT_CAMERA_RESTARTED, f"{error}; as it was before")

    def _go_back(self, settings: Settings) -> None:
        self._settings, self._trusted = settings, None
        self._due_s = time.monotonic()

    def _open(self) -> None:
        source = open_source(self._settings.camera)
        try:
            media = Media(self._settings, source, self.counters, self._decided, self._leave)
        except BaseException:
            source.close()
            raise
        self._source, self._media = source, media
        if self._ceiling_kbps is not None:
            media.encoder.limit_bitrate(self._ceiling_kbps)
        if self._bitrate_kbps is not None:
            media.encoder.set_bitrate(self._bitrate_kbps)

    def _reopen(self) -> None:
        self._due_s = None
        try:
            self._open()
            self.start()
        except BlimpError as error:
            self._fail(CAMERA, error)

    def close(self) -> None:
        """Stops and releases everything; raises `UnrecoverableError` for what hangs."""
        source, media = self._source, self._media
        self._source = self._media = None
        stopped = True
        if media is not None:
            stopped = media.stop()
            self._before += media.encoded
            self._bitrate_kbps = media.encoder.bitrate_kbps
        if not stopped:
            raise UnrecoverableError("the video pipeline hangs and cannot be stopped")
        if source is not None:
            source.close()

    def _watch(self, media: Media) -> None:
        """Restarts what has not delivered for too long."""
        now_s = time.monotonic()
        limit_s = self._settings.supervision.frame_timeout_s
        frame_s = 1.5 / self._settings.camera.rate_hz
        if media.encoded and media.alive and self._in_a_row:
            self._in_a_row = 0
            self._announce(messages.EVENT_STREAMING_AGAIN, str(self.counters))
        waiting_s = media.waiting_since_s
        if waiting_s is not None and now_s - waiting_s > limit_s:
            self._fail(ENCODER, StreamError(f"the encoder gave no frame for {limit_s:g} s"))
        elif media.last_captured_s is None:
            limit_s *= _START_FACTOR
            if now_s - self._started_s > limit_s + frame_s:
                self._fail(CAMERA, StreamError(f"the camera gave no first frame in {limit_s:g} s"))
        elif now_s - media.last_captured_s > limit_s + frame_s:
            self._fail(CAMERA, StreamError(f"the camera gave no new frame for {limit_s:g} s"))

    def _fail(self, what: str, error: BlimpError) -> None:
        """Closes both; they are opened again after a pause, or `UnrecoverableError` is raised."""
        if not self.live or self._ending:
            raise error
        self.close()
        limit = self._settings.supervision.restarts
        if self._in_a_row >= limit:
            raise UnrecoverableError(
                f"{error}; {limit} restarts of camera and encoder did not help"
            )
        self._in_a_row += 1
        self.restarts[what] += 1
        pause_s = 0.0 if self._in_a_row == 1 else min(0.25 * 2**self._in_a_row, _LONGEST_PAUSE_S)
        self._due_s = time.monotonic() + pause_s
        self._announce(_STARTED_ANEW[what], str(error))


def _as_blimp_error(error: Exception) -> BlimpError:
    if isinstance(error, BlimpError):
        return error
    return StreamError(f"video pipeline: {type(error).__name__}: {error}")
