"""The HTTP API: what it tells, what it passes on, and that it fails in one line."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import web_station as station
from prometheus_client.parser import text_string_to_metric_families

from ground_station.service import bus_messages

P = station.PAYLOAD


# State and metrics


def test_the_state_tells_what_was_said(served):
    client, bus, _ = served
    bus.put(bus_messages.EVENT, P, station.event(text="second"))
    state = client.get("/api/state").json()
    view = state["payloads"][P]
    assert view["alive"] and view["estimate"]["state"] == "TRACKING"
    assert view["trail"] == [[1.0, 2.0, 1.5]]
    assert [item["text"] for item in state["events"]] == ["a text", "second"]
    assert state["station"]["map"] == "atrium" and state["station"]["name"] == "main"
    assert state["processes"][0]["name"] == "intake"


def test_alarms_stand_in_the_state_and_are_told_to_the_others(served):
    client, bus, _ = served
    bus.put(
        bus_messages.RECORDING, bus_messages.STATION, station.recording(problem="the disk is full")
    )
    station.eventually(lambda: client.get("/api/state").json()["alarms"])
    (alarm,) = client.get("/api/state").json()["alarms"]
    assert (alarm["id"], alarm["level"], alarm["payload"]) == ("recording", "alarm", "-")
    (said,) = [note for kind, _, note in bus.said if kind == bus_messages.EVENT]
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
    bus.put(bus_messages.PROCESS, bus_messages.STATION, station.process(pid=101))
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
        bus.put(bus_messages.PROCESS, bus_messages.STATION, station.process(name, 1))
        bus.put(bus_messages.PROCESS, bus_messages.STATION, station.process(name, 2))
    web.live.step()
    lines = [line.rpartition(" ")[0] for line in client.get("/metrics").text.splitlines()]
    series = [line for line in lines if not line.startswith("#")]
    assert len(series) == len(set(series))
    assert sum("blimp_alarm{" in line for line in series) == 3


def test_latencies_of_a_clock_that_was_stepped_do_not_count(served):
    client, bus, _ = served
    for capture_ns in (0, 1 << 62, None):
        bus.put(bus_messages.ESTIMATE, P, station.estimate(capture_ns=capture_ns))
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
def test_what_is_not_as_described_is_asked_of_nobody(unchanged, path, body, status):
    client, bus, _ = unchanged
    answer = client.post(f"/api/{path}", json=body)
    assert answer.status_code == status
    assert isinstance(answer.json()["detail"], str) and "\n" not in answer.json()["detail"]
    assert bus.asked == []


def test_a_number_that_is_none_is_refused(unchanged):
    client, bus, _ = unchanged
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

    monkeypatch.setattr(bus, "query", fails)
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
def test_errors_have_a_detail(unchanged, method, path, status):
    answer = unchanged[0].request(method, path)
    assert answer.status_code == status
    assert isinstance(answer.json()["detail"], str)


def test_the_description_describes_every_error_as_it_is(unchanged):
    schema = unchanged[0].get("/api/openapi.json").json()
    assert "HTTPValidationError" not in schema["components"]["schemas"]
    page = unchanged[0].get("/api/docs").text
    for path in schema["paths"]:
        assert path in page


def test_only_so_many_wait_for_an_answer(served, monkeypatch):
    client, bus, _ = served
    answer, asked = threading.Event(), threading.Semaphore(0)

    def waits(*_, **__):
        asked.release()
        assert answer.wait(30.0)
        return {"done": True}

    monkeypatch.setattr(bus, "query", waits)

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
