"""What befalls certificates while a payload flies: they are replaced, they end, one is revoked."""

from __future__ import annotations

import datetime
import json
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from intake_stand import eventually
from payload_process import PayloadProcess
from short_certificates import certify

from ground_station.stream.command import ask
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.wire import keys, messages
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.telemetry import Session, open_session
from scenarios.background import Background
from scenarios.payload_steps import NAME
from scenarios.step import Step

if TYPE_CHECKING:
    from scenarios.world import World

GUEST = "blimp-2"
_SAYS_HZ, _LIMIT_S = 5.0, 20.0


@dataclass(frozen=True)
class KeysRotated(Step):
    """One step of a rotation: the station starts with its new folder, and then the payload does."""

    STARTS: ClassVar[bool] = True

    def inject(self, world: World) -> None:
        if world.heard.payload(NAME, time.monotonic() - _LIMIT_S / 4) is None:
            world.complain("nothing is heard since the step before")
        world.kept[id(self)] = world.service.authority.rotate()
        world.hold_service(self, kill=False)
        world.let_service(self)

    def lacking(self, world: World) -> str:
        note = world.heard.payload(NAME, time.monotonic() - 1.0)
        alive = note is not None and note.alive
        return "" if alive else f"not heard with the folder before '{world.kept[id(self)]}'"

    def fix(self, world: World) -> None:
        world.configure(self, None)


@dataclass(frozen=True)
class CertificateEnds(Step):
    """The payload's certificate ends on the way, and is renewed; its SRTP key stays."""

    lasts_s: float = 8.0
    STARTS: ClassVar[bool] = True

    def inject(self, world: World) -> None:
        lasts = datetime.timedelta(seconds=self.lasts_s)
        to = world.folder / f"ending-{len(world.runs)}"
        ending = certify(world.service.authority, f"payload.{NAME}", to, lasts)
        world.configure(self, {"telemetry.certificates": str(ending)})

    def lacking(self, world: World) -> str:
        heard_s = world.heard_up_to_s()
        if not 0.0 < heard_s < self.lasts_s + 1.0:
            return f"it was heard for {heard_s:.1f} s, its certificate lasts {self.lasts_s:g} s"
        return ""

    def fix(self, world: World) -> None:
        world.configure(self, None)


@dataclass(frozen=True)
class SecondStation(Step):
    """Another station, which the payload lists, too, commands it at the same time."""

    STARTS: ClassVar[bool] = True

    def inject(self, world: World) -> None:
        listener = TelemetryListener(["tls/127.0.0.1:0"], certificates=world.second)
        both = [*world.endpoints, *listener.endpoints]
        world.configure(self, {"telemetry.connect": json.dumps(both)})
        client = world.client(world.service.certificates)
        commanding = [
            self._commanding(session, kbps).at_end(session.close).start()
            for session, kbps in ((client, 1500.0), (listener.session, 1000.0))
        ]
        world.kept[id(self)] = (commanding, listener)

    @staticmethod
    def _commanding(session: Session, kbps: float) -> Background:
        def command() -> bool:
            return ask(session, NAME, "bitrate", {"kbps": kbps}, _LIMIT_S / 10).done

        # In vain while the payload is just starting.
        return Background(command, 1.0 / _SAYS_HZ, TelemetryError)

    def lacking(self, world: World) -> str:
        commanding, _ = world.kept[id(self)]
        done = [one.acts for one in commanding]
        world.say(f"SecondStation: {done[0]} and {done[1]} commands were done")
        return "" if min(done) > 2 else f"{done[0]} and {done[1]} commands were done"

    def fix(self, world: World) -> None:
        commanding, listener = world.kept.pop(id(self))
        for one in commanding:
            one.end()
        listener.close()
        world.configure(self, None)


@dataclass(frozen=True)
class Twin(Step):
    """A second payload with the same name and the same certificate, as from a card's copy.

    What it says of itself is taken for the first one's, whose account begins anew after it.
    """

    STARTS: ClassVar[bool] = True

    def inject(self, world: World) -> None:
        settings = (
            f"payload_id={NAME}",
            "camera.uri=test:",
            "camera.rate_hz=5",
            f"link.port={world.service.video}",
            f"telemetry.connect={json.dumps([world.service.endpoint])}",
            f"telemetry.certificates={world.certificates}",
        )
        folder = world.folder / f"twin-{id(self)}"
        world.kept[id(self)] = PayloadProcess(folder, *settings)

    def lacking(self, world: World) -> str:
        twin: PayloadProcess = world.kept[id(self)]
        if not twin.running:
            return f"it ended: {twin.written()[-200:]}"
        told = any(note.name == "payload-twice" for _, note in world.heard.events)
        return "" if told else "nobody is told of it"

    def fix(self, world: World) -> None:
        world.kept.pop(id(self)).end()
        world.configure(self, None)


@dataclass(frozen=True)
class Revoked(Step):
    """Another payload's certificate is taken back while it speaks; it speaks on in vain."""

    STARTS: ClassVar[bool] = True

    def inject(self, world: World) -> None:
        authority = world.service.authority
        name = f"payload.{GUEST}"
        world.guests.add(GUEST)
        session = open_session(connect=[world.service.endpoint], certificates=authority.of(name))
        alive = session.zenoh.liveliness().declare_token(keys.key(GUEST, keys.ALIVE))
        body = messages.encode(messages.Battery(time_ns=1, voltage=3.9))

        def say() -> None:
            session.zenoh.put(keys.key(GUEST, keys.BATTERY), body)

        speaking = Background(say, 1.0 / _SAYS_HZ).at_end(session.close).start()
        world.kept[id(self)] = [speaking, 0.0, alive]
        eventually(lambda: world.heard.payload(GUEST) is not None, _LIMIT_S)
        authority.revoke(name)
        world.hold_service(self, kill=False)
        world.kept[id(self)][1] = time.monotonic()
        world.let_service(self)

    def lacking(self, world: World) -> str:
        speaking, revoked_s, _ = world.kept[id(self)]
        if world.heard.payload(GUEST, revoked_s) is not None:
            return f"{GUEST} is heard"
        return "" if speaking.failure is None else f"it fell silent: {speaking.failure}"

    def fix(self, world: World) -> None:
        speaking, *_ = world.kept.pop(id(self))
        speaking.end()
