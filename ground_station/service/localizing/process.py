"""The localizer process's loop: who falls behind takes the newest frame, and counts the others.

Of a payload that waits for poses (`Run.stepped`) each frame is taken in its turn.
"""

from __future__ import annotations

import contextlib
import math
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ground_station.arrays import U8
from ground_station.errors import GroundStationError, MapError
from ground_station.geometry.trajectory import read_tum
from ground_station.localization.estimate import State
from ground_station.localization.localizer import Localizer
from ground_station.map import store
from ground_station.service import bus_messages, pictures
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import EventMessage, FrameMessage
from ground_station.service.ending import RateLimitedLog
from ground_station.service.localizing import derive
from ground_station.service.localizing.derive import Accounts
from ground_station.service.localizing.maps import Loader, Loading
from ground_station.service.settings import Run
from pi_firmware.wire import files
from pi_firmware.wire.errors import BlimpError

WINDOW_S = 2.0
SKIPPED = 0.05
"""Of the frames told of: what `make limits` calls sustained is TRACKING in 95 % of them."""
LATE_S = 1.0
"""Features of a frame take a tenth of this where a core is free for them."""
FIRST_REST_S, LONGEST_REST_S, RARE_S = 1.0, 4.0, 1.0
"""Between two keyframes, at first and at most; usual is a third of a
second. More than the last is said."""
_EFFECT_S = 0.5
"""What a longer rest saves shows after this."""
_HALVED_S = 8.0
"""In this a rest that is too long shrinks by half: slower than it grows, so that few frames pay."""
WAITING_S = 0.12
"""A frame that waits so long is late: with half of the queue at 30 Hz, with one more at 10."""
_AGAIN_S = 5.0
"""A frame that is late or skipped so long after the one before is an accident, and keyframes that
rest still are no news."""


class Overload:
    """Whether frames are skipped, or features late, for lack of processor; its state in words.

    Frames that are late or skipped again and again double the rest between two keyframes, whose
    features cost as much as all else, and time without shortens it: what is left of the processor
    is found as TCP finds a link's. Late ones tell it before any is skipped.
    """

    def __init__(self) -> None:
        self._counts: deque[tuple[float, int, int]] = deque()
        self._late_s = self._lengthened_s = float("-inf")
        self._waited_s: float | None = None

    def watch(
        self, localizer: Localizer, now_s: float, taken: int, skipped: int, waiting_s: float = 0.0
    ) -> str:
        """After each frame; the localizer is told, and the answer is "" while all is well.

        `now_s` is monotonic; `taken` and `skipped` count the stream's frames so far, and the next
        one has waited for `waiting_s`.
        """
        counts = self._counts
        if counts and taken + skipped < counts[-1][1] + counts[-1][2]:
            counts.clear()  # counted again
        last_s, _, last_skipped = counts[-1] if counts else (now_s, taken, skipped)
        counts.append((now_s, taken, skipped))
        while len(counts) > 1 and counts[1][0] <= now_s - WINDOW_S:
            counts.popleft()
        lost = skipped - counts[0][2]
        told = lost + taken - counts[0][1]
        rest_s = localizer.rest_s * 0.5 ** ((now_s - last_s) / _HALVED_S)
        if waiting_s < WAITING_S:
            self._waited_s, is_late = None, False
        elif is_late := self._waited_s is None or now_s >= self._waited_s + _EFFECT_S:
            self._waited_s = now_s
        if is_late or skipped > last_skipped:
            again = now_s < self._late_s + _AGAIN_S
            self._late_s = now_s
            if again and now_s >= self._lengthened_s + _EFFECT_S:
                self._lengthened_s = now_s
                rest_s = min(max(FIRST_REST_S, 2 * rest_s), LONGEST_REST_S)
        localizer.rest_s = rest_s
        late_s = localizer.keyframe_late_s
        if lost > SKIPPED * told:
            what = f"{lost} of {told} frames skipped in {WINDOW_S:g} s; keyframes are rare"
        elif late_s > LATE_S:
            what = f"features under way for {late_s:.1f} s; keyframes are late"
        elif rest_s > RARE_S and now_s < self._lengthened_s + _AGAIN_S:
            what = f"a keyframe in {rest_s:.1f} s is what it bears"
        else:
            return ""
        return f"this computer is too slow: {what}"


_KEEP_S = 0.25


class Accounting:
    """Counts the frames of a payload's session, which the intake numbers as it shows them.

    What was processed lately when a localizer was killed counts as skipped after it.
    """

    def __init__(self, path: Path) -> None:
        self.accounts = Accounts()
        self._path = path
        self._ssrc = self._shown = -1
        self._kept_s = float("-inf")
        with contextlib.suppress(OSError, ValueError):
            self._ssrc, self._shown, processed, localized = map(int, path.read_text().split())
            self.accounts = Accounts(processed, localized)

    def frame(self, note: FrameMessage) -> None:
        """A frame comes: those of its session before it that were not taken are skipped."""
        if note.ssrc != self._ssrc or note.shown <= self._shown:
            self.accounts = Accounts()
        self._ssrc, self._shown = note.ssrc, note.shown
        skipped = max(0, note.shown - 1 - self.accounts.processed)
        self.accounts = replace(self.accounts, skipped=skipped)

    def skip(self) -> None:
        """It could not be taken."""
        self.accounts = replace(self.accounts, skipped=self.accounts.skipped + 1)

    def take(self, *, localized: bool) -> None:
        """It was processed."""
        own = self.accounts
        own = replace(own, processed=own.processed + 1, localized=own.localized + localized)
        self.accounts, now_s = own, time.monotonic()
        if now_s - self._kept_s < _KEEP_S:
            return
        self._kept_s = now_s
        kept = f"{self._ssrc} {self._shown} {own.processed} {own.localized}"
        with contextlib.suppress(OSError):  # the run's folder is full
            files.write(self._path, kept.encode())


RESTART = 3
"""Exit status: only a new process can help."""

_POLL_S = 0.2
_QUEUED, _OLDEST_S = 8, 0.4
"""Frames that wait while one takes longer, as when a keyframe is described, and for how long: a
quarter of a second at 30 Hz, four frames at 10."""
_ANSWER_S = 3.0
"""A question for a map waits this long for it to be loaded; a larger one is told by an event."""
_WAITING_EVERY_S = 1.0
_FORGET_AFTER, _END_AFTER = 3, 10
"""Frames in a row that failed: what is known of the flight may be the cause; the process is."""


class Localizing:
    """One payload's frames to poses, on the bus."""

    def __init__(self, bus: Bus, folder: Path, payload_id: str, run: Run) -> None:
        self._bus, self._payload_id, self._run = bus, payload_id, run
        self._start = read_tum(run.start) if run.start else None
        self._pictures = pictures.PictureReader(folder, payload_id)
        self._loader = Loader(run)
        self._localizer: Localizer | None = None
        self._map, self._coordinates = "", ""
        self._waiting = "the map is being loaded"
        self._forget = threading.Event()
        self._stream: tuple[int, int] | None = None  # ssrc and time of the last frame
        self._failed = 0
        self._accounting = Accounting(folder / f"counts-{payload_id}")
        self._overload = Overload()
        self._told_s = 0.0
        self._complain = RateLimitedLog(
            lambda name, text: self._event(bus_messages.WARNING, name, text)
        )
        # A payload that waits for poses has fewer frames on their way than the ring has slots.
        room = (pictures.SLOTS, math.inf) if run.stepped else (_QUEUED, _OLDEST_S)
        self._newest = bus.newest(bus_messages.FRAME, FrameMessage, payload_id, *room)
        self._loader.begin(Path(run.station.map.folder))
        bus.serve(bus.process, self._do)

    def run(self, stop: threading.Event) -> int:
        """Until `stop` is set: 0, or `RESTART` after too many failures in a row."""
        while not stop.is_set():
            self._bus.heartbeat()
            self._take_map()
            note = self._newest.take(_POLL_S)
            if note is not None:
                self._frame(note)
            if self._failed >= _END_AFTER:
                text = f"{self._failed} frames in a row failed; the localizer restarts"
                self._event(bus_messages.ALARM, "localizer-failed", text)
                return RESTART
        return 0

    # Frames

    def _frame(self, note: FrameMessage) -> None:
        self._accounting.frame(note)
        if self._localizer is None:
            self._accounting.skip()
            self._tell_waiting(note)
            return
        image = self._pictures.read(note.slot, note.stamp)
        if image is None:  # overwritten before it was read
            self._accounting.skip()
            return
        self._follow_stream(self._localizer, note)
        self._localize(self._localizer, note, image)

    def _follow_stream(self, localizer: Localizer, note: FrameMessage) -> None:
        """Begins again where another stream does: the payload was restarted, or its replay was."""
        last, self._stream = self._stream, (note.ssrc, note.time_ns)
        another = last is not None and (note.ssrc != last[0] or note.time_ns < last[1])
        if another or self._forget.is_set():
            self._forget.clear()
            localizer.reset()
        if self._start is not None:
            localizer.set_initial_pose(self._start.at(note.time_ns), note.time_ns)
            self._start = None

    def _localize(self, localizer: Localizer, note: FrameMessage, image: U8) -> None:
        estimate, reason, damaged = None, "", pictures.damaged_in(note)
        try:
            estimate = localizer.process(
                note.time_ns, image, note.sequence, note.exposure_s, damaged
            )
            self._failed = 0
        except BlimpError as error:  # the frame is at fault, as one of another camera's size
            reason = str(error)
            self._complain("frame-refused", reason)
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            self._fail(localizer, reason)
        self._accounting.take(localized=estimate is not None and estimate.localized)
        accounts = self._accounting.accounts
        about = (accounts, self._map, time.time_ns())
        if estimate is not None:
            told = derive.estimate_note(note, estimate, *about)
            if self._run.landmarks:
                seen = estimate.observations
                told = replace(told, landmarks=seen.landmark[derive.shown(seen)].tolist())
        else:
            fresh = localizer.state is State.INITIALIZING
            state = State.INITIALIZING if fresh else State.LOST
            told = derive.unsolved_note(note, state, reason, *about)
        waiting_s = 0.0 if self._run.stepped else self._newest.waiting_s  # no clock decides there
        said = self._overload.watch(
            localizer, time.monotonic(), accounts.processed, accounts.skipped, waiting_s
        )
        share = 0.0 if damaged is None else round(float(damaged.mean()), 3)
        told = replace(told, overload=said, damaged=share, coordinates=self._coordinates)
        self._bus.publish(bus_messages.ESTIMATE, self._payload_id, told)

    def _fail(self, localizer: Localizer, reason: str) -> None:
        self._failed += 1
        if self._complain("frame-failed", f"a frame failed: {reason}"):
            traceback.print_exc(file=sys.stderr)
        if self._failed == _FORGET_AFTER:
            localizer.reset()

    # Maps

    def _take_map(self) -> None:
        loading = self._loader.landed()
        if loading is None:
            return
        if loading.localizer is None:
            self._refuse(loading)
        else:
            self._localizer, self._map = loading.localizer, loading.name
            self._failed = 0
            used = loading.localizer.map
            self._coordinates = store.coordinates_id(loading.folder, used.info)
            count = len(used.landmarks)
            text = f"the map '{loading.name}' is in use: {count} landmarks"
            self._event(bus_messages.INFO, "map-loaded", text)
        loading.taken.set()

    def _refuse(self, loading: Loading) -> None:
        kept = f"; '{self._map}' stays in use" if self._map else ""
        if not self._map:
            self._waiting = f"no map: {loading.refused}"
        level = bus_messages.WARNING if self._map else bus_messages.ALARM
        self._event(level, "map-refused", f"{loading.refused}{kept}")

    def _tell_waiting(self, note: FrameMessage) -> None:
        """Without a map a frame's state says so, each second: an event may have been missed."""
        now_s = time.monotonic()
        if now_s - self._told_s < _WAITING_EVERY_S:
            return
        self._told_s = now_s
        about = (self._accounting.accounts, "", time.time_ns())
        told = derive.unsolved_note(note, State.INITIALIZING, self._waiting, *about)
        self._bus.publish(bus_messages.ESTIMATE, self._payload_id, told)

    # Questions, on a thread of the bus

    def _do(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        what = request.get("do")
        if what == "relocalize":
            if self._localizer is None:
                raise GroundStationError(f"nothing to search: {self._waiting}")
            self._forget.set()
            self._event(bus_messages.INFO, "relocalize", "asked to forget the pose and to search")
            return {}
        if what == "map":
            return self._choose_map(request.get("name"))
        raise GroundStationError(f"do: {what!r:.40} is not known (known: relocalize, map)")

    def _choose_map(self, name: object) -> Mapping[str, Any]:
        settings = self._run.station.map
        folder = settings.folder_of(name)
        if folder is None:
            raise MapError(
                f"map {name!r:.80}: there is none of that name in {settings.shelf}; a plain name is"
                " needed, as 'atrium'"
            )
        loading = self._loader.begin(folder)
        if not loading.taken.wait(_ANSWER_S):
            return {"map": loading.name, "loading": True}
        if loading.refused:
            raise MapError(loading.refused)
        return {"map": loading.name, "loading": False}

    def _event(self, level: bus_messages.Level, name: str, text: str) -> None:
        note = EventMessage(time.time_ns(), "localizer", level, name, text)
        self._bus.publish(bus_messages.EVENT, self._payload_id, note)
