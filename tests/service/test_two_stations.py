"""Two stations of one authority in one network: each payload flies with one of them."""

from __future__ import annotations

import contextlib
import json
import struct
from pathlib import Path
from typing import Any

import httpx
from intake_stand import eventually
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


def test_a_payload_is_shown_by_both_goes_where_it_is_sent_and_flies_on_when_its_station_dies(
    tmp_path: Path,
) -> None:
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
        eventually(lambda: other.tracking(PAYLOAD), _LIMIT_S)  # it shows what flies there
        assert picture_of(other, PAYLOAD)["payload"] == PAYLOAD
        assert len(other.payload(PAYLOAD)["trail"]) > 0
        (station,) = other.state()["fleet"]["stations"]
        assert station["name"] == name and station["payloads"] == [PAYLOAD]
        answer = other.client.post(f"/api/payloads/{PAYLOAD}/relocalize")
        assert answer.json()["done"], answer.text
        asked = f"relocalize was asked for at station '{other_name}'"
        for page in (used, other):
            eventually(lambda page=page: asked in str(page.state()["events"]), _LIMIT_S)
        eventually(lambda: f"no-frames/{PAYLOAD}" not in alarms(other), _LIMIT_S)
        choice = f"/api/payloads/{PAYLOAD}/station"
        assert used.client.post(choice, json={"name": "attic"}).status_code == 404
        answer = used.client.post(choice, json={"name": other_name})
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
        eventually(lambda: f"station/{name}" in alarms(other), _LIMIT_S)
        eventually(lambda: other.has(PAYLOAD), _LIMIT_S)
        eventually(lambda: other.state()["recording"]["active"], _LIMIT_S)
        other.record(active=False)
        (cut,) = [path.name for path in used.recordings.iterdir()]
        recordings = "/api/recordings"
        eventually(lambda: not other.client.get(recordings).json()[0]["active"], _LIMIT_S)
        (file,) = other.client.get(recordings).json()
        assert file["after"] == f"{name}/{cut}" and file["duration_s"] > 0.0
        used.start()
        eventually(lambda: f"station/{name}" not in alarms(other), _LIMIT_S)
        eventually(lambda: len(listed(used, station)) == 1, _LIMIT_S)
        assert listed(used, station)[0]["file"] == file["file"]
        url = f"/api/stations/{station}/recordings/{file['file']}"
        assert used.client.get(url).content == (other.recordings / file["file"]).read_bytes()
        hello = played(used, url)
        assert hello["payload"] == PAYLOAD and hello["tape"]["length_s"] == file["duration_s"]
        assert used.client.get("/api/stations/nobody/recordings").status_code == 404
