"""Recordings over HTTP: listed, sent whole or in part, as trajectories, and from one folder."""

from __future__ import annotations

import asyncio
import os
import zlib
from pathlib import Path

import numpy as np
import pytest
import web_station as station
from fastapi import FastAPI

from ground_station.service import bus_messages
from ground_station.service.web.access import Buckets
from ground_station.service.web.recordings import Recordings, router
from pi_firmware.wire.errors import BlimpError


@pytest.fixture
def shelf(tmp_path, served):
    return tmp_path / "recordings"


def open_files(path):
    links = (os.path.realpath(link) for link in Path("/proc/self/fd").iterdir())
    return [link for link in links if link == str(path)]


def test_recordings_are_listed_with_size_and_duration(served, shelf):
    client, bus, _ = served
    station.write_recording(shelf / "a.mcap", maps=("hall", "hall", "atrium"))
    station.write_recording(shelf / "b.mcap", 3.5)
    (shelf / "cut.mcap").write_bytes((shelf / "a.mcap").read_bytes()[:-30])
    (shelf / "not-one.txt").write_text("x")
    (shelf / "folder.mcap").mkdir()
    (shelf / "link.mcap").symlink_to("/etc/passwd")
    bus.put(
        bus_messages.RECORDING, bus_messages.STATION, station.recording(active=True, file="b.mcap")
    )
    listed = {item["file"]: item for item in client.get("/api/recordings").json()}
    assert set(listed) == {"a.mcap", "b.mcap", "cut.mcap"}
    assert listed["a.mcap"]["duration_s"] == 2.0 and listed["a.mcap"]["started_ns"] == 0
    assert listed["a.mcap"]["maps"] == ["atrium", "hall"] and listed["cut.mcap"]["maps"] == []
    assert listed["b.mcap"]["active"] and listed["b.mcap"]["duration_s"] is None
    assert listed["cut.mcap"]["duration_s"] is None and not listed["cut.mcap"]["active"]
    assert listed["a.mcap"]["size_MB"] == round((shelf / "a.mcap").stat().st_size / 1e6, 3)


def test_a_recording_is_downloaded_whole_or_in_part(served, shelf):
    client = served[0]
    data = np.random.default_rng(0).bytes(700_000)
    (shelf / "a.mcap").write_bytes(data)
    whole = client.get("/api/recordings/a.mcap")
    assert zlib.crc32(whole.content) == zlib.crc32(data)
    assert whole.headers["content-disposition"] == 'attachment; filename="a.mcap"'
    for asked, part in (
        ("bytes=0-0", data[:1]), ("bytes=699990-", data[-10:]), ("bytes=-10", data[-10:]),
        ("bytes=10-19", data[10:20]), ("bytes=5-9999999", data[5:]),
    ):  # fmt: skip
        answer = client.get("/api/recordings/a.mcap", headers={"range": asked})
        assert (answer.status_code, answer.content) == (206, part), asked
        assert answer.headers["content-range"].endswith("/700000")
    for asked in ("bytes=700000-", "bytes=-0", "bytes=99999999999-"):
        answer = client.get("/api/recordings/a.mcap", headers={"range": asked})
        assert answer.status_code == 416
        assert answer.headers["content-range"] == "bytes */700000"
    for asked in ("bytes=9-5", "bytes=0-1,3-4", "lines=1-2", "bytes=-", "x" * 500):
        assert client.get("/api/recordings/a.mcap", headers={"range": asked}).status_code == 200


def test_no_path_leaves_the_folder(served, shelf):
    secret = shelf.parent / "secret.mcap"
    station.write_recording(secret)
    station.write_recording(shelf / "a.mcap")
    station.write_recording(shelf / ".hidden.mcap")
    (shelf / "a.txt").write_text("x")
    (shelf / "folder.mcap").mkdir()
    (shelf / "inner").mkdir()
    station.write_recording(shelf / "inner" / "a.mcap")
    (shelf / "link.mcap").symlink_to(secret)
    os.mkfifo(shelf / "pipe.mcap")
    before = sorted(shelf.parent.rglob("*"))
    served[2].access.posts = Buckets(1e9, 10**9)
    for name in (
        "nope.mcap", "..", "../secret.mcap", "..%2fsecret.mcap", "%2e%2e%2fsecret.mcap",
        "..%252fsecret.mcap", "..%5csecret.mcap", "%2fetc%2fpasswd", "/etc/passwd",
        "link.mcap", "folder.mcap", "pipe.mcap", ".hidden.mcap", "a.mcap%00", "a.mcap%0a",
        "a.txt", "inner%2fa.mcap", "....//secret.mcap", "x" * 300 + ".mcap",
    ):  # fmt: skip
        for path in (f"/api/recordings/{name}", f"/api/recordings/{name}/trajectory.txt"):
            assert served[0].get(path).status_code in (404, 422), path
            assert served[0].delete(path).status_code in (404, 405, 422), path
            assert sorted(shelf.parent.rglob("*")) == before, path


def test_a_recording_is_deleted_but_not_the_one_being_written(served, shelf):
    client, bus, _ = served
    for name in ("a.mcap", "b.mcap"):
        station.write_recording(shelf / name)
    bus.put(
        bus_messages.RECORDING, bus_messages.STATION, station.recording(active=True, file="b.mcap")
    )
    refused = client.delete("/api/recordings/b.mcap")
    assert refused.status_code == 409 and "stop the recording first" in refused.json()["detail"]
    foreign = client.delete("/api/recordings/a.mcap", headers={"origin": "http://elsewhere"})
    assert foreign.status_code == 403
    assert client.delete("/api/recordings/a.mcap").json()["done"]
    assert [path.name for path in shelf.iterdir()] == ["b.mcap"]
    assert client.delete("/api/recordings/a.mcap").status_code == 404


def test_a_trajectory_is_sent_as_lines_and_one_at_a_time(served, shelf, monkeypatch):
    client, _, _ = served
    from ground_station.recording import export

    station.write_recording(shelf / "a.mcap")
    monkeypatch.setattr(export, "read_poses", lambda path: path)
    monkeypatch.setattr(export, "tum", lambda path: iter(["# tum\n", "1 2 3 4 5 6 7 8\n"]))
    for _ in range(3):  # each ends and lets the next one in
        answer = client.get("/api/recordings/a.mcap/trajectory.txt")
        assert answer.text == "# tum\n1 2 3 4 5 6 7 8\n"
        assert answer.headers["content-type"].startswith("text/plain")

    def refuses(_):
        raise BlimpError("a.mcap: no poses in it")

    monkeypatch.setattr(export, "read_poses", refuses)
    for _ in range(2):
        answer = client.get("/api/recordings/a.mcap/trajectory.txt")
        assert (answer.status_code, answer.json()) == (409, {"detail": "a.mcap: no poses in it"})


def test_who_leaves_before_the_first_byte_leaves_nothing_open(tmp_path):
    app = FastAPI()
    app.include_router(router(Recordings(tmp_path, lambda: "")))
    path = tmp_path / "a.mcap"
    path.write_bytes(b"x" * 1000)
    sent = []

    async def gone():
        return {"type": "http.disconnect"}

    async def send(message):
        sent.append(message["type"])
        await asyncio.sleep(0)  # where whoever has left is noticed

    async def ask():
        scope = {
            "type": "http", "asgi": {"version": "3.0", "spec_version": "2.3"}, "method": "GET",
            "path": "/api/recordings/a.mcap", "query_string": b"", "headers": [],
        }  # fmt: skip
        for _ in range(5):
            await app(scope, gone, send)

    asyncio.run(ask())
    assert sent.count("http.response.start") == 5
    assert not open_files(path)


def test_what_grows_while_it_is_sent_ends_where_it_was(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"x" * 1000)
    pieces = Recordings(tmp_path, lambda: "").pieces("a.mcap", 0, 1000)
    path.write_bytes(b"y" * 5000)
    assert len(b"".join(pieces)) == 1000
    assert not open_files(path)
