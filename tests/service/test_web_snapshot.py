"""The snapshot is bounded whatever comes, and tells how old each value is."""

from __future__ import annotations

import time

import numpy as np
import pytest
import web_station as station
from station_notes import Clock

from ground_station.service import settings
from ground_station.service.web import trail
from ground_station.service.web.models import PayloadModel
from ground_station.service.web.snapshot import EVENTS, EVENTS_SHOWN, PAYLOADS, PROCESSES, Snapshot

S = 1_000_000_000
P = station.PAYLOAD


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def snapshot(tmp_path, clock):
    return Snapshot(station.run_of(tmp_path), "0", clock)


@pytest.mark.parametrize(("host", "loopback"), [("127.0.0.1", True), ("0.0.0.0", False)])
def test_it_tells_whether_the_network_reaches_the_station(host, loopback):
    run = settings.Run(settings.load(None, [f"video.host={host}"]))
    assert Snapshot(run, "0").document()["station"]["loopback"] is loopback


def test_values_carry_their_age_and_go_stale(snapshot, clock):
    snapshot.payload(P, station.payload())
    snapshot.estimate(P, station.estimate())
    clock.ns += 4 * S
    # The same battery message told again is as old as it was.
    again = station.payload(battery=snapshot.document()["payloads"][P]["payload"]["battery"])
    snapshot.payload(P, again)
    view = snapshot.document()["payloads"][P]
    assert view["age_s"]["payload"] == 0
    assert view["age_s"]["estimate"] == view["age_s"]["battery"] == 4
    assert view["age_s"]["frame"] is None
    assert view["stale"] == ["estimate"]
    assert view.keys() == PayloadModel.model_fields.keys()  # the API's description has them all


def test_a_payload_that_falls_silent_is_not_alive_whatever_it_last_said(snapshot, clock):
    snapshot.payload(P, station.payload(alive=True))
    assert snapshot.living() == [P]
    clock.ns += 6 * S
    assert snapshot.living() == [] and snapshot.payload_ids() == [P]


def test_payloads_are_bounded_and_the_living_stay(snapshot, clock):
    forgotten: list[str] = []
    snapshot.evicted = forgotten.append
    snapshot.payload("first", station.payload())
    for number in range(5 * PAYLOADS):
        snapshot.frame(f"p-{number}", station.frame())
        clock.ns += S // 1000
    assert len(snapshot.payload_ids()) == PAYLOADS
    assert "first" in snapshot.payload_ids() and "p-0" in forgotten
    snapshot.frame("NO ID/..", station.frame())
    assert "NO ID/.." not in snapshot.payload_ids()


def test_events_processes_and_points_are_bounded(snapshot):
    for number in range(2000):
        snapshot.event(P, station.event(text="x" * 5000, name=str(number)))
        snapshot.process("-", station.process(f"process-{number}", number))
    snapshot.estimate(P, station.estimate(points_px=[1.0] * 100_000))
    document = snapshot.document()
    assert len(document["events"]) == EVENTS_SHOWN
    assert document["events"][-1]["name"] == "1999"
    assert len(document["events"][-1]["text"]) == 500
    assert len(document["processes"]) == PROCESSES
    assert len(document["payloads"][P]["estimate"]["points_px"]) == 600


def test_a_recording_that_went_on_before_anyone_listened_is_an_event_once(snapshot):
    text = "flight-000001.mcap was cut"
    for seconds in (3.0, 4.0):
        snapshot.recording("-", station.recording(active=True, resumed=text, duration_s=seconds))
    (event,) = snapshot.events()
    assert (event["name"], event["level"], event["text"]) == ("recording-resumed", "warning", text)
    assert 2e9 < time.time_ns() - event["time_ns"] < 60e9


def test_a_recording_that_goes_on_while_one_listens_is_its_own_event(snapshot):
    snapshot.recording("-", station.recording())
    snapshot.recording("-", station.recording(active=True, resumed="flight-000001.mcap was cut"))
    assert snapshot.events() == []  # the intake said it, and is heard


def test_a_process_that_ended_is_forgotten_and_one_with_another_pid_was_restarted(snapshot, clock):
    snapshot.process("-", station.process(pid=1))
    snapshot.process("-", station.process("web", pid=2))
    snapshot.process("-", station.process(pid=3))
    by_name = {item["name"]: item for item in snapshot.document()["processes"]}
    assert by_name["intake"]["restarts"] == 1 and by_name["intake"]["restarted_s"] == 0
    assert by_name["web"]["restarts"] == 0 and by_name["web"]["restarted_s"] is None
    clock.ns += 61 * S
    assert snapshot.document()["processes"] == []


def test_the_short_document_lacks_what_is_long(snapshot):
    snapshot.estimate(P, station.estimate())
    short = snapshot.document(full=False)
    assert "events" not in short and "trail" not in short["payloads"][P]
    assert short["payloads"][P]["estimate"]["points_px"] == []
    assert snapshot.document()["payloads"][P]["estimate"]["points_px"] != []


def test_a_trail_of_an_hour_is_bounded_recent_and_fine_where_it_is_young():
    walked, now_ns = trail.Trail(), 0
    for step in range(60_000):
        now_ns += S // 30
        walked.add(now_ns, [0.06 * step, 0.0, 1.0])
    points, breaks = walked.document()
    assert len(points) <= trail.MOST and breaks == []
    steps = np.diff([point[0] for point in points])
    assert steps.min() > 0 and np.allclose(steps[-500:], 0.06, atol=0.002)
    assert points[-1][0] == pytest.approx(0.06 * 59_999, abs=0.01)


def test_a_trail_that_is_broken_at_each_point_is_bounded_too():
    walked = trail.Trail()
    for step in range(3 * trail.MOST):
        walked.add(step, [float(step), 0.0, 0.0], begins=True)
    assert len(walked.document()[0]) <= trail.MOST


def test_a_trail_leads_nowhere_while_nothing_is_known():
    walked = trail.Trail()
    for at_s, x_m in ((0, 0.0), (1, 1.0), (2, 2.0), (9, 5.0), (10, 6.0)):
        walked.add(at_s * S, [x_m, 0.0, 0.0])
    walked.add(11 * S, [20.0, 0.0, 0.0], begins=True)
    assert walked.document()[1] == [3, 5]


def test_standing_still_is_no_gap_and_takes_no_room():
    walked = trail.Trail()
    for at in range(300):
        walked.add(at * S // 10, [0.001 * (at % 2), 0.0, 0.0])
    walked.add(30 * S, [1.0, 0.0, 0.0])
    points, breaks = walked.document()
    assert len(points) == 2 and breaks == []


def test_events_outlive_the_web_process_and_their_file_is_bounded(tmp_path):
    path = tmp_path / "events.jsonl"
    path.write_bytes(b'{"cut\n[]\n{"payload": 1}\n\xff')
    first = Snapshot(station.run_of(tmp_path), "0")
    first.keep_events(path)
    for k in range(3 * EVENTS):
        first.event(P, station.event(text=f"event {k}"))
    assert path.read_text().count("\n") <= 2 * EVENTS
    with path.open("a") as file:
        file.write('{"killed while')
    second = Snapshot(station.run_of(tmp_path), "0")
    second.keep_events(path)
    assert second.events() == first.events()
    assert second.events()[-1]["text"] == f"event {3 * EVENTS - 1}"
    assert second.events()[-1]["payload"] == P
