"""What faults befall: the whole service, a payload's program, and the links between them."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import random
import re
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import httpx
from impaired_link import CLEAN, ImpairedLink, Impairment
from intake_stand import eventually
from payload_process import PayloadProcess
from shims import Shim
from standing import Process, Service

from ground_station.stream.command import ask
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.srtp import KEY_FILE, read_key
from pi_firmware.wire.telemetry import Session, open_session
from scenarios import disk
from scenarios.camera import Cameras
from scenarios.heard import Heard
from scenarios.payload_run import PayloadRun, Watch
from scenarios.payload_steps import NAME
from scenarios.recordings import Window
from scenarios.tcp_wire import TcpWire

RATE_HZ = 10.0
SPEED = 0.5
"""Of the recorded flight: a machine that is busy, too, skips frames and still tracks."""
_PEAK = re.compile(r"VmHWM:\s+(\d+) kB")
_TICK_S, _LOOK_S, _TIMEOUT_S = 0.05, 0.5, 2.0
HOPELESS = 3
"""The payload's exit status by which systemd starts it again."""
_SHIMS = {
    "payload": ("stepped_clock", "encoder_fault", "file_fault", "board_state"),
    "ground": ("stepped_clock", "file_fault"),
}


class Station(Service):
    """The service with variables in its environment, such as a shim's."""

    def __init__(self, folder: Path, *settings: str, env: Mapping[str, str]) -> None:
        super().__init__(folder, *settings)
        self.command = ["env", *(f"{name}={value}" for name, value in env.items()), *self.command]


def shims_there() -> bool:
    """Whether shims can be made here."""
    return shutil.which("cc") is not None


class World:
    """A service that records, a payload that flies to it and records; a context manager.

    Steps change it by what is below; more than one may hold the payload or the service down, and
    it comes back when the last of them lets go.
    """

    def __init__(
        self, folder: Path, cameras: Cameras, *, disk_MB: int = 0, foxglove: bool = False,
        seed: int = 0,
        rate_hz: float = RATE_HZ,
    ) -> None:  # fmt: skip
        folder = folder.resolve()  # service and payload run in folders of their own
        self.folder = folder
        self.cameras = cameras
        self.heard = Heard()
        self.runs: list[PayloadRun] = []
        self.said: list[str] = []
        """What happened and when, for a person."""
        self.complaints: list[str] = []
        """What did not end or begin as it should."""
        self.guests: set[str] = set()
        """Payloads beside ours that a step lets be heard."""
        self.peaks_MB: dict[str, float] = {}
        """The most resident memory of each process so far, and of those before it."""
        self.ended_s: dict[str, list[Window]] = {"ground": [], "card": []}
        """When something ended a recording, and until when it may have, by whose it was."""
        self.intake_anew_s: list[float] = []
        """When the intake was killed: alone, with the service, or by its parent for its silence."""
        self._intake: tuple[Process, float] | None = None
        self._looked_s = 0.0
        self.kept: dict[int, Any] = {}
        """What a step needs to fix itself, by its id()."""
        self.service_runs = 0
        self._rate_hz = rate_hz
        self._draw = random.Random(seed)
        self._options: dict[int, dict[str, str]] = {}
        self._shimmed: dict[tuple[str, str], dict[int, int]] = {}
        self._impairments: dict[int, Impairment] = {}
        self._held: dict[str, set[int]] = {"payload": set(), "service": set()}
        self._stack = contextlib.ExitStack()
        self._bus = contextlib.ExitStack()
        self._began_s = time.monotonic()
        self.card = folder / "card"
        self.shims: dict[tuple[str, str], Shim] = {}
        """By whose they are, `payload` or `ground`, and their name."""
        folder.mkdir(parents=True, exist_ok=True)
        self.card.mkdir()
        for whose, names in _SHIMS.items() if shims_there() else ():
            (folder / whose).mkdir()
            for name in names:
                self.shims[whose, name] = Shim(folder / whose, name)
        self.service = Station(
            folder,
            f"foxglove.enabled={json.dumps(foxglove)}",
            "recording.at_start=true",
            env=self._env("ground"),
        )
        self.certificates = self.service.authority.of(f"payload.{NAME}")
        self.second = self.service.authority.add("ground", "second")
        """The folder of another station that the payload lists, too."""
        self.disk = disk.mount(self.service.recordings, disk_MB) if disk_MB else None

    def __enter__(self) -> World:
        try:
            self._stack.callback(self._bus.close)
            self._stack.enter_context(self.service)
            self._listen()
            self.link = self._stack.enter_context(
                ImpairedLink(self.service.video, tap=self._tap, seed=self._draw.randrange(1 << 30))
            )
            port = int(self.service.endpoint.rpartition(":")[2])
            self.wire = self._stack.enter_context(TcpWire(port))
            self.endpoints = [f"tls/127.0.0.1:{self.wire.port}"]
            self._fly()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends whatever still runs, the hard way."""
        for run in self.runs:
            if run.ended is None:
                run.kill()
        self._bus.close()
        if self.service.process.poll() is None:
            self.service.kill()
        self._stack.close()
        if self.disk is not None:
            self.disk.unmount(keep=self.folder / "disk")

    def say(self, text: str) -> None:
        """Notes what happens, with its time."""
        self.said.append(f"{time.monotonic() - self._began_s:6.1f} s  {text}")

    def end_recording(self, whose: str) -> Window:
        """Something ends the recording of `ground` or `card` now; its window can be prolonged."""
        now_s = time.monotonic()
        self.ended_s[whose].append(window := [now_s, now_s])
        return window

    def draw(self) -> random.Random:
        """Chance, by the world's seed."""
        return random.Random(self._draw.randrange(1 << 30))

    # The payload

    @property
    def run(self) -> PayloadRun:
        """The payload's newest process."""
        return self.runs[-1]

    def hold_payload(self, step: object, *, kill: bool = False) -> None:
        """Ends the payload until it is let go."""
        self._held["payload"].add(id(step))
        if self.run.ended is None:
            if kill:
                self.end_recording("card")
                self.run.kill()
            else:
                self._end_payload()

    def let_payload(self, step: object) -> None:
        """Starts it again, unless another step holds it, too."""
        self._held["payload"].discard(id(step))
        self.tend()

    def configure(self, step: object, options: Mapping[str, str] | None) -> None:
        """The payload flies with these options from now on: None takes the step's away again."""
        self._options.pop(id(step), None)
        if options is not None:
            self._options[id(step)] = dict(options)
        if self.run.ended is None:
            self._end_payload()
        self.tend()

    def tend(self) -> None:
        """What an init system does: a payload that has ended, and is wanted, is started."""
        self._look()
        run = self.run
        if run.ended is None and not run.process.running:
            run.note_end()
            assert run.ended is not None
            if run.ended.status == HOPELESS:
                self.say(f"the payload ended for a new one: {run.ended.err.strip()[-160:]}")
            else:
                self.complain(f"the payload ended with {run.ended.status}: {run.ended.err[-300:]}")
        if run.ended is not None and not self._held["payload"]:
            self._fly()

    def _look(self) -> None:
        """Follows the processes' memory, and the intake.

        Its parent ends one that a busy machine keeps silent for long, whatever is injected.
        """
        now_s = time.monotonic()
        if now_s - self._looked_s < _LOOK_S:
            return
        self._looked_s = now_s
        for name, pid in self.pids().items():
            kind = name.partition("/")[0]
            self.peaks_MB[kind] = max(self.peaks_MB.get(kind, 0.0), peak_MB(pid))
        found, before = self.child("intake"), self._intake
        if before is not None and found != before[0]:
            self.say("the intake's process ended")
            self.intake_anew_s.append(before[1])
            self.ended_s["ground"].append([before[1], now_s])
        self._intake = None if found is None else (found, now_s)

    def _end_payload(self) -> None:
        try:
            self.run.end()
        except Exception as error:
            self.complain(f"the payload did not end: {type(error).__name__}")
            self.run.kill()

    def _fly(self) -> None:
        options = {"camera": "flight"}
        for more in self._options.values():
            options |= more
        camera = self.cameras.get(options.pop("camera"))
        rate_hz = self._rate_hz / SPEED  # of the recording's own seconds
        flies = camera.uri.startswith("replay:")
        pace = f"&rate_hz={rate_hz:g}&speed={SPEED:g}" if flies else ""
        folder = self.folder / f"payload-{len(self.runs)}"
        settings = {
            "payload_id": NAME,
            "camera.uri": camera.uri + pace,
            "camera.rate_hz": f"{self._rate_hz:g}",
            "link.correction": "0",
            "link.port": str(self.link.port),
            "link.history_s": "0",  # what the link loses stays lost: each frame can be told
            "telemetry.connect": json.dumps(self.endpoints),
            "telemetry.certificates": str(self.certificates),
            "recording.folder": str(self.card),
            "recording.at_start": "true",
            "recording.min_free_MB": "0",
            **options,
        }
        card = sorted(path.name for path in self.card.iterdir())
        process = PayloadProcess(
            folder,
            *(f"{name}={value}" for name, value in settings.items()),
            env=self._env("payload"),
        )
        watch = Watch({NAME: read_key(self.certificates / KEY_FILE)})
        self.runs.append(PayloadRun(camera, process, time.monotonic(), watch, card))

    def _env(self, whose: str) -> dict[str, str]:
        env: dict[str, str] = {}
        for one in (shim.env for (owner, _), shim in self.shims.items() if owner == whose):
            preload = ":".join(filter(None, (env.get("LD_PRELOAD"), one["LD_PRELOAD"])))
            env |= one | {"LD_PRELOAD": preload}
        return env

    def _tap(self, datagram: bytes, lost: bool) -> None:
        self.run.watch(datagram, lost)

    def disturb(self, step: object, whose: str, name: str, number: int) -> None:
        """A step sets a shim's number, 0 no more; times of several steps add up.

        Of several faults at once it is the first that still is one.
        """
        numbers = self._shimmed.setdefault((whose, name), {})
        numbers[id(step)] = number
        if shim := self.shims.get((whose, name)):
            faults = [one for one in numbers.values() if one]
            shim.set(sum(faults) if name == "stepped_clock" else (faults or [0])[0])

    def client(self, certificates: Path) -> Session:
        """A session of a second program with some machine's certificate, linked with the station.

        With the station's own it is as `blimp command`'s: its words are handed on to the payloads.
        """
        at = [self.service.endpoint]
        return open_session(connect=at, certificates=certificates, client_timeout_s=_TIMEOUT_S)

    def command(self, name: str) -> None:
        """Has the payload do something, if it is there."""
        with contextlib.suppress(TelemetryError):
            session = self.client(self.service.certificates)
            try:
                ask(session, NAME, name)
            finally:
                session.close()

    def befell(self, whose: str) -> int:
        """How often a disk has failed so far, the payload's card or the ground's."""
        return self.shims[whose, "file_fault"].befell if self.shims else 0

    def heard_up_to_s(self) -> float:
        """The payload's uptime in the newest of its health that the ground has; 0 without."""
        note = self.heard.payload(NAME)
        return note.health.uptime_s if note is not None and note.health is not None else 0.0

    # The link

    def impair(self, step: object, impairment: Impairment | None) -> None:
        """The link does this, too; None: no more. Shares of several steps add up."""
        self._impairments.pop(id(step), None)
        if impairment is not None:
            self._impairments[id(step)] = impairment
        self.link.impair(combined(list(self._impairments.values())))

    # The service

    def hold_service(self, step: object, *, kill: bool = True) -> None:
        """Ends the whole service until it is let go."""
        self._held["service"].add(id(step))
        if self.service.process.poll() is not None:
            return
        self.end_recording("ground")
        self.intake_anew_s.append(time.monotonic())
        self._bus.close()
        if kill:
            self.service.kill()
            self._try(self.service.assert_nobody_left, "after SIGKILL")
        else:
            self._try(self.service.end, "its end")

    def let_service(self, step: object) -> None:
        """Starts it again, unless another step holds it, too."""
        self._held["service"].discard(id(step))
        if not self._held["service"] and self.service.process.poll() is not None:
            self.service.start()
            self._listen()

    def pids(self) -> dict[str, int]:
        """All processes that fly or serve now, by their names."""
        pids = {"payload": self.run.process.pid}
        if self.service.process.poll() is None:
            pids["station"] = self.service.process.pid
            pids |= {name: one.pid for name, one in self.service.processes().items()}
        return pids

    def child(self, name: str) -> Process | None:
        """A process of the service now: by its name, `localizer` for the payload's, `station`."""
        if self.service.process.poll() is not None:
            return None
        if name == "station":
            return self.service.parent()
        return self.service.processes().get(f"localizer/{NAME}" if name == "localizer" else name)

    def record(self, limit_s: float = 20.0) -> None:
        """The dashboard's button, pressed until the ground records."""
        until_s = time.monotonic() + limit_s
        while time.monotonic() < until_s:
            with contextlib.suppress(httpx.HTTPError, AssertionError):
                if self.recording():
                    return
                self.service.client.post("/api/recording", json={"active": True})
            time.sleep(0.3)

    def _listen(self) -> None:
        run, self.service_runs = self.service_runs, self.service_runs + 1
        self.heard.listen(self._bus.enter_context(self.service.bus()), run)

    def recording(self) -> bool:
        """Whether the ground says that it records."""
        told = self.service.state()["recording"]
        return told is not None and bool(told["active"])

    def complain(self, text: str) -> None:
        """Something broke an invariant on the way."""
        self.say(f"BROKEN {text}")
        self.complaints.append(text)

    def _try(self, what: Callable[[], object], name: str) -> None:
        try:
            what()
        except Exception as error:
            self.complain(f"service, {name}: {type(error).__name__}: {str(error)[-600:]}")

    # Its end

    def finish(self) -> None:
        """Payload and service end in order; all that was on its way has come by then."""
        with contextlib.suppress(AssertionError):
            eventually(lambda: self.link.idle, 10.0)
        if self.run.ended is None:
            self.end_recording("card")
            self._end_payload()
        counts = self.run.ended.counts if self.run.ended else {}
        with contextlib.suppress(AssertionError):
            eventually(lambda: self._settled(counts), 15.0)
        told = -1
        while told != (told := len(self.heard.estimates())):
            time.sleep(1.0)
        self.end_recording("ground")
        self._try(self.service.end, "its end")
        self._bus.close()

    def _settled(self, counts: Mapping[str, int]) -> bool:
        note = self.heard.payload(NAME)
        said = note.frames if note is not None else {}
        return all(said.get(name) == value for name, value in counts.items())


def combined(impairments: list[Impairment]) -> Impairment:
    """All of them at once: shares and times add up, shares to less than 1."""
    result = CLEAN
    for one in impairments:
        result = dataclasses.replace(
            result,
            **{
                name: min(0.95, getattr(result, name) + getattr(one, name))
                for name in ("loss", "burst_start", "reorder", "duplicate", "delay_s", "jitter_s")
            },
            burst_end=min(result.burst_end, one.burst_end),
            burst_loss=max(result.burst_loss, one.burst_loss),
            reorder_by=max(result.reorder_by, one.reorder_by),
        )
    return result


def peak_MB(pid: int) -> float:
    """The most memory that a process was resident with (proc(5), VmHWM); 0 when it has gone."""
    with contextlib.suppress(OSError):
        found = _PEAK.search(Path(f"/proc/{pid}/status").read_text())
        return 1.024e-3 * int(found[1]) if found else 0.0
    return 0.0


def tick(world: World) -> None:
    """A moment in which the world is looked after."""
    world.tend()
    time.sleep(_TICK_S)
