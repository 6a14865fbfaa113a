"""What the ground may ask for: each command by name, with its numbers and their ranges.

Who may ask is settled before: by the access rules of the certificates, or by loopback.
"""

from __future__ import annotations

import dataclasses
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from queue import Empty, Full, Queue

from pi_firmware.capture import Capture
from pi_firmware.recording import Recorder
from pi_firmware.settings import CameraSettings, EncoderSettings, Settings
from pi_firmware.wire.config import range_of
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.messages import Answer, Command

_WAITING = 8
_JOIN_LIMIT_S = 2.0

FORCED = "forced"
"""Among the values of what was done although it is refused otherwise."""

Values = Mapping[str, float]


class Refusal(BlimpError):
    """A command that is not carried out, and why."""


@dataclass(frozen=True)
class Action:
    """What a command does: `run` gets its numbers by name and returns what is set now.

    `numbers` has the range of each; `needed` must be given. `run` raises `BlimpError` to refuse.
    """

    run: Callable[..., Values | None]
    numbers: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    needed: frozenset[str] = frozenset()


class Commands:
    """Carries out one command after the other on a thread of its own, and answers each.

    `announce` gets a text of each, so that telemetry and recordings tell who was asked what.
    """

    def __init__(self, actions: Mapping[str, Action], announce: Callable[[str], None]) -> None:
        self._actions = actions
        self._announce = announce
        self._waiting: Queue[tuple[str, Command, Callable[[Answer], None]]] = Queue(_WAITING)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="commands", daemon=True)
        self._thread.start()

    def ask(self, name: str, command: Command, answer: Callable[[Answer], None]) -> None:
        """Queues a command; `answer` is called when it was carried out or refused."""
        try:
            self._waiting.put_nowait((name, command, answer))
        except Full:
            answer(_refused(f"{_WAITING} commands wait already"))

    def carry_out(self, name: str, command: Command) -> Answer:
        try:
            values = self._action(name, command.arguments).run(**command.arguments)
        except BlimpError as error:
            return _refused(str(error))
        except Exception as error:  # a command must never end a flight
            return _refused(f"{type(error).__name__}: {error}")
        return Answer(time_ns=time.time_ns(), done=True, values=dict(values or {}))

    def close(self) -> None:
        """Ends the thread; what still waits gets no answer."""
        self._closing.set()
        if self._thread is not threading.current_thread():
            self._thread.join(_JOIN_LIMIT_S)

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                name, command, answer = self._waiting.get(timeout=0.2)
            except Empty:
                continue
            done = self.carry_out(name, command)
            answer(done)
            forced = ", forced" if FORCED in done.values else ""
            self._announce(f"{name}: {'done' if done.done else done.reason}{forced}")

    def _action(self, name: str, given: Mapping[str, float]) -> Action:
        """What a command does, which takes these numbers; raises `Refusal`."""
        if name not in self._actions:
            known = ", ".join(sorted(self._actions))
            raise Refusal(f"no command {name[:40]!r} (there are: {known})")
        action = self._actions[name]
        for number in given:
            if number not in action.numbers:
                known = ", ".join(action.numbers) or "none"
                raise Refusal(f"{name}: unknown number {number[:40]!r} (it takes: {known})")
        for number in sorted(action.needed - set(given)):
            raise Refusal(f"{name}: '{number}' is missing")
        for number, value in given.items():
            low, high = action.numbers[number]
            if not (math.isfinite(value) and low <= value <= high):
                raise Refusal(f"{name}: '{number}' is {value:g}; allowed: {low:g} to {high:g}")
        return action


def _refused(reason: str) -> Answer:
    return Answer(time_ns=time.time_ns(), done=False, reason=reason)


_EXPOSURE_LIMIT_S = 10.0


def actions(
    settings: Settings,
    capture: Capture,
    recorder: Recorder,
    end: Callable[[list[str]], object],
    armed: Callable[[], bool],
) -> dict[str, Action]:
    """The commands by name; `end` ends the flight and then runs the words it is given.

    Those that interrupt the video are refused while the autopilot is `armed`, unless `force` is 1.
    """

    def set_bitrate(kbps: float) -> Values:
        return {"kbps": capture.set_bitrate(round(kbps))}

    def expose(exposure_s: float | None = None, gain: float | None = None) -> Values:
        now = capture.camera
        camera = dataclasses.replace(
            now,
            exposure_s=now.exposure_s if exposure_s is None else exposure_s,
            gain=now.gain if gain is None else gain,
        )
        if not capture.live:
            raise Refusal("a recording is exposed already")
        try:
            capture.ask_for(camera).result(_EXPOSURE_LIMIT_S)
        except TimeoutError:
            raise Refusal(f"the camera did not answer within {_EXPOSURE_LIMIT_S:g} s") from None
        return {"exposure_s": camera.exposure_s, "gain": camera.gain}

    def record() -> None:
        recorder.start()

    def end_recording() -> None:
        if not recorder.stop():
            raise Refusal("nothing was recorded")

    def end_with(key: str, command: list[str]) -> Callable[[], None]:
        def run() -> None:
            if not command:
                raise Refusal(f"'{key}' is empty: this payload does not know how")
            end(command)

        return run

    def disarmed(
        run: Callable[..., Values | None], numbers: Mapping[str, tuple[float, float]] = {}
    ) -> Action:
        def guarded(force: float = 0, **given: float) -> Values:
            if armed() and not force:
                raise Refusal("the autopilot is armed: disarm it, or say force=1")
            values = run(**given) or {}
            return {**values, FORCED: 1} if force else values

        return Action(guarded, {**numbers, "force": (0, 1)})

    slowest, _ = range_of(EncoderSettings, "min_bitrate_kbps")
    _, fastest = range_of(EncoderSettings, "bitrate_kbps")
    exposures = {name: range_of(CameraSettings, name) for name in ("exposure_s", "gain")}
    off = end_with("battery.shutdown_command", settings.battery.shutdown_command)
    reboot = end_with("supervision.reboot_command", settings.supervision.reboot_command)
    return {
        "idr": Action(capture.force_idr),
        "bitrate": Action(set_bitrate, {"kbps": (slowest, fastest)}, frozenset({"kbps"})),
        "exposure": disarmed(expose, exposures),
        "record-start": Action(record),
        "record-stop": Action(end_recording),
        "shutdown": disarmed(off),
        "reboot": disarmed(reboot),
    }
