"""Two stations of one authority in one network: each payload flies with one of them."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
from pathlib import Path
from typing import Any

import httpx
from intake_stand import eventually
from payload_process import free_port
from scenarios.tcp_wire import TcpWire
from standing import Service, joined
from websockets.sync.client import connect

PAYLOAD = "blimp-1"
_LIMIT_S = 90.0


def alarms(service: Service) -> dict[str, str]:
    """What its alarms say, by id."""
    return {alarm["id"]: alarm["text"] for alarm in service.state()["alarms"]}


def listed(service: Service, station: str) -> list[dict[str, Any]]:
    """The recordings that its page shows of another station."""
    with contextlib.suppress(httpx.HTTPError):  # a connection of before its restart
        answer = service.client.get(f"/api/stations/{station}/recordings")
        return list(answer.json()) if answer.status_code == 200 else []
    return []


def picture_of(service: Service, payload_id: str) -> dict[str, Any]:
    """The header of the first picture that a viewer gets of a payload."""
    url = f"{service.url.replace('http', 'ws')}/api/live?payload={payload_id}"
    with connect(url) as socket:
        while True:
            message = socket.recv(_LIMIT_S)
            if isinstance(message, bytes):
                (length,) = struct.unpack(">I", message[:4])
                return dict(json.loads(message[4 : 4 + length]))


def played(service: Service, path: str) -> dict[str, Any]:
    """How the playback of a recording begins."""
    with connect(f"{service.url.replace('http', 'ws')}{path}/play") as socket:
        while True:
            message = json.loads(socket.recv(_LIMIT_S))
            if message["type"] != "reading":
                return dict(message)


def test_stations_that_joined_show_each_others_payloads(tmp_path: Path) -> None:
    first, second = joined(tmp_path)
    with (
        first,
        second,
        first.fly("blimp-1", tmp_path / "one", rate_hz=10.0),
        second.fly("blimp-2", tmp_path / "two", rate_hz=10.0),
    ):
        pages = (first, second)
        for page in pages:
            for name in ("blimp-1", "blimp-2"):
                eventually(lambda page=page, name=name: page.tracking(name), _LIMIT_S)
        assert first.payload("blimp-2")["payload"]["station"] == "spare"
        assert second.payload("blimp-1")["payload"]["relayed"] is True
        assert first.payload("blimp-1")["payload"]["relayed"] is False
        assert len(second.payload("blimp-1")["trail"]) > 0
        assert picture_of(second, "blimp-1")["payload"] == "blimp-1"
        (other,) = second.state()["fleet"]["stations"]
        assert other["name"] == "main" and other["payloads"] == ["blimp-1"]
        answer = second.client.post("/api/payloads/blimp-1/relocalize")
        assert answer.json()["done"], answer.text

        def told(page: Service) -> bool:
            texts = [event["text"] for event in page.state()["events"]]
            return any("relocalize was asked for at station 'spare'" in text for text in texts)

        for page in pages:
            eventually(lambda page=page: told(page), _LIMIT_S)
        answer = first.client.post("/api/payloads/blimp-2/station", json={"name": "attic"})
        assert answer.status_code == 404
        first.kill()
        eventually(lambda: "station/main" in alarms(second), _LIMIT_S)
        assert second.tracking("blimp-2")
        first.start()
        eventually(lambda: second.tracking("blimp-1"), _LIMIT_S)
        eventually(lambda: "station/main" not in alarms(second), _LIMIT_S)


def test_stations_whose_network_is_cut_fly_on_and_are_one_again(tmp_path: Path) -> None:
    port = free_port(socket.SOCK_STREAM)
    with TcpWire(port) as wire:
        first, second = joined(tmp_path, port, through=wire.port)
        with (
            first,
            second,
            first.fly("blimp-1", tmp_path / "one", rate_hz=10.0),
            second.fly("blimp-2", tmp_path / "two", rate_hz=10.0),
        ):
            pages, names = (first, second), ("blimp-1", "blimp-2")

            def whole() -> bool:
                return all(page.tracking(name) for page in pages for name in names)

            eventually(whole, _LIMIT_S)
            second.record(active=True)
            wire.block()
            eventually(lambda: "station/main" in alarms(second), _LIMIT_S)
            eventually(lambda: "station/spare" in alarms(first), _LIMIT_S)
            for page, own, other in ((first, *names), (second, *reversed(names))):
                eventually(lambda page=page, own=own: page.has(own), _LIMIT_S)
                assert not page.tracking(other)
            assert second.state()["recording"]["active"]
            wire.fix()
            eventually(whole, _LIMIT_S)
            for page, other in ((first, "spare"), (second, "main")):
                state = page.state()
                assert [one["name"] for one in state["fleet"]["stations"]] == [other]
                told = [(e["time_ns"], e["payload"], e["name"]) for e in state["events"]]
                assert len(set(told)) == len(told) and set(state["payloads"]) == set(names)


def test_a_payload_whose_station_dies_flies_on_with_the_other(tmp_path: Path) -> None:
    first, second = joined(tmp_path)
    endpoints = json.dumps([first.endpoint, second.endpoint])
    both = {"main": first, "spare": second}
    with (
        first,
        second,
        first.fly(
            PAYLOAD, tmp_path / "payload", "link.host=auto", f"telemetry.connect={endpoints}",
            rate_hz=10.0,
        ),
    ):  # fmt: skip

        def flies_with() -> str:
            """The station that has it, once the other knows: by load it may change at first."""
            for name, one, other in (("main", first, second), ("spare", second, first)):
                if one.has(PAYLOAD) and other.payload(PAYLOAD)["payload"]["station"] == name:
                    return name
            return ""

        name = eventually(flies_with, _LIMIT_S)
        used, other_name = both.pop(name), *both
        other = both[other_name]
        eventually(lambda: other.payload(PAYLOAD)["payload"]["relayed"], _LIMIT_S)
        eventually(lambda: f"no-frames/{PAYLOAD}" not in alarms(other), _LIMIT_S)
        answer = used.client.post(f"/api/payloads/{PAYLOAD}/station", json={"name": other_name})
        assert answer.json()["done"], answer.text
        eventually(lambda: other.has(PAYLOAD), _LIMIT_S)
        assert any("was chosen for it" in event["text"] for event in used.state()["events"])
        assert other.state()["fleet"]["pins"] == {PAYLOAD: other_name}
        used, other, name = other, used, other_name
        eventually(lambda: other.payload(PAYLOAD)["payload"]["relayed"], _LIMIT_S)
        used.record(active=True)
        station = {"main": "spare", "spare": "main"}[name]
        eventually(lambda: other.state()["fleet"]["stations"][0]["recording"], _LIMIT_S)
        assert not other.state()["recording"]["active"]
        used.kill()
        eventually(lambda: other.has(PAYLOAD), _LIMIT_S)
        eventually(lambda: other.state()["recording"]["active"], _LIMIT_S)
        other.record(active=False)
        (cut,) = [path.name for path in used.recordings.iterdir()]
        recordings = "/api/recordings"
        eventually(lambda: not other.client.get(recordings).json()[0]["active"], _LIMIT_S)
        (file,) = other.client.get(recordings).json()
        assert file["after"] == f"{name}/{cut}" and file["duration_s"] > 0.0
        used.start()
        eventually(lambda: len(listed(used, station)) == 1, _LIMIT_S)
        assert listed(used, station)[0]["file"] == file["file"]
        url = f"/api/stations/{station}/recordings/{file['file']}"
        assert used.client.get(url).content == (other.recordings / file["file"]).read_bytes()
        hello = played(used, url)
        assert hello["payload"] == PAYLOAD and hello["tape"]["length_s"] == file["duration_s"]
        assert used.client.get("/api/stations/nobody/recordings").status_code == 404
