"""Ground stations side by side: each one's page shows the payloads of all.

A station tells the others, over mutual TLS, of the payloads that fly with it: what its bus says of
them, the pictures that somebody elsewhere looks at, and its alarms. Nothing is decided in common:
each flies on alone when the others go.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from ground_station.service import bus_messages
from ground_station.service.alarms import Alarm
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    LeaveMessage,
    Level,
    Message,
    N,
    PayloadMessage,
    RecordingMessage,
)
from ground_station.service.fleet.allocation import Allocation, Peer, Pin
from ground_station.service.fleet.maps import MAP, MapFiles, OwnMaps, fetch
from ground_station.service.fleet.messages import (
    ALARMS,
    MESSAGE_BYTES,
    PAYLOADS,
    ROOT,
    SESSION,
    WANTS,
    StationMessage,
    rules,
)
from ground_station.service.fleet.shelf import TIMEOUT_S, Elsewhere, Shelf, ask, read
from ground_station.service.fleet.whereabouts import Whereabouts
from ground_station.service.settings import StationSettings
from pi_firmware.wire import credentials
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.keys import check_payload_id
from pi_firmware.wire.refusal import refusal
from pi_firmware.wire.telemetry import open_session

_TELL_S = 0.5
_SEEN_HZ, _WATCHED_HZ = 5.0, 15.0
"""Poses of a payload that somebody elsewhere looks at go there more often, with its points."""
_LOOK_S = 5.0
_OVERLOADED_S = 2.0
_INTAKE, _LOCALIZER = "intake", "localizer/"
_COMMAND = "payload-command"
_ASKED = "asked"
_RECORDINGS = "recordings"

Take = Callable[[str, Any], None]


_TOLD: dict[str, type[Message]] = {
    bus_messages.PAYLOAD: PayloadMessage,
    bus_messages.ESTIMATE: EstimateMessage,
    bus_messages.EVENT: EventMessage,
}
_STATION, _PICTURE = "station", "picture"


class Fleet:
    """A station's place among the others; what it hears of them it hands on as its own bus does.

    Takes the bus's place for whoever shows payloads: `subscribe`, `publish` and `query` are meant
    for those that fly elsewhere, too. Safe from any thread. Raises a `BlimpError` with one line
    when its endpoints or certificates cannot be used.
    """

    def __init__(
        self,
        settings: StationSettings,
        bus: Bus,
        version: str,
        on_picture: Callable[[str, bytes], None] = lambda *_: None,
    ) -> None:
        self.name = settings.name
        self._bus, self._version, self._on_picture = bus, version, on_picture
        self._own_maps = OwnMaps(settings.map)
        self._shelf = Path(settings.map.shelf)
        self.where = Whereabouts(self._own_maps.messages())
        """Who flies where, for the page."""
        self._fetching = threading.Lock()
        self._lock = threading.Lock()
        self._takes: dict[str, list[Take]] = {kind: [] for kind in _TOLD}
        self._recording: RecordingMessage | None = None
        self.shelf: Shelf | None = None
        """This station's recordings, for the others."""
        self._due_s: dict[str, float] = {}
        self._allocation = Allocation(self.name)
        self._left: Mapping[str, str] = {}
        self._overloaded_s = float("-inf")
        self._refused: dict[str, str] = {}
        self._join = tuple(settings.fleet.join)
        self._held = credentials.load(settings.telemetry.certificates)
        self._session = open_session(
            listen=settings.fleet.listen,
            connect=settings.fleet.join,
            certificates=settings.telemetry.certificates,
            rules=rules(self._held),
            more=SESSION,
        )
        self._ask = partial(ask, self._session, self.name)
        self.listening = self._session.listening
        self._hears = [self._hear(f"{ROOT}/*/{kind}/*") for kind in (_STATION, *_TOLD)]
        self._serves = self._session.zenoh.declare_queryable(
            f"{ROOT}/{self.name}/do/**", self._asked
        )
        self._watched: dict[str, Any] = {}
        bus.subscribe(bus_messages.PAYLOAD, PayloadMessage, self._own_payload)
        bus.subscribe(bus_messages.ESTIMATE, EstimateMessage, self._own_estimate)
        bus.subscribe(bus_messages.EVENT, EventMessage, self._own_event)
        bus.subscribe(bus_messages.RECORDING, RecordingMessage, self._own_recording)
        self._closing = threading.Event()
        self._looking = threading.Thread(target=self._look, name="fleet", daemon=True)
        self._looking.start()

    def close(self) -> None:
        """Leaves the others."""
        self._closing.set()
        self._session.close()
        self._looking.join(1.0)

    # As the bus

    def subscribe(self, kind: str, of: type[N], take: Callable[[str, N], None]) -> None:
        """Calls `take` with each message of a kind, of payloads here and elsewhere."""

        def own(payload_id: str, message: N) -> None:
            if kind != bus_messages.PAYLOAD or not self.where.station_of(payload_id):
                take(payload_id, message)

        self._bus.subscribe(kind, of, own)
        if kind in self._takes:
            self._takes[kind].append(take)

    def publish(self, kind: str, payload_id: str, message: Message) -> None:
        """Tells this station's processes."""
        self._bus.publish(kind, payload_id, message)

    def query(
        self, name: str, request: Mapping[str, Any], timeout_s: float = TIMEOUT_S
    ) -> Mapping[str, Any]:
        """Asks a process of this station, or of the one that the payload in question flies with."""
        payload_id = _payload_of(name, request)
        station = self.where.station_of(payload_id)
        if not station:
            answer = self._bus.query(name, request, timeout_s=timeout_s)
            if payload_id:
                self._publish_event(
                    payload_id, f"{_what(request)} was asked for at station '{self.name}'"
                )
            return answer
        with contextlib.suppress(ValueError):
            answer = json.loads(self._ask(station, name, request, timeout_s))
            if isinstance(answer, dict):
                return {"done": False, "reason": "", **answer}
        return {"done": False, "reason": f"station '{station}' did not answer"}

    def shelf_of(self, station: str) -> Elsewhere:
        """The recordings of another station, read from there."""
        return Elsewhere(lambda request: self._ask(station, _RECORDINGS, request), station)

    def fetch_map(self, station: str, name: str) -> str:
        """Takes a map that another station offers onto this one's shelf; what it is called here.

        Raises a `BlimpError` with one line.
        """
        theirs = Elsewhere(
            lambda request: self._ask(station, MAP, {**request, "map": name}), station
        )
        with self._fetching:
            return fetch(theirs, station, theirs.list(), self._shelf).name

    # What this station's page adds

    def publish_state(self, alarms: list[Alarm], wants: frozenset[str], cpu: float) -> None:
        """Tells the others how this station is; to be called at least twice a second.

        `cpu` are the cores that its processes use.
        """
        now_s = time.monotonic()
        if now_s < self._due_s.get("", 0.0):
            return
        self._due_s[""] = now_s + _TELL_S
        away = {name: self.where.station_of(name) for name in sorted(wants)[:WANTS]}
        heard, here = self.where.heard_here()
        alone = {name for name, note in here.items() if not _follows(note)}
        overloaded = now_s - self._overloaded_s < _OVERLOADED_S
        load = cpu / (os.cpu_count() or 1)
        peers = {
            name: Peer(said.load, said.overloaded, frozenset(said.hears))
            for name, said in self.where.fresh().items()
        }
        with self._lock:
            leaves = self._allocation.leaves(here.keys() - alone, alone, load, overloaded, peers)
            pins = dict(self._allocation.pins)
        self._leave(leaves)
        maps = self._own_maps.messages()
        self.where.maps = maps
        self._watch({f"{ROOT}/{at}/{_PICTURE}/{name}" for name, at in away.items() if at})
        said = StationMessage(
            time_ns=time.time_ns(),
            version=self._version,
            map=maps[0].name,
            map_id=maps[0].id,
            maps=maps,
            load=round(load, 2),
            overloaded=overloaded,
            hears=sorted(heard)[:PAYLOADS],
            pins=pins,
            recording=self._recording,
            alarms=alarms[:ALARMS],
            wants=[name for name, at in away.items() if at],
        )
        self._put(_STATION, bus_messages.STATION, bus_messages.encode(said))

    def pin(self, payload_id: str, station: str) -> None:
        """A person wants a payload to fly with a station; "": whichever has room."""
        with self._lock:
            self._allocation.pin(payload_id, Pin(station, time.time_ns()))
        where = f"to fly with station '{station}'" if station else "to fly where there is room"
        self._publish_event(payload_id, f"it was asked {where}, at station '{self.name}'")

    def _leave(self, leaves: Mapping[str, str]) -> None:
        for name in leaves.keys() - self._left.keys():
            self._publish_event(name, f"left to another station: {leaves[name]}", name="left")
        if leaves or self._left:
            note = LeaveMessage(sorted(leaves))
            self._bus.publish(bus_messages.LEAVE, bus_messages.STATION, note)
        self._left = leaves

    def picture(self, payload_id: str, message: bytes) -> None:
        """A picture of a payload that flies here; it goes to those who look at it elsewhere."""
        if payload_id in self.where.wanted() and len(message) < MESSAGE_BYTES:
            self._put(_PICTURE, payload_id, message)

    def document(self) -> dict[str, Any]:
        """The other stations, and what is wrong between them, as plain values."""
        with self._lock:
            pins = {n: pin.station for n, pin in self._allocation.pins.items() if pin.station}
            refused = sorted(self._refused.values())
        return {**self.where.document(), "pins": pins, "refused": refused}

    # This station's bus

    def _own_payload(self, payload_id: str, note: PayloadMessage) -> None:
        before = self.where.here(payload_id, note)
        if before and not (self._recording and self._recording.active):
            threading.Thread(target=self._record, args=(payload_id, before), daemon=True).start()
        if note.alive and not note.station:
            self._put(bus_messages.PAYLOAD, payload_id, bus_messages.encode(note))

    def _record(self, payload_id: str, before: str) -> None:
        """A flight that was recorded where it was goes on being recorded."""
        answer = self._bus.query(_INTAKE, {"do": "record-start", "after": before})
        text = f"it was recorded as {before} and goes on as {answer.get('file')}"
        level = bus_messages.INFO
        if not answer.get("done"):
            level = bus_messages.ALARM
            text = f"it was recorded as {before}; here: {answer.get('reason')}"
        self._publish_event(payload_id, text, level, "recording-moved")

    def _own_estimate(self, payload_id: str, note: EstimateMessage) -> None:
        if note.overload:
            self._overloaded_s = time.monotonic()
        watched = payload_id in self.where.wanted()
        now_s = time.monotonic()
        period_s = 1.0 / (_WATCHED_HZ if watched else _SEEN_HZ)
        due_s = self._due_s.get(payload_id, 0.0)
        if now_s < due_s - period_s / 4:
            return
        self._due_s[payload_id] = max(due_s, now_s - period_s) + period_s
        if not watched:
            note = dataclasses.replace(note, points_px=[])
        self._put(bus_messages.ESTIMATE, payload_id, bus_messages.encode(note))

    def _own_event(self, payload_id: str, note: EventMessage) -> None:
        # What payloads say is heard everywhere, alarms are told as long as they stand.
        if note.source != "payload" and not note.name.startswith("alarm-"):
            self._put(bus_messages.EVENT, payload_id, bus_messages.encode(note))

    def _own_recording(self, _: str, note: RecordingMessage) -> None:
        self._recording = note

    def _put(self, kind: str, payload_id: str, data: bytes) -> None:
        with contextlib.suppress(Exception):  # of a session that is being closed
            self._session.zenoh.put(f"{ROOT}/{self.name}/{kind}/{payload_id}", data)

    # The other stations

    def _hear(self, key: str) -> Any:
        import zenoh

        return self._session.zenoh.declare_subscriber(
            key, self._heard, allowed_origin=zenoh.Locality.REMOTE
        )

    def _watch(self, keys: set[str]) -> None:
        """Hears the pictures of these keys, and of no others."""
        with contextlib.suppress(Exception):  # of a session that is being closed
            for key in self._watched.keys() - keys:
                self._watched.pop(key).undeclare()
            for key in keys - self._watched.keys():
                self._watched[key] = self._hear(key)

    def _heard(self, sample: Any) -> None:
        _, station, kind, payload_id = str(sample.key_expr).split("/")
        try:
            if payload_id != bus_messages.STATION:
                check_payload_id(payload_id)
            self._take(station, kind, payload_id, sample.payload.to_bytes())
        except BlimpError:
            self._bus.dropped += 1

    def _take(self, station: str, kind: str, payload_id: str, data: bytes) -> None:
        if kind == _STATION:
            said = bus_messages.decode(StationMessage, data)
            if self.where.heard(station, said):
                with self._lock:
                    for name, pin in said.pins.items():
                        self._allocation.pin(name, pin)
        elif kind == _PICTURE:
            if self.where.station_of(payload_id) == station:
                self._on_picture(payload_id, data)
        elif kind in _TOLD:
            note: Any = bus_messages.decode(_TOLD[kind], data)
            if kind == bus_messages.PAYLOAD:
                if note.station or not self.where.takes_up(station, payload_id, note):
                    return
                note = dataclasses.replace(note, station=station, relayed=True)
            elif kind == bus_messages.EVENT:
                note = dataclasses.replace(note, text=f"{note.text} (station '{station}')")
            elif self.where.station_of(payload_id) != station or not self.where.in_our_map(
                station, note
            ):
                return
            else:
                note = self._named(note)
                self._bus.publish(bus_messages.ELSEWHERE, payload_id, note)
            for take in self._takes[kind]:
                take(payload_id, note)

    def named(self, note: EstimateMessage) -> EstimateMessage:
        """A pose told elsewhere, with this station's name of the map where that is its own."""
        is_ours = note.coordinates == self.where.maps[0].coordinates
        return self._named(note) if note.coordinates and is_ours else note

    def _named(self, note: EstimateMessage) -> EstimateMessage:
        ours = self.where.maps[0]
        return dataclasses.replace(note, map=note.map and ours.name, coordinates=ours.coordinates)

    def _asked(self, query: Any) -> None:
        """Another station's operator asks something of a payload that flies here."""
        name = str(query.key_expr).split("/do/", 1)[-1]
        answer: Mapping[str, Any] = {"done": False, "reason": "that can only be asked for there"}
        with contextlib.suppress(Exception):  # what is no question gets that answer
            body = json.loads(query.payload.to_bytes())
            request, by = dict(body["request"]), check_payload_id(str(body["by"]))
            payload_id = _payload_of(name, request)
            if name == _RECORDINGS and self.shelf is not None:
                query.reply(query.key_expr, read(self.shelf, request))
                return
            if name == MAP:
                folder = self._own_maps.folder(str(request.get("map", "")))
                query.reply(query.key_expr, read(MapFiles(folder), request))
                return
            if payload_id:
                answer = self._bus.query(name, request, timeout_s=TIMEOUT_S)
                self._publish_event(payload_id, f"{_what(request)} was asked for at station '{by}'")
        with contextlib.suppress(Exception):  # whoever asked may be gone
            query.reply(query.key_expr, json.dumps(answer).encode())

    def _publish_event(
        self, payload_id: str, text: str, level: Level = bus_messages.INFO, name: str = _ASKED
    ) -> None:
        note = EventMessage(time.time_ns(), "web", level, name, text)
        with contextlib.suppress(Exception):  # the bus may be what fails
            self._bus.publish(bus_messages.EVENT, payload_id, note)

    def _look(self) -> None:
        """Finds out who is refused, here and there: Zenoh does not say."""
        while not self._closing.wait(_LOOK_S):
            refused = {}
            try:
                linked = self._session.linked()
                for name in linked - set(self._held.stations):
                    refused[name] = (
                        f"{name} wants to join and is not on this station's list: revoked, or newer"
                        " than these keys"
                    )
                if not linked & set(self._held.stations):
                    for endpoint in self._join:
                        if why := refusal(endpoint, self._held, peers=self._held.stations):
                            refused[endpoint] = why
            except Exception:  # a session that is being closed
                continue
            with self._lock:
                self._refused = refused
            self.where.forget()


def _payload_of(name: str, request: Mapping[str, Any]) -> str:
    """The payload that a question is about; "" for one about the station itself."""
    if name.startswith(_LOCALIZER):
        return name.removeprefix(_LOCALIZER)
    if name == _INTAKE and request.get("do") == _COMMAND:
        return str(request.get("payload"))
    return ""


def _follows(note: PayloadMessage) -> bool:
    """Whether a payload says that it found a station; one with a fixed address never does."""
    return note.health is not None and bool(note.health.ground)


def _what(request: Mapping[str, Any]) -> str:
    return str(request.get("name") if request.get("do") == _COMMAND else request.get("do"))[:40]
