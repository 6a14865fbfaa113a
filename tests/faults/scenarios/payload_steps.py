"""What befalls the payload: its process, clock, camera, encoder, gauge and card."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from standing import is_stopped
from vehicle import Vehicle

from scenarios import disk
from scenarios.background import Background
from scenarios.step import Step

if TYPE_CHECKING:
    from scenarios.world import World

NAME = "blimp-1"

GAUGES = {
    "absent": "i2c:ina219@91:0x40",
    "failing": "i2c:ina219@92:0x40",
    "nonsense": "i2c:ina219@93:0x40",
    "none": "i2c:max17048@98:0x36",
    "stuck": "i2c:ina219@99:0x40",
}
_ENCODER_GIVES_NONE = 1
_UNDERVOLTAGE, _THROTTLED = 0x1, 0x4
_HELD_BACK_S = 0.02
_NOISE_BYTES = 200


@dataclass(frozen=True)
class PayloadKilled(Step):
    """SIGKILL, as when the supply's contact is lost; it starts again when that is repaired."""

    STARTS: ClassVar[bool] = True

    def inject(self, world: World) -> None:
        world.hold_payload(self, kill=True)

    def lacking(self, world: World) -> str:
        return "" if world.run.killed else "it flies on"

    def fix(self, world: World) -> None:
        world.let_payload(self)


@dataclass(frozen=True)
class PayloadRestarted(PayloadKilled):
    """It ends in order and starts as another session."""

    def inject(self, world: World) -> None:
        world.hold_payload(self)

    def lacking(self, world: World) -> str:
        return "" if world.run.ended else "it flies on"


@dataclass(frozen=True)
class PayloadStopped(Step):
    """SIGSTOP, as when its card holds it up; SIGCONT."""

    def inject(self, world: World) -> None:
        world.kept[id(self)] = world.run
        world.run.send(signal.SIGSTOP)

    def lacking(self, world: World) -> str:
        return "" if is_stopped(world.run.process.pid) else "it runs"

    def fix(self, world: World) -> None:
        run = world.kept.pop(id(self))
        if run.ended is None:
            run.send(signal.SIGCONT)


@dataclass(frozen=True)
class PayloadClock(Step):
    """Its wall clock is set by so many seconds, and set right again."""

    by_s: float = 3600.0
    SIDE: ClassVar[str] = "payload"

    def inject(self, world: World) -> None:
        world.disturb(self, self.SIDE, "stepped_clock", int(1e9 * self.by_s))

    def lacking(self, world: World) -> str:
        return "" if world.shims else "no shim sets it"

    def fix(self, world: World) -> None:
        world.disturb(self, self.SIDE, "stepped_clock", 0)


@dataclass(frozen=True)
class CameraFault(Step):
    """It flies with another camera: one of `scenarios.camera.NAMES`."""

    kind: str = "black"
    STARTS: ClassVar[bool] = True

    def lacking(self, world: World) -> str:
        return "" if world.run.camera is world.cameras.get(self.kind) else "another camera flies"

    def inject(self, world: World) -> None:
        world.configure(self, {"camera": self.kind})

    def fix(self, world: World) -> None:
        world.configure(self, None)


@dataclass(frozen=True)
class GaugeFault(Step):
    """It flies with a gauge that is absent, fails, or talks nonsense: one of `GAUGES`."""

    kind: str = "nonsense"
    STARTS: ClassVar[bool] = True

    def lacking(self, world: World) -> str:
        note = world.heard.payload(NAME)
        battery = note.battery if note is not None else None
        if battery is None or battery.time_ns / 1e9 < time.time() - 2.0:
            return ""
        return "" if battery.refused + battery.read_errors else "all readings are good"

    def inject(self, world: World) -> None:
        options = {"battery.uri": GAUGES[self.kind], "battery.period_s": "0.2"}
        world.configure(self, options)

    def fix(self, world: World) -> None:
        world.configure(self, None)


@dataclass(frozen=True)
class Undervoltage(Step):
    """The supply is too low, and the board halves its clock: it stands still half of the time."""

    def inject(self, world: World) -> None:
        world.disturb(self, "payload", "board_state", _UNDERVOLTAGE | _THROTTLED)

        def hold_back() -> None:
            run = world.run
            run.send(signal.SIGSTOP)
            time.sleep(_HELD_BACK_S)
            run.send(signal.SIGCONT)

        world.kept[id(self)] = Background(hold_back, _HELD_BACK_S).start()

    def lacking(self, world: World) -> str:
        told = [alarm["text"] for alarm in world.service.state()["alarms"]]
        return "" if any("undervoltage" in text for text in told) else f"the page says {told}"

    def fix(self, world: World) -> None:
        world.kept.pop(id(self)).end()
        world.disturb(self, "payload", "board_state", 0)


@dataclass(frozen=True)
class LineNoise(Step):
    """An armed vehicle on a serial line that garbles: noise between all that it says."""

    STARTS: ClassVar[bool] = True

    def inject(self, world: World) -> None:
        vehicle = Vehicle(world.folder / f"line-{id(self)}")
        draw = world.draw()

        def speak() -> None:
            os.write(vehicle.master, draw.randbytes(_NOISE_BYTES))
            vehicle.live(armed=True)
            os.write(vehicle.master, draw.randbytes(_NOISE_BYTES))
            vehicle.listen()

        speaking = Background(speak, 0.2).at_end(vehicle.unplug).start()
        world.kept[id(self)] = speaking
        world.configure(self, {"autopilot.uri": f"serial:{vehicle.link}"})

    def lacking(self, world: World) -> str:
        speaking: Background = world.kept[id(self)]
        note = world.heard.payload(NAME)
        autopilot = note.autopilot if note is not None else None
        if speaking.failure is not None:
            return f"the line fell silent: {speaking.failure}"
        armed = autopilot is not None and autopilot.armed
        return "" if armed and speaking.acts else f"it is not heard to be armed: {autopilot}"

    def fix(self, world: World) -> None:
        world.configure(self, None)
        world.kept.pop(id(self)).end()


@dataclass(frozen=True)
class EncoderStalls(Step):
    """The encoder takes pictures and gives none."""

    STARTS: ClassVar[bool] = True

    def inject(self, world: World) -> None:
        world.disturb(self, "payload", "encoder_fault", _ENCODER_GIVES_NONE)

    def lacking(self, world: World) -> str:
        silent_s = time.monotonic() - max(world.run.watch.at_s, default=0.0)
        return "" if silent_s > self.for_s / 2 else f"it gave a frame {silent_s:.1f} s ago"

    def fix(self, world: World) -> None:
        world.disturb(self, "payload", "encoder_fault", 0)


@dataclass(frozen=True)
class CardFault(Step):
    """The payload's card fails: one of `disk.KINDS`.

    The recording ends with it, but for a card that stalls, and it flies on.
    """

    kind: str = "full"

    def inject(self, world: World) -> None:
        window = world.end_recording("card") if self.kind != disk.STALLS else [0.0, 0.0]
        world.kept[id(self)] = (world.run, window, world.befell("payload"))
        if self.kind in disk.ERRORS:
            world.disturb(self, "payload", "file_fault", disk.ERRORS[self.kind])
        else:
            disk.limit_files(world.run.process.pid, disk.size_now(world.card))

    def lacking(self, world: World) -> str:
        if self.kind in disk.ERRORS and world.befell("payload") == world.kept[id(self)][2]:
            return "it wrote nothing"
        note = world.heard.payload(NAME)
        file = note.recording if note is not None else ""
        if self.kind == disk.STALLS:
            return "" if file else "it does not record any more"
        return f"it records into {file}" if file else ""

    def fix(self, world: World) -> None:
        run, window, _ = world.kept.pop(id(self))
        window[1] = time.monotonic()
        world.disturb(self, "payload", "file_fault", 0)
        if run.ended is None:
            disk.limit_files(run.process.pid, None)
        world.command("record-start")
