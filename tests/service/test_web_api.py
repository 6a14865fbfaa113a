"""The HTTP API: what it tells, what it passes on, and that it fails in one line."""

from __future__ import annotations

import os
import struct
import threading
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import web_station as station
from prometheus_client.parser import text_string_to_metric_families

from ground_station.mapping.store import load_info
from ground_station.service import notes
from ground_station.service.settings import MapSettings
from ground_station.service.web import maps
from ground_station.service.web.app import build
from pi_firmware.wire.errors import BlimpError

HERE = "http://127.0.0.1:8080"
P = station.PAYLOAD


@pytest.fixture
def served(tmp_path):
    bus = station.SilentBus()
    web = build(station.run_of(tmp_path), tmp_path, bus, None)
    client = station.TestClient(
        web.guarded, HERE, follow_redirects=False, raise_server_exceptions=False
    )
    with client:
        station.say_all(bus.put)
        yield client, bus, web


# State and metrics


def test_the_state_tells_what_was_said(served):
    client, bus, _ = served
    bus.put(notes.EVENT, P, station.event(text="second"))
    state = client.get("/api/state").json()
    view = state["payloads"][P]
    assert view["alive"] and view["estimate"]["state"] == "TRACKING"
    assert view["trail"] == [[1.0, 2.0, 1.5]]
    assert [item["text"] for item in state["events"]] == ["a text", "second"]
    assert state["station"]["map"] == "atrium" and state["station"]["name"] == "main"
    assert state["processes"][0]["name"] == "intake"


def test_alarms_stand_in_the_state_and_are_told_to_the_others(served):
    client, bus, _ = served
    bus.put(notes.RECORDING, notes.STATION, station.recording(problem="the disk is full"))
    station.until(lambda: client.get("/api/state").json()["alarms"])
    (alarm,) = client.get("/api/state").json()["alarms"]
    assert (alarm["id"], alarm["level"], alarm["payload"]) == ("recording", "alarm", "-")
    (said,) = [note for kind, _, note in bus.said if kind == notes.EVENT]
    assert (said.source, said.level, said.name) == ("web", "alarm", "alarm-begins")


def families(client):
    answer = client.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    return {family.name: family for family in text_string_to_metric_families(answer.text)}


def value(found, name, **labels):
    family = next(family for family in found.values() if name.startswith(family.name))
    values = [s.value for s in family.samples if s.name == name and s.labels == labels]
    assert len(values) == 1, (name, labels, family.samples)
    return values[0]


def test_metrics_tell_the_same_numbers(served):
    client, bus, _ = served
    bus.put(notes.PROCESS, notes.STATION, station.process(pid=101))
    found = families(client)
    assert value(found, "blimp_frames_total", payload=P, fate="captured") == 100
    assert value(found, "blimp_frames_total", payload=P, fate="localized") == 8
    assert value(found, "blimp_battery_volts", payload=P) == 3.9
    assert value(found, "blimp_state", payload=P, state="TRACKING") == 1
    assert value(found, "blimp_state", payload=P, state="LOST") == 0
    assert value(found, "blimp_payload_up", payload=P) == 1
    assert value(found, "blimp_process_resident_bytes", process="intake") == 80e6
    assert value(found, "blimp_process_restarts_total", process="intake") == 1
    assert value(found, "blimp_capture_to_pose_seconds_count", payload=P) == 1
    assert value(found, "blimp_capture_to_pose_seconds_sum", payload=P) == pytest.approx(0.04)
    assert value(found, "blimp_capture_to_pose_seconds_bucket", payload=P, le="0.03") == 0
    assert value(found, "blimp_capture_to_pose_seconds_bucket", payload=P, le="0.05") == 1
    assert value(found, "blimp_stage_seconds_sum", payload=P, stage="track") == 0.005
    assert value(found, "blimp_bus_dropped_total") == 0
    for family in found.values():
        assert family.documentation, family.name
        assert family.name.startswith("blimp_")


def test_no_series_comes_twice_whatever_stands(served):
    client, bus, web = served
    for name in ("intake", "web", "foxglove"):
        bus.put(notes.PROCESS, notes.STATION, station.process(name, 1))
        bus.put(notes.PROCESS, notes.STATION, station.process(name, 2))
    web.live.step()
    lines = [line.rpartition(" ")[0] for line in client.get("/metrics").text.splitlines()]
    series = [line for line in lines if not line.startswith("#")]
    assert len(series) == len(set(series))
    assert sum("blimp_alarm{" in line for line in series) == 3


def test_latencies_of_a_clock_that_was_stepped_do_not_count(served):
    client, bus, _ = served
    for capture_ns in (0, 1 << 62, None):
        bus.put(notes.ESTIMATE, P, station.estimate(capture_ns=capture_ns))
    assert value(families(client), "blimp_capture_to_pose_seconds_count", payload=P) == 1


def test_series_of_a_forgotten_payload_go(served):
    client, _, web = served
    assert f'payload="{P}"' in client.get("/metrics").text
    web.metrics.forget(P)
    text = client.get("/metrics").text
    assert "blimp_capture_to_pose_seconds_count" not in text
    assert "blimp_stage_seconds_sum" not in text


# Control


def test_commands_reach_the_intake_as_they_were_given(served):
    client, bus, _ = served
    bus.answer = {"done": True, "reason": "", "values": {"kbps": 1500}}
    request = {"name": "bitrate", "arguments": {"kbps": 1500}}
    answer = client.post(f"/api/payloads/{P}/command", json=request)
    assert answer.json() == {"done": True, "reason": "", "values": {"kbps": 1500}}
    assert bus.asked == [("intake", {"do": "payload-command", "payload": P, **request})]


def test_a_refusal_is_an_answer(served):
    client, bus, _ = served
    bus.answer = {"done": False, "reason": "kbps is 5; allowed: 100 to 8000"}
    answer = client.post(f"/api/payloads/{P}/command", json={"name": "idr"})
    assert (answer.status_code, answer.json()["done"]) == (200, False)
    assert answer.json()["reason"] == "kbps is 5; allowed: 100 to 8000"


def test_localizers_and_recording_are_asked(served):
    client, bus, _ = served
    client.post(f"/api/payloads/{P}/relocalize", json={})
    client.post(f"/api/payloads/{P}/map", json={"name": "atrium"})
    client.post("/api/recording", json={"active": True})
    client.post("/api/recording", json={"active": False})
    assert bus.asked == [
        (f"localizer/{P}", {"do": "relocalize"}),
        (f"localizer/{P}", {"do": "map", "name": "atrium"}),
        ("intake", {"do": "record-start"}),
        ("intake", {"do": "record-stop"}),
    ]


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("payloads/blimp-9/command", {"name": "idr"}, 404),
        ("payloads/BLIMP/command", {"name": "idr"}, 422),
        ("payloads/*/relocalize", {}, 422),
        (f"payloads/{P}/command", {"name": "format-disk"}, 422),
        (f"payloads/{P}/command", {"name": "idr", "more": 1}, 422),
        (f"payloads/{P}/command", {"name": "idr", "arguments": {"a": "x"}}, 422),
        (f"payloads/{P}/command", {"name": "idr", "arguments": {"a": 1e300}}, 422),
        (f"payloads/{P}/command", {"name": "idr", "arguments": {"a b": 1}}, 422),
        (f"payloads/{P}/command", {"name": "idr", "arguments": dict.fromkeys("abcdefghi", 1)}, 422),
        (f"payloads/{P}/command", [], 422),
        (f"payloads/{P}/map", {"name": "no-such"}, 404),
        (f"payloads/{P}/map", {"name": "../atrium"}, 422),
        ("recording", {"active": 1}, 422),
        ("recording", {"active": None}, 422),
        ("recording", {}, 422),
    ],
)
def test_what_is_not_as_described_is_asked_of_nobody(served, path, body, status):
    client, bus, _ = served
    answer = client.post(f"/api/{path}", json=body)
    assert answer.status_code == status
    assert isinstance(answer.json()["detail"], str) and "\n" not in answer.json()["detail"]
    assert bus.asked == []


def test_a_number_that_is_none_is_refused(served):
    client, bus, _ = served
    for number in ("NaN", "Infinity", "-Infinity", "1e999"):
        answer = client.post(
            f"/api/payloads/{P}/command",
            content=f'{{"name": "idr", "arguments": {{"a": {number}}}}}',
            headers={"content-type": "application/json"},
        )
        assert answer.status_code == 422
    assert bus.asked == []


# Errors


def test_what_fails_here_is_one_line_and_no_traceback(served, monkeypatch, capsys):
    client, bus, _ = served

    def fails(*_, **__):
        raise ZeroDivisionError("secret of the station")

    monkeypatch.setattr(bus, "ask", fails)
    answer = client.post("/api/recording", json={"active": True})
    assert answer.status_code == 500
    assert answer.json() == {"detail": "the station failed at this; its log says more"}
    assert "x-content-type-options" in answer.headers
    assert "ZeroDivisionError" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/api/nope", 404), ("GET", "/static/nope.js", 404), ("DELETE", "/api/state", 405),
        ("PUT", "/api/recording", 405), ("GET", "/api/recording", 405), ("TRACE", "/", 405),
        ("GET", "/api/state/", 404), ("GET", "/static/", 404), ("GET", "/static/%2e%2e/app", 404),
        ("GET", "/docs", 404), ("GET", "/redoc", 404), ("GET", "/openapi.json", 404),
    ],
)  # fmt: skip
def test_errors_have_a_detail(served, method, path, status):
    answer = served[0].request(method, path)
    assert answer.status_code == status
    assert isinstance(answer.json()["detail"], str)


def test_the_description_describes_every_error_as_it_is(served):
    schema = served[0].get("/api/openapi.json").json()
    assert "HTTPValidationError" not in schema["components"]["schemas"]
    page = served[0].get("/api/docs").text
    for path in schema["paths"]:
        assert path in page


# Maps


def test_the_sample_map(served):
    client = served[0]
    assert [item["name"] for item in client.get("/api/maps").json()] == ["atrium"]
    details = client.get("/api/maps/atrium").json()
    plan = details["floorplan"]
    picture = client.get(plan["url"])
    assert picture.headers["content-type"] == "image/png"
    width, height = struct.unpack(">II", picture.content[16:24])
    assert (width, height) == (plan["width_px"], plan["height_px"])
    points = np.frombuffer(client.get("/api/maps/atrium/landmarks").content, "<f4").reshape(-1, 3)
    assert len(points) == details["landmarks"]
    assert np.allclose(points.min(axis=0), details["bounds"]["min"], atol=1e-3)
    assert np.allclose(np.ptp(points, axis=0), details["extent_m"], atol=2e-3)
    own = load_info(station.ATRIUM).camera
    told = details["camera"]
    assert (told["width_px"], told["height_px"]) == (own.width_px, own.height_px)
    assert told["K"] == own.matrix.tolist() and told["distortion"] == own.distortion.tolist()


def test_a_configured_camera_takes_the_place_of_the_maps(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text(
        "width_px = 320\nheight_px = 240\nfx_px = 250.0\nfy_px = 251.0\ncx_px = 160.0\n"
        "cy_px = 120.0\nk1 = 0.1\n"
    )
    shelf = maps.Maps(MapSettings(folder=str(station.ATRIUM), camera=str(path)))
    camera = shelf.details("atrium")["camera"]
    assert camera["K"][0] == [250.0, 0.0, 160.0] and camera["distortion"][0] == 0.1
    assert (camera["width_px"], camera["height_px"]) == (320, 240)


def test_what_is_the_same_is_not_sent_again(served):
    client = served[0]
    first = client.get("/api/maps/atrium/landmarks")
    again = client.get(
        "/api/maps/atrium/landmarks", headers={"if-none-match": first.headers["etag"]}
    )
    assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize("name", ["nope", "..", "...", "%2e%2e", "..%2fatrium", ".hidden", "a%00b"])
@pytest.mark.parametrize("rest", ["", "/landmarks", "/floorplan.png"])
def test_maps_are_asked_for_by_name_only(served, name, rest):
    assert served[0].get(f"/api/maps/{name}{rest}").status_code in (404, 422)


def save_map(folder, positions, plan=b""):
    from safetensors.numpy import save

    folder.mkdir(parents=True)
    text = (station.ATRIUM / "map.toml").read_text()
    (folder / "map.toml").write_text(text)
    (folder / "landmarks.safetensors").write_bytes(save({"position_m": positions}))
    if plan:
        (folder / "floorplan.yaml").write_bytes(plan)


def shelf_of(tmp_path):
    return maps.Maps(MapSettings(folder=str(station.ATRIUM), shelf=str(tmp_path / "shelf")))


def test_a_large_map_is_drawn_evenly(tmp_path):
    positions = np.column_stack([np.arange(50_000.0)] * 3)
    save_map(tmp_path / "shelf" / "large", positions)
    drawn = np.frombuffer(shelf_of(tmp_path).landmarks("large"), "<f4").reshape(-1, 3)
    assert len(drawn) == maps.LANDMARKS
    steps = np.diff(drawn[:, 0])
    assert steps.min() >= 2 and steps.max() <= 3


def test_maps_that_cannot_be_read_are_left_out_and_refused_by_name(tmp_path):
    shelf = tmp_path / "shelf"
    save_map(shelf / "good", np.zeros((3, 3)), b"image: ../../secret.png\nresolution: 1")
    save_map(shelf / "nan", np.full((3, 3), np.nan))
    save_map(shelf / "flat", np.zeros((3, 2)))
    save_map(shelf / "cut", np.zeros((3, 3)))
    (shelf / "cut" / "landmarks.safetensors").write_bytes(b"\xff" * 40)
    (shelf / "no-map").mkdir()
    (shelf / "link").symlink_to(station.ATRIUM)
    found = shelf_of(tmp_path)
    assert {item["name"] for item in found.list()} == {"good", "atrium"}
    assert found.details("good")["floorplan"] is None
    for name in ("nan", "flat", "cut", "link", "no-map"):
        with pytest.raises(BlimpError):
            found.details(name)


def test_a_map_that_is_made_anew_is_read_anew(tmp_path):
    folder = tmp_path / "shelf" / "one"
    save_map(folder, np.zeros((3, 3)))
    found = shelf_of(tmp_path)
    assert found.details("one")["landmarks"] == 3
    (folder / "map.toml").unlink()
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    save_map(folder, np.zeros((5, 3)))
    assert found.details("one")["landmarks"] == 5


# Recordings


@pytest.fixture
def shelf(tmp_path, served):
    return tmp_path / "recordings"


def write_recording(path, seconds=2.0):
    from mcap.writer import Writer

    with path.open("wb") as file:
        mcap = Writer(file)
        mcap.start()
        channel = mcap.register_channel("x", "json", 0)
        for at_ns in (0, int(seconds * 1e9)):
            mcap.add_message(channel, at_ns, b"{}", at_ns)
        mcap.finish()


def test_recordings_are_listed_with_size_and_duration(served, shelf):
    client, bus, _ = served
    write_recording(shelf / "a.mcap")
    write_recording(shelf / "b.mcap", 3.5)
    (shelf / "cut.mcap").write_bytes((shelf / "a.mcap").read_bytes()[:-30])
    (shelf / "not-one.txt").write_text("x")
    (shelf / "folder.mcap").mkdir()
    (shelf / "link.mcap").symlink_to("/etc/passwd")
    bus.put(notes.RECORDING, notes.STATION, station.recording(active=True, file="b.mcap"))
    listed = {item["file"]: item for item in client.get("/api/recordings").json()}
    assert set(listed) == {"a.mcap", "b.mcap", "cut.mcap"}
    assert listed["a.mcap"]["duration_s"] == 2.0
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


@pytest.mark.parametrize(
    "name",
    [
        "nope.mcap", "..", "../secret.mcap", "..%2fsecret.mcap", "%2e%2e%2fsecret.mcap",
        "..%252fsecret.mcap", "..%5csecret.mcap", "%2fetc%2fpasswd", "/etc/passwd",
        "link.mcap", "folder.mcap", "pipe.mcap", ".hidden.mcap", "a.mcap%00", "a.mcap%0a",
        "a.txt", "inner%2fa.mcap", "....//secret.mcap", "x" * 300 + ".mcap",
    ],
)  # fmt: skip
@pytest.mark.parametrize("rest", ["", "/trajectory.txt"])
def test_no_path_leaves_the_folder(served, shelf, name, rest):
    secret = shelf.parent / "secret.mcap"
    write_recording(secret)
    write_recording(shelf / "a.mcap")
    write_recording(shelf / ".hidden.mcap")
    (shelf / "a.txt").write_text("x")
    (shelf / "folder.mcap").mkdir()
    (shelf / "inner").mkdir()
    write_recording(shelf / "inner" / "a.mcap")
    (shelf / "link.mcap").symlink_to(secret)
    os.mkfifo(shelf / "pipe.mcap")
    assert served[0].get(f"/api/recordings/{name}{rest}").status_code in (404, 422)


def test_a_trajectory_is_sent_as_lines_and_one_at_a_time(served, shelf, monkeypatch):
    client, _, _ = served
    from ground_station.service import export

    write_recording(shelf / "a.mcap")
    monkeypatch.setattr(export, "tum_lines", lambda path: iter(["# tum\n", "1 2 3 4 5 6 7 8\n"]))
    for _ in range(3):  # each ends and lets the next one in
        answer = client.get("/api/recordings/a.mcap/trajectory.txt")
        assert answer.text == "# tum\n1 2 3 4 5 6 7 8\n"
        assert answer.headers["content-type"].startswith("text/plain")

    def refuses(_):
        raise BlimpError("a.mcap: no poses in it")

    monkeypatch.setattr(export, "tum_lines", refuses)
    for _ in range(2):
        answer = client.get("/api/recordings/a.mcap/trajectory.txt")
        assert (answer.status_code, answer.json()) == (409, {"detail": "a.mcap: no poses in it"})


def test_what_grows_while_it_is_sent_ends_where_it_was(shelf, served):
    from ground_station.service.web.recordings import _pieces

    path = shelf / "a.mcap"
    path.write_bytes(b"x" * 1000)
    descriptor = os.open(path, os.O_RDONLY)
    pieces = _pieces(descriptor, 0, 1000)
    path.write_bytes(b"y" * 5000)
    assert len(b"".join(pieces)) == 1000
    with pytest.raises(OSError):
        os.fstat(descriptor)


def test_only_so_many_wait_for_an_answer(served, monkeypatch):
    client, bus, _ = served
    answer, asked = threading.Event(), threading.Semaphore(0)

    def waits(*_, **__):
        asked.release()
        assert answer.wait(30.0)
        return {"done": True}

    monkeypatch.setattr(bus, "ask", waits)

    def post(_):
        return client.post("/api/recording", json={"active": True}).status_code

    with ThreadPoolExecutor(8) as threads:
        waiting = threads.map(post, range(8))
        for _ in range(8):
            assert asked.acquire(timeout=30.0)
        late = client.post("/api/recording", json={"active": True})
        assert late.status_code == 429 and late.headers["retry-after"]
        answer.set()
        assert list(waiting) == [200] * 8
