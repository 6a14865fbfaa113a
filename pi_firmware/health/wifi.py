"""The radio's watch: power save off, its signal, and a restart when the link hangs."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pi_firmware.health import radio
from pi_firmware.health.radio import ProgramError
from pi_firmware.settings import WifiSettings
from pi_firmware.wire import messages

_LONGEST_PAUSE_S = 600.0
_OFF_S = 1.0
_ON_ATTEMPTS = 3
_FIRST_ON_PAUSE_S = 5.0
_POWER_SAVE_S = 60.0  # a network manager that connects again may switch it on
_ASK_SIGNAL_S = 5.0  # by a program, where the kernel has no file for it
_STALE_S = 10.0  # a signal read longer ago says nothing: the driver hangs
_JOIN_LIMIT_S = 8.0  # an `ip` that hangs, twice, and its end


@dataclass(frozen=True)
class WifiState:
    """The radio for the health message; None: it is not connected, or cannot tell."""

    interface: str = ""
    signal_dBm: float | None = None
    quality: float | None = None  # 0 to 1
    restarts: int = 0


class Wifi:
    """Keeps the radio awake and restarts it when a ground station, once heard, falls silent.

    The silence allowed doubles with each restart, up to 10 minutes, until the ground is heard
    again. A radio that was left switched off is switched on. What fails is announced once, as
    `radio-failed`, and tried again; the flight goes on. `heard`, `step` and `state` never wait: the
    work is done on a thread of its own, whatever a driver does. `announce` gets an event's name and
    text, on that thread; `off_s` is how long a restart leaves the radio off. Raises `ConfigError`
    for a name that no interface can have.
    """

    def __init__(
        self,
        settings: WifiSettings,
        announce: Callable[[str, str], None],
        *,
        root: Path = Path("/"),
        run: radio.Run = radio.run,
        clock: Callable[[], float] = time.monotonic,
        off_s: float = _OFF_S,
    ) -> None:
        self._wanted = settings.interface and radio.check_name(settings.interface)
        self._restart_after_s, self._off_s = settings.restart_after_s, off_s
        self._announce, self._root, self._run, self._clock = announce, root, run, clock
        self._lock = threading.Lock()
        self._heard_at: float | None = None
        self._pause_s = self._restart_after_s
        self._restarted_at = float("-inf")
        self._state = WifiState()
        self._signal_at = self._power_save_at = self._on_at = float("-inf")
        self._on_pause_s = _FIRST_ON_PAUSE_S
        self._known: tuple[str, int | None] | None = None
        self._failing: set[str] = set()
        self._wake, self._end = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def state(self) -> WifiState:
        """The radio as of the last round."""
        state = self._state
        if self._clock() - self._signal_at > _STALE_S:
            return WifiState(state.interface, restarts=state.restarts)
        return state

    def heard(self) -> None:
        with self._lock:
            self._heard_at = self._clock()
            self._pause_s = self._restart_after_s

    def step(self) -> None:
        """Call it about once a second: has the thread look after the radio."""
        if not self._wanted or self._end.is_set():
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="wifi", daemon=True)
            self._thread.start()
        self._wake.set()

    def stop(self) -> None:
        """Ends the thread; a restart that is under way switches the radio on first."""
        self._end.set()
        self._wake.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_JOIN_LIMIT_S)

    def look(self) -> None:
        """One round on the calling thread; it waits for programs."""
        name = radio.find(self._root, self._wanted) if self._wanted else None
        if name is None:
            self._state = WifiState(restarts=self._state.restarts)
            if self._wanted not in ("", radio.AUTO) and radio.exists(self._root, self._wanted):
                self._failed("interface", f"{self._wanted} is no radio")
            return
        known = (name, radio.index(self._root, name))
        fresh, self._known = known != self._known, known
        if fresh:
            self._keep_awake(name, at_once=True)
        if self._restart_after_s > 0:
            self._keep_linked(name)
        self._keep_awake(name)
        self._read_signal(name)

    def _work(self) -> None:
        while not self._end.is_set():
            self._wake.wait()
            self._wake.clear()
            if self._end.is_set():
                return
            try:
                self.look()
            except Exception as error:  # whatever it is, a flight does not end for its watch
                self._failed("watch", f"{type(error).__name__}: {error}")

    def _keep_linked(self, name: str) -> None:
        if radio.is_down(self._root, name):
            self._switch_on(name)
            return
        self._on_at, self._on_pause_s = float("-inf"), _FIRST_ON_PAUSE_S
        if self._is_silent() and not self._end.is_set():
            self._restart(name)

    def _is_silent(self) -> bool:
        with self._lock:
            if self._heard_at is None:
                return False
            return self._clock() - max(self._heard_at, self._restarted_at) >= self._pause_s

    def _restart(self, name: str) -> None:
        with self._lock:
            heard_at = self._heard_at or 0.0
            silent_s = self._clock() - heard_at
        fault = self._switched(name, "down")
        # Whatever came of that, it is switched on: an `ip` that hung may have done its work.
        on_fault: ProgramError | None = None
        for _ in range(_ON_ATTEMPTS):
            self._end.wait(self._off_s)
            on_fault = self._switched(name, "up")
            if on_fault is None:
                break
        with self._lock:
            self._restarted_at = self._clock()
            if self._heard_at == heard_at:
                self._pause_s = min(self._pause_s * 2, max(_LONGEST_PAUSE_S, self._restart_after_s))
        self._keep_awake(name, at_once=True)
        if fault or on_fault:
            self._failed("restart", str(on_fault or fault))
            return
        self._failing.discard("restart")
        count = self._state.restarts + 1
        self._state = WifiState(name, restarts=count)
        self._try_announce(
            messages.EVENT_RADIO_RESTARTED,
            f"{name} was restarted, the ground was silent for {silent_s:.0f} s (restart {count})",
        )

    def _switch_on(self, name: str) -> None:
        """For a radio that a killed process, or a restart that failed, has left switched off."""
        now = self._clock()
        if now < self._on_at:
            return
        self._on_at = now + self._on_pause_s
        self._on_pause_s = min(self._on_pause_s * 2, _LONGEST_PAUSE_S)
        fault = self._switched(name, "up")
        if fault:
            self._failed("restart", str(fault))

    def _switched(self, name: str, to: str) -> ProgramError | None:
        try:
            radio.switch(self._run, name, to)
        except ProgramError as error:
            return error
        return None

    def _keep_awake(self, name: str, at_once: bool = False) -> None:
        now = self._clock()
        if not at_once and now - self._power_save_at < _POWER_SAVE_S:
            return
        self._power_save_at = now
        try:
            if at_once or not radio.power_save_is_off(self._run, name):
                radio.set_power_save_off(self._run, name)
        except ProgramError as error:
            self._failed("power save", str(error))
        else:
            self._failing.discard("power save")

    def _read_signal(self, name: str) -> None:
        now = self._clock()
        restarts = self._state.restarts
        signal: float | None = None
        if radio.tells_signal(self._root):
            signal = radio.signal_dbm(self._root, name)
        elif now - self._signal_at < _ASK_SIGNAL_S:
            return
        else:
            with contextlib.suppress(ProgramError):
                signal = radio.asked_signal_dbm(self._run, name)
        self._signal_at = self._clock()
        quality = None if signal is None else radio.quality(signal)
        self._state = WifiState(name, signal, quality, restarts)

    def _failed(self, what: str, reason: str) -> None:
        if what not in self._failing:
            self._failing.add(what)
            self._try_announce(messages.EVENT_RADIO_FAILED, f"{what}: {reason}")

    def _try_announce(self, name: str, text: str) -> None:
        with contextlib.suppress(Exception):  # a link that fails is why we are here
            self._announce(name, text)
