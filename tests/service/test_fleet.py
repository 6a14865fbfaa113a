"""Stations side by side: what each hears of the others, and who is refused."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tape_stand
from intake_stand import eventually
from scenarios.tcp_wire import TcpWire

from ground_station.errors import GroundStationError, InputError, KeysError
from ground_station.keys.authority import Authority
from ground_station.map import store
from ground_station.map.folder import content_id
from ground_station.service import bus_messages, settings
from ground_station.service.alarms import Alarm
from ground_station.service.bus import Bus, Router
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    PayloadMessage,
    RecordingMessage,
)
from ground_station.service.fleet import fleet, maps
from ground_station.service.fleet.fleet import Fleet
from ground_station.service.fleet.shelf import Elsewhere
from ground_station.service.fleet.whereabouts import FRESH_S
from ground_station.service.settings import SAMPLE
from ground_station.service.web.recordings import Recordings
from ground_station.service.web.tape import Tape

BLIMP = "blimp-1"
HERE = PayloadMessage(alive=True, seen_ns=1, ssrc=4, rate_hz=10.0)
POSE = EstimateMessage(
    sequence=1, time_ns=1, clock_ns=1, done_ns=1, state="TRACKING", map="atrium",
    position_m=[1.0, 2.0, 3.0], points_px=[1.0, 2.0],
)  # fmt: skip


class Station:
    """A station's bus with its place among the others, and what these were heard to say."""

    def __init__(
        self, folder: Path, authority: Authority, name: str, *join: str, more: tuple[str, ...] = ()
    ) -> None:
        self.stack = ExitStack()
        (folder / name).mkdir()
        router = Router(folder / name)
        self.stack.callback(router.close)
        web = self.stack.enter_context(Bus(folder / name, "web"))
        self.bus = self.stack.enter_context(Bus(folder / name, "intake"))
        self.heard: list[tuple[str, str, Any]] = []
        self.pictures: list[tuple[str, bytes]] = []
        chosen = settings.load(
            None,
            [
                f"name={name}", f"map.folder={SAMPLE}",
                f"telemetry.certificates={authority.of(f'ground.{name}')}",
                'telemetry.listen=["tls/127.0.0.1:0"]', 'fleet.listen=["tls/127.0.0.1:0"]',
                f"fleet.join={json.dumps(join)}", *more,
            ],
        )  # fmt: skip
        self.web = web
        self.fleet = Fleet(chosen, web, "1.2.3", lambda *seen: self.pictures.append(seen))
        self.stack.callback(self.fleet.close)
        for kind, of in (
            (bus_messages.PAYLOAD, PayloadMessage),
            (bus_messages.ESTIMATE, EstimateMessage),
            (bus_messages.EVENT, EventMessage),
        ):
            self.fleet.subscribe(
                kind, of, lambda name, note, kind=kind: self.heard.append((kind, name, note))
            )
        self.endpoint = next(iter(self.fleet.listening), "")

    def tell(self, *wants: str, alarms: Sequence[Alarm] = ()) -> None:
        """As its page does four times a second."""
        self.fleet.publish_state(list(alarms), frozenset(wants), 0.5)

    def flies(self, note: PayloadMessage = HERE) -> None:
        """Its bus tells of the payload, which flies here, or as it is said."""
        self.bus.publish(bus_messages.PAYLOAD, BLIMP, note)

    def others(self) -> list[str]:
        return [other["name"] for other in self.fleet.document()["stations"]]

    def last(self, kind: str) -> Any:
        return next((note for one, _, note in reversed(self.heard) if one == kind), None)


@pytest.fixture
def stations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Makes stations of one authority, which live to the test's end."""
    monkeypatch.setattr(fleet, "_LOOK_S", 0.5)
    authority = Authority.create(tmp_path / "keys")
    for name in ("hall", "attic", "yard"):
        authority.add("ground", name)
    with ExitStack() as stack:

        def make(name: str, *join: str, **more: Any) -> Station:
            station = Station(tmp_path, more.pop("authority", authority), name, *join, **more)
            stack.enter_context(station.stack)
            return station

        make.authority = authority  # type: ignore[attr-defined]
        yield make


def acquainted(*stations: Station) -> bool:
    for station in stations:
        station.tell()
    return all(len(station.others()) == len(stations) - 1 for station in stations)


Pair = tuple[Station, Station]


@pytest.fixture
def two(stations: Any) -> Pair:
    """'hall', and 'attic', which joined it; they know each other."""
    hall = stations("hall")
    attic = stations("attic", hall.endpoint)
    eventually(lambda: acquainted(hall, attic), 20.0)
    return hall, attic


def test_a_payload_that_flies_elsewhere_is_seen_here(two: Pair) -> None:
    hall, attic = two
    attic.flies(PayloadMessage(True, 1, station="hall"))

    def told() -> bool:
        hall.flies()
        hall.bus.publish(bus_messages.ESTIMATE, BLIMP, POSE)
        note = attic.last(bus_messages.PAYLOAD)
        return note is not None and note.relayed and attic.last(bus_messages.ESTIMATE) is not None

    eventually(told, 10.0)
    assert attic.last(bus_messages.PAYLOAD).station == "hall"
    pose = attic.last(bus_messages.ESTIMATE)
    assert pose.position_m == POSE.position_m and pose.points_px == []  # nobody looks at it there
    assert not hall.last(bus_messages.PAYLOAD).relayed
    (other,) = attic.fleet.document()["stations"]
    assert other["payloads"] == [BLIMP] and other["same_map"] and abs(other["clock_s"]) < 5.0
    hall.bus.publish(bus_messages.EVENT, "-", EventMessage(1, "intake", "info", "said", "a word"))
    eventually(lambda: attic.last(bus_messages.EVENT) is not None, 10.0)
    assert attic.last(bus_messages.EVENT).text == "a word (station 'hall')"
    # What its own bus says of it, less, is not shown in between.
    before = len(attic.heard)
    attic.flies(PayloadMessage(True, 1, station="hall"))
    hall.flies()
    eventually(lambda: len(attic.heard) > before, 10.0)
    assert all(note.relayed for kind, _, note in attic.heard[before:] if kind == "payload")


def test_pictures_cross_only_while_somebody_looks(two: Pair) -> None:
    hall, attic = two

    def shown(*wants: str) -> bool:
        hall.flies()
        attic.tell(*wants)
        hall.fleet.picture(BLIMP, b"JPEG")
        return bool(attic.pictures)

    for _ in range(20):
        assert not shown()
    assert hall.fleet.where.wanted() == frozenset()
    eventually(lambda: shown(BLIMP), 10.0)
    assert attic.pictures[0] == (BLIMP, b"JPEG") and hall.fleet.where.wanted() == {BLIMP}


def test_commands_go_to_the_station_that_has_the_payload_and_all_are_told(two: Pair) -> None:
    hall, attic = two
    asked = []
    hall.bus.serve(f"localizer/{BLIMP}", lambda request: {"values": asked.append(request) or {}})
    hall.bus.serve("intake", lambda request: {"values": asked.append(request) or {}})

    def there() -> bool:
        hall.flies()
        return attic.last(bus_messages.PAYLOAD) is not None

    eventually(there, 10.0)
    answer = attic.fleet.query(f"localizer/{BLIMP}", {"do": "relocalize"})
    assert answer["done"] and asked == [{"do": "relocalize"}]
    command = {"do": "payload-command", "payload": BLIMP, "name": "idr", "arguments": {}}
    assert attic.fleet.query("intake", command)["done"] and asked[-1] == command
    eventually(lambda: "idr was asked" in str(attic.last(bus_messages.EVENT)), 10.0)
    said = "idr was asked for at station 'attic'"
    eventually(lambda: said in str(hall.last(bus_messages.EVENT)), 10.0)
    # A station's own recording is its own.
    key, body = (
        "fleet/hall/do/intake",
        json.dumps({"by": "attic", "request": {"do": "record-stop"}}),
    )
    (reply,) = attic.fleet._session.zenoh.get(key, payload=body.encode(), timeout=5.0)
    assert json.loads(reply.ok.payload.to_bytes())["done"] is False and len(asked) == 2


class Shelf:
    """Recordings of 300,000 bytes, by name."""

    def list(self) -> list[dict[str, Any]]:
        return [{"file": "one.mcap", "size_MB": 0.3}]

    def size(self, name: str) -> int:
        if name != "one.mcap":
            raise KeysError("there is none")
        return 300_000

    def pieces(self, name: str, begin: int, end: int) -> Iterator[bytes]:
        yield (bytes(range(256)) * 1200)[begin:end]


def test_recordings_are_read_where_they_lie(two: Pair) -> None:
    hall, attic = two
    hall.fleet.shelf = Shelf()
    shelf = attic.fleet.shelf_of("hall")
    assert shelf.list() == Shelf().list() and attic.fleet.where.knows("hall")
    size = shelf.size("one.mcap")
    assert b"".join(shelf.pieces("one.mcap", 0, size)) == (bytes(range(256)) * 1200)[:size]
    with pytest.raises(GroundStationError, match="has no such file"):
        shelf.size("another.mcap")
    with pytest.raises(GroundStationError, match="station 'hall' did not answer"):
        list(shelf.pieces("one.mcap", 10**6, 10**6 + 1))
    hall.stack.close()
    with pytest.raises(GroundStationError, match="station 'hall' did not answer"):
        shelf.list()


def test_a_recording_is_played_where_it_does_not_lie(two: Pair, tmp_path: Path) -> None:
    hall, attic = two
    path = tape_stand.write(tmp_path / "flight.mcap")
    hall.fleet.shelf = Recordings(tmp_path, lambda: "")
    shelf = attic.fleet.shelf_of("hall")
    there, here = Tape(shelf.file("flight.mcap"), attic.fleet.named), Tape(path)
    assert (there.payloads, there.marks, there.map) == (here.payloads, here.marks, "atrium")
    from_ns = here.begin_ns + 10**10
    assert list(there.since(from_ns)) == list(here.since(from_ns)) != []
    ours = Tape(shelf.file("flight.mcap"), lambda note: replace(note, map="ours"))
    maps = {one.note.map for one in ours.since(from_ns) if isinstance(one.note, EstimateMessage)}
    assert maps == {"ours"}
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-40_000])
    assert list(Tape(shelf.file("cut.mcap")).since(from_ns)) == list(Tape(cut).since(from_ns)) != []
    hall.stack.close()
    with pytest.raises(GroundStationError, match="station 'hall' did not answer"):
        list(there.since(from_ns))


def test_a_pose_recorded_elsewhere_has_this_station_s_name_of_the_map(stations: Any) -> None:
    hall = stations("hall")
    hall.tell()
    ours = hall.fleet.where.maps[0]
    said = replace(POSE, map="theirs", coordinates=ours.coordinates)
    assert hall.fleet.named(said).map == ours.name != "theirs"
    for note in (replace(said, coordinates="other"), replace(said, coordinates="")):
        assert hall.fleet.named(note) == note


def test_a_flight_that_was_recorded_where_it_was_goes_on_being_recorded(two: Pair) -> None:
    hall, attic = two
    asked = []

    def intake(request: Any) -> dict[str, Any]:
        asked.append(dict(request))
        return {"file": "attic-1.mcap"}

    attic.bus.serve("intake", intake)
    written = RecordingMessage(active=True, file="hall-7.mcap")

    def recorded() -> bool:
        hall.flies()
        hall.bus.publish(bus_messages.RECORDING, "-", written)
        hall.tell()
        there = attic.last(bus_messages.PAYLOAD)
        return there is not None and bool(attic.fleet.document()["stations"][0]["recording"])

    eventually(recorded, 10.0)
    assert asked == []
    hall.stack.close()
    attic.flies()
    eventually(lambda: bool(asked), 10.0)
    assert asked == [{"do": "record-start", "after": "hall/hall-7.mcap"}]
    eventually(lambda: "hall/hall-7.mcap" in str(attic.last(bus_messages.EVENT)), 10.0)
    attic.flies()
    time.sleep(0.3)
    assert len(asked) == 1


def test_alarms_are_told_once_with_their_station(two: Pair) -> None:
    hall, attic = two
    found = [
        Alarm("disk", "warning", "-", "little left"),
        Alarm(f"battery/{BLIMP}", "alarm", BLIMP, "battery low"),
        Alarm("battery/blimp-9", "alarm", "blimp-9", "of one that flies with nobody there"),
        Alarm(f"near/{BLIMP}/blimp-2", "alarm", BLIMP, "1.0 m from blimp-2"),
        Alarm("station/yard", "warning", "-", "nothing is heard of station 'yard'"),
    ]

    def told() -> bool:
        hall.flies()
        hall.tell(alarms=found)
        return len(attic.fleet.where.alarms()) > 1

    eventually(told, 10.0)
    assert [(alarm["id"], alarm["text"]) for alarm in attic.fleet.where.alarms()] == [
        ("hall/disk", "little left (station 'hall')"),
        (f"hall/battery/{BLIMP}", "battery low (station 'hall')"),
    ]


def test_two_payloads_of_one_name_are_said_and_the_own_one_is_shown(two: Pair) -> None:
    hall, attic = two
    twin = PayloadMessage(alive=True, seen_ns=1, ssrc=9, rate_hz=10.0)

    def found() -> Any:
        attic.flies(twin)
        hall.flies()
        return attic.fleet.document()["twins"]

    def known() -> bool:
        attic.flies(twin)
        return attic.last(bus_messages.PAYLOAD) is not None

    # What flies here has to be known before another station tells of its own.
    eventually(known, 10.0)
    assert eventually(found, 10.0) == {BLIMP: "hall"}
    assert not any(note.relayed for kind, _, note in attic.heard if kind == "payload")


def test_poses_from_elsewhere_are_told_to_this_station_by_its_own_name_of_the_map(
    stations: Any, tmp_path: Path
) -> None:
    shutil.copytree(SAMPLE, tmp_path / "lobby", ignore=shutil.ignore_patterns("*.mcap"))
    hall = stations("hall")
    attic = stations("attic", hall.endpoint, more=(f"map.folder={tmp_path / 'lobby'}",))
    eventually(lambda: acquainted(hall, attic), 20.0)
    told: list[EstimateMessage] = []
    attic.bus.subscribe(
        bus_messages.ELSEWHERE, EstimateMessage, lambda name, note: told.append(note)
    )

    sent: list[None] = []

    def heard() -> bool:
        # By turns, as a station tells not of every one.
        other = replace(POSE, map="hall", sequence=2) if len(sent) % 8 < 4 else POSE
        sent.append(None)
        hall.flies()
        hall.bus.publish(bus_messages.ESTIMATE, BLIMP, other)
        return bool(told)

    eventually(heard, 10.0)
    assert {(note.map, note.sequence) for note in told} == {("lobby", POSE.sequence)}
    assert attic.last(bus_messages.ESTIMATE).map == "lobby"


def test_poses_in_another_map_are_not_taken(stations: Any, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "map.toml").write_bytes((SAMPLE / "map.toml").read_bytes() + b"\n")
    assert content_id(other) != content_id(SAMPLE)
    hall = stations("hall")
    attic = stations("attic", hall.endpoint, more=(f"map.folder={other}",))
    eventually(lambda: acquainted(hall, attic), 20.0)

    def told() -> bool:
        hall.flies()
        hall.bus.publish(bus_messages.ESTIMATE, BLIMP, POSE)
        return len([1 for kind, _, _ in attic.heard if kind == "payload"]) > 3

    eventually(told, 10.0)
    assert attic.last(bus_messages.ESTIMATE) is None
    assert attic.fleet.document()["stations"][0]["same_map"] is False


def test_a_third_station_is_found_through_the_first_and_stays_when_that_goes(stations: Any) -> None:
    hall = stations("hall")
    attic, yard = (stations(name, hall.endpoint) for name in ("attic", "yard"))
    eventually(lambda: acquainted(hall, attic, yard), 30.0)
    hall.stack.close()
    attic.heard.clear()

    def told() -> bool:
        yard.flies()
        note = attic.last(bus_messages.PAYLOAD)
        return note is not None and note.station == "yard"

    eventually(told, 10.0)


def test_a_network_that_is_cut_costs_nothing_once_it_is_back(stations: Any) -> None:
    hall = stations("hall")
    with TcpWire(int(hall.endpoint.rpartition(":")[2])) as wire:
        attic = stations("attic", f"tls/127.0.0.1:{wire.port}", more=("fleet.listen=[]",))

        def seen(at: Station, station: str) -> bool:
            hall.flies()
            attic.bus.publish(bus_messages.PAYLOAD, "blimp-2", HERE)
            for one in (hall, attic):
                one.tell()
            last = [note for kind, _, note in at.heard if kind == "payload" and note.relayed]
            (other,) = at.fleet.document()["stations"] or [{"age_s": 99.0}]
            return bool(last) and last[-1].station == station and other["age_s"] < FRESH_S

        eventually(lambda: seen(attic, "hall") and seen(hall, "attic"), 20.0)
        wire.block()
        eventually(lambda: not seen(attic, "hall") and not seen(hall, "attic"), 30.0)
        assert attic.fleet.query(f"localizer/{BLIMP}", {})["done"] is False
        note = EventMessage(7, "intake", "info", "said", "meanwhile")
        attic.bus.publish(bus_messages.EVENT, "-", note)
        eventually(lambda: attic.last(bus_messages.EVENT) == note, 10.0)
        wire.fix()
        eventually(lambda: seen(attic, "hall") and seen(hall, "attic"), 60.0)
        told = [one for kind, _, one in hall.heard if kind == "event" and one.time_ns == 7]
        assert len(told) <= 1  # what was said meanwhile may be lost to the other, never doubled


def test_whoever_is_revoked_or_foreign_is_refused_and_named(stations: Any, tmp_path: Path) -> None:
    hall = stations("hall")
    foreign = Authority.create(tmp_path / "foreign")
    foreign.add("ground", "spy")
    foreign.add("ground", "hall")
    spy = stations("spy", hall.endpoint, authority=foreign)
    eventually(lambda: spy.fleet.document()["refused"], 30.0)
    assert "authority" in spy.fleet.document()["refused"][0]
    yard = stations("yard", hall.endpoint)  # before the list of the first says that it is revoked
    yard.stack.close()
    stations.authority.revoke("ground.yard")
    later = stations("attic")  # started after that
    kept = tmp_path / "keys" / "revoked" / "ground.yard"
    shutil.copytree(kept, tmp_path / "copied" / "ground" / "yard")

    class Copied:
        def of(self, name: str) -> Path:
            return tmp_path / "copied" / "ground" / "yard"

    (tmp_path / "yard").rename(tmp_path / "yard-before")
    gone = stations("yard", later.endpoint, authority=Copied())

    def said() -> bool:
        gone.tell()
        gone.flies()
        return bool(later.fleet.document()["refused"])

    eventually(said, 30.0)
    assert "ground.yard" in later.fleet.document()["refused"][0]
    assert later.others() == [] and later.heard == [] and gone.others() == []


def test_whose_certificate_has_ended_is_refused_and_told_why(stations: Any) -> None:
    hall = stations("hall")
    stations.authority.renew("ground.yard", days=-1)
    yard = stations("yard", hall.endpoint)

    def said() -> bool:
        yard.tell()
        return bool(yard.fleet.document()["refused"])

    eventually(said, 30.0)
    assert "expired" in yard.fleet.document()["refused"][0]
    assert hall.others() == [] and yard.others() == []


def test_what_is_no_message_is_counted_and_dropped(two: Pair) -> None:
    hall, attic = two
    session = hall.fleet._session.zenoh
    for k in range(100):
        session.put(f"fleet/hall/payload/blimp-{k}", bus_messages.encode(HERE))
    for kind, name in (("station", "-"), ("payload", BLIMP), ("estimate", BLIMP), ("event", "X!")):
        session.put(f"fleet/hall/{kind}/{name}", b'{"alarms": 1')
    session.put("fleet/attic/payload/blimp-1", bus_messages.encode(HERE))  # in another's name
    eventually(lambda: attic.web.dropped >= 4, 10.0)
    taken = {name for kind, name, _ in attic.heard if kind == "payload"}
    assert 0 < len(taken) <= 64 and acquainted(hall, attic)
    assert all(note.station == "hall" for kind, _, note in attic.heard if kind == "payload")


def test_a_map_is_fetched_once_by_its_content(
    stations: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    building = tmp_path / "atrium"
    shutil.copytree(SAMPLE, building, ignore=shutil.ignore_patterns("*.mcap", "sparse"))
    (building / "who flew when.txt").write_text("the map's owner's")
    hall = stations("hall", more=(f"map.folder={building}",))
    shelf = tmp_path / "shelf"

    def fetch() -> Path:
        folder = stations.authority.of("ground.attic")
        chosen = [f"telemetry.certificates={folder}", f"map.shelf={shelf}"]
        joined = [
            f"fleet.join={json.dumps([hall.endpoint])}",
            'telemetry.listen=["tls/127.0.0.1:0"]',
        ]
        return maps.fetched(settings.load(None, [*chosen, *joined]))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(maps, "_LOOK_S", 0.5)
        nobody, hall.endpoint = hall.endpoint, "tls/127.0.0.1:9"
        with pytest.raises(InputError, match=r"no station answered within .* --map"):
            fetch()
        hall.endpoint = nobody
    folder = fetch()
    assert folder.parent == shelf and folder.name.startswith("atrium-")
    assert "was fetched" in capsys.readouterr().out
    assert content_id(folder) == content_id(SAMPLE)  # so that poses are shown here and there
    for name in ("landmarks.safetensors", "keyframes.safetensors", "floorplan.png"):
        assert (folder / name).read_bytes() == (SAMPLE / name).read_bytes()
    assert not (folder / "who flew when.txt").exists()
    assert fetch() == folder and "is here already" in capsys.readouterr().out
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(maps, "_LOOK_S", 0.0)
        assert fetch() == folder and "fetched last" in capsys.readouterr().out


def grown(base: Path, name: str, more: int) -> Path:
    """A map beside another, as `blimp map extend` writes one that found so many landmarks."""
    folder = base.with_name(name)
    shutil.copytree(base, folder)
    info = store.load_info(base)
    runs = info.extensions
    had = runs[-1]["landmarks"][1] if runs else len(store.load_positions(base))
    info.name = name
    run = {"of": content_id(base), "landmarks": [had, had + more]}
    info.extended = {"runs": [*runs, run]}
    store.save_info(folder, info)
    return folder


def test_a_map_that_grew_elsewhere_is_offered_and_its_poses_are_ours(
    stations: Any, tmp_path: Path
) -> None:
    shelves = [tmp_path / name / "maps" for name in ("one", "two")]
    for shelf in shelves:
        ignored = shutil.ignore_patterns("*.mcap", "*.jpg", "*.png", "sparse")
        shutil.copytree(SAMPLE, shelf / "atrium", ignore=ignored)
    chosen = [(f"map.folder={shelf / 'atrium'}", f"map.shelf={shelf}") for shelf in shelves]
    hall = stations("hall", more=chosen[0])
    attic = stations("attic", hall.endpoint, more=chosen[1])
    eventually(lambda: acquainted(hall, attic), 20.0)
    assert attic.fleet.document()["offers"] == []
    once = grown(shelves[0] / "atrium", "atrium-2", 500)
    grown(once, "atrium-3", 20)
    moved = grown(once, "moved", 7)  # it was registered anew since
    info = store.load_info(moved)
    info.registration = {**info.registration, "residual_rms_m": 0.5}
    store.save_info(moved, info)

    def offered() -> list[tuple[str, int]]:
        acquainted(hall, attic)
        offers = attic.fleet.document()["offers"]
        assert {offer["station"] for offer in offers} <= {"hall"}
        return [(offer["map"], offer["more"]) for offer in offers]

    eventually(lambda: offered() == [("atrium-2", 500), ("atrium-3", 520)], 10.0)
    assert hall.fleet.document()["offers"] == []

    def pose(map_name: str) -> EstimateMessage | None:
        folder = shelves[0] / map_name
        coordinates = store.coordinates_id(folder, store.load_info(folder))
        note = replace(POSE, map=map_name, coordinates=coordinates)
        attic.heard.clear()
        for _ in range(3):
            hall.flies()
            hall.bus.publish(bus_messages.ESTIMATE, BLIMP, note)
            time.sleep(0.2)
        found: EstimateMessage | None = attic.last(bus_messages.ESTIMATE)
        return found

    eventually(lambda: pose("atrium-3"), 10.0)
    assert attic.last(bus_messages.ESTIMATE).map == "atrium"
    assert pose("moved") is None
    name = attic.fleet.fetch_map("hall", "atrium-3")
    taken = shelves[1] / name
    assert content_id(taken) == content_id(shelves[0] / "atrium-3")
    eventually(lambda: offered() == [("atrium-2", 500)], 10.0)
    for station, name in (("nobody", "atrium-3"), ("hall", "atrium-9")):
        with pytest.raises(GroundStationError, match=r"did not answer|no map that can be fetched"):
            attic.fleet.fetch_map(station, name)


@pytest.mark.parametrize("name", ["../evil", "/etc/passwd", ".hidden", "a/b", "", "x\n", "n" * 70])
def test_a_file_of_a_map_cannot_lie_elsewhere(name: str, tmp_path: Path) -> None:
    entry = {"map": "hall", "file": name, "size": 1, "sha256": "0"}
    other = {**entry, "file": "map.toml", "map": name}
    for listed in ([entry], [other], [], "text", [1], [{**entry, "file": "a", "size": -1}]):
        theirs = Elsewhere(lambda _: b"x", "hall")
        with pytest.raises(InputError, match="no map that can be fetched"):
            maps.fetch(theirs, "hall", listed, tmp_path / "shelf")
    assert not (tmp_path / "shelf").exists()


def test_a_map_that_changed_meanwhile_leaves_nothing(tmp_path: Path) -> None:
    theirs = Elsewhere(lambda _: b"x", "hall")
    listed = [{"map": "hall", "file": "map.toml", "size": 1, "sha256": "another"}]
    with pytest.raises(InputError, match="changed there meanwhile"):
        maps.fetch(theirs, "hall", listed, tmp_path)
    gone = Elsewhere(lambda _: b"", "hall")
    with pytest.raises(GroundStationError, match="did not answer"):
        maps.fetch(gone, "hall", listed, tmp_path)
    assert list(tmp_path.iterdir()) == []
