"""Alarms: each comes with its cause, stays while the cause flickers, and goes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
import web_station as station
from station_notes import Clock

from ground_station.service import alarms, bus_messages
from ground_station.service.web.snapshot import Snapshot

S = 1_000_000_000


@pytest.fixture
def told(tmp_path):
    """A station that flies, its clock, and what its alarms are after some time."""
    clock = Clock()
    snapshot = Snapshot(station.run_of(tmp_path), "0", clock)
    say: dict[str, Callable[[str, Any], None]] = {
        bus_messages.FRAME: snapshot.frame, bus_messages.ESTIMATE: snapshot.estimate,
        bus_messages.PAYLOAD: snapshot.payload, bus_messages.EVENT: snapshot.event,
        bus_messages.RECORDING: snapshot.recording, bus_messages.PROCESS: snapshot.process,
    }  # fmt: skip
    station.say_all(lambda kind, name, note: say[kind](name, note))
    return snapshot, clock


def ids(snapshot: Snapshot) -> dict[str, str]:
    """The alarms that are found now, with their levels."""
    judged = alarms.judge(snapshot.document(), time.time_ns(), {})
    return {name: item.alarm.level for name, item in judged.items()}


P = station.PAYLOAD
ALONE: dict[str, Any] = {"stations": [], "offers": [], "twins": {}, "refused": []}


def test_a_station_that_flies_has_none(told):
    assert ids(told[0]) == {}


@pytest.mark.parametrize(
    ("battery", "found"),
    [
        ({"alarm": "low", "voltage": 3.5}, {f"battery/{P}": "warning"}),
        ({"alarm": "critical", "voltage": 3.3, "percentage": 0.04}, {f"battery/{P}": "alarm"}),
        ({"alarm": ""}, {}),
        ({"alarm": "of a newer payload"}, {}),
        ({"alarm": "low", "voltage": None, "percentage": None}, {f"battery/{P}": "warning"}),
    ],
)
def test_a_battery(told, battery, found):
    told[0].payload(P, station.payload(battery={"time_ns": 1, **battery}))
    assert ids(told[0]) == found


def test_a_critical_battery_tells_its_figures(told):
    battery = {"time_ns": 1, "alarm": "critical", "voltage": 3.3, "percentage": 0.04,
               "time_left_s": 130.0}  # fmt: skip
    told[0].payload(P, station.payload(battery=battery))
    (item,) = alarms.judge(told[0].document(), 0, {}).values()
    assert item.alarm.text == "battery critical: 3.30 V, 4 %, 2 min left"


def test_too_little_processor_is_said_for_itself_however_good_the_poses(told):
    text = "this computer is too slow: 14 of 60 frames skipped in 2 s; keyframes are rare"
    told[0].estimate(P, station.estimate(state="TRACKING", overload=text))
    (item,) = alarms.judge(told[0].document(), 0, {}).values()
    assert (item.alarm.id, item.alarm.level, item.alarm.text) == (f"overload/{P}", "warning", text)


@pytest.mark.parametrize(("after_s", "found"), [(1.5, False), (2.5, True)])
def test_lost_for_more_than_two_seconds(told, after_s, found):
    snapshot, clock = told
    snapshot.estimate(P, station.estimate(state="LOST", reason="nothing matched", position_m=None))
    clock.ns += int(after_s * S)
    for _ in range(2):  # told again, it is LOST since the first
        snapshot.estimate(P, station.estimate(state="LOST", reason="nothing matched"))
    snapshot.frame(P, station.frame())
    snapshot.payload(P, station.payload())
    assert (f"lost/{P}" in ids(snapshot)) == found


@pytest.mark.parametrize("state", ["LOST", "INITIALIZING"])
def test_ten_seconds_in_which_nothing_of_the_map_is_known_ask_for_the_building(told, state):
    snapshot, clock = told

    def texts() -> list[str]:
        return [one.alarm.text for one in alarms.judge(snapshot.document(), 0, {}).values()]

    for k in range(12):
        blind = station.estimate(state=state, reason="searching", position_m=None, map="hall")
        snapshot.estimate(P, blind)
        assert any("this building" in text for text in texts()) == (k > 10)
        clock.ns += S
        snapshot.payload(P, station.payload())
        snapshot.frame(P, station.frame())
        snapshot.process("-", station.process())
    assert "nothing of the map hall has been recognised for 12 s" in texts()[0]
    clock.ns += 60 * S  # nothing came, which is no sight of an unknown place
    snapshot.estimate(P, blind)
    snapshot.frame(P, station.frame())
    assert not any("this building" in text for text in texts())


@pytest.mark.parametrize(
    ("link", "standing", "text"),
    [
        ({"lost_share": 0.08}, False, "the radio loses 8 % of the packets, at -61 dBm: nearer"),
        ({"lost_share": 0.04}, False, ""),
        ({"lost_share": 0.04}, True, "the radio loses 4 % of the packets"),
        ({"lost_share": 0.02}, True, ""),
        ({"lost_share": float("nan")}, False, ""),
        ({"clock": {"uncertainty_ns": 80_000_000}}, False, "known to ±80 ms only: slow network?"),
        ({"clock": {"uncertainty_ns": 8_000_000}}, True, ""),
    ],
)
def test_a_bad_link_names_what_is_bad(told, link, standing, text):
    health = {"time_ns": 1, "wifi_signal_dBm": -61}
    told[0].payload(P, station.payload(health=health, **link))
    names = frozenset((f"radio/{P}", f"clock/{P}") if standing else ())
    texts = [alarm.text for alarm in alarms._found(told[0].document(), 0, names)]
    assert bool(texts) == bool(text) and all(text in one for one in texts)


@pytest.mark.parametrize(("after_s", "found"), [(1.5, False), (2.5, True)])
def test_no_frames_from_a_living_payload(told, after_s, found):
    snapshot, clock = told
    clock.ns += int(after_s * S)
    snapshot.payload(P, station.payload())
    assert ids(snapshot) == ({f"no-frames/{P}": "alarm"} if found else {})


def test_a_payload_that_flies_with_another_station_is_told_and_no_alarm(told):
    snapshot, clock = told
    clock.ns += 5 * S
    snapshot.payload(P, station.payload(station="spare"))
    assert ids(snapshot) == {f"elsewhere/{P}": "info"}
    snapshot.frame(P, station.frame())
    assert not ids(snapshot)


def test_what_another_station_sees_is_its_own_to_judge(told):
    snapshot, clock = told
    note = station.payload(station="attic", relayed=True, battery={"time_ns": 1, "alarm": "low"})
    snapshot.payload(P, note)
    clock.ns += 3 * S
    assert f"battery/{P}" not in ids(snapshot) and f"no-frames/{P}" not in ids(snapshot)


@pytest.mark.parametrize(
    ("other", "name", "text"),
    [
        ({}, None, ""),
        ({"age_s": 6.0}, "station/attic", "nothing is heard of station 'attic'"),
        ({"clock_s": -2.54}, "station-clock/attic", "'attic' is 2.5 s behind this one's"),
        ({"same_map": False, "payloads": ["b"]}, "station-map/attic", "another map, 'hall'"),
        ({"same_map": False}, None, ""),
    ],
)
def test_another_station_has_its_words(told, other, name, text):
    seen = {
        "name": "attic", "map": "hall", "same_map": True, "age_s": 0.2, "clock_s": 0.1,
        "payloads": [], **other,
    }  # fmt: skip
    fleet = {**ALONE, "stations": [seen]}
    found = alarms.judge({**told[0].document(), "fleet": fleet}, 0, {})
    assert set(found) == ({name} if name else set())
    assert all(text in item.alarm.text for item in found.values())


def test_a_map_that_grew_elsewhere_is_offered(told):
    offers = [{"station": "attic", "map": "hall-2", "more": 500}]
    found = alarms.judge({**told[0].document(), "fleet": {**ALONE, "offers": offers}}, 0, {})
    (item,) = found.values()
    assert (
        item.alarm.text
        == "station 'attic' has 'hall-2', this map with 500 landmarks more: Map… (M)"
    )


def test_twins_and_whoever_was_refused_are_named(told):
    fleet = {**ALONE, "twins": {P: "attic"}, "refused": ["ground.yard wants to join"]}
    found = alarms.judge({**told[0].document(), "fleet": fleet}, 0, {})
    assert [item.alarm.text for item in found.values()] == [
        "two payloads have this name: one flies here, one with station 'attic'",
        "not joined: ground.yard wants to join",
    ]


@pytest.mark.parametrize(
    ("apart_m", "standing", "found"),
    [(1.4, False, True), (1.6, False, False), (1.6, True, True), (1.9, True, False)],
)
def test_two_blimps_that_are_near_each_other(told, apart_m, standing, found):
    snapshot = told[0]
    snapshot.estimate(P, station.estimate(state="TRACKING", position_m=[1.0, 2.0, 3.0]))
    snapshot.payload("z", station.payload())
    snapshot.frame("z", station.frame())
    there = station.estimate(state="DEGRADED", position_m=[1.0, 2.0, 3.0 + apart_m])
    snapshot.estimate("z", there)
    name, now_ns = f"near/{P}/z", 100 * S
    alarm = alarms.Alarm(name, "alarm", P, "near", 0)
    before = {name: alarms.Standing(alarm, 0)} if standing else {}
    state = snapshot.document()
    state["station"]["apart_m"] = 1.5
    judged = alarms.judge(state, now_ns, before)
    assert name not in alarms.judge(snapshot.document(), now_ns, {})  # 0: none does
    assert (name in judged) == found
    if found:
        assert judged[name].alarm.text == f"{apart_m:.1f} m from z"
    elsewhere = station.estimate(state="TRACKING", position_m=[1.0, 2.0, 3.1], map="another")
    snapshot.estimate("z", elsewhere)
    state = snapshot.document()
    state["station"]["apart_m"] = 1.5
    assert name not in alarms.judge(state, now_ns, {})  # not in one map: no distance
    for payload_id, map_name in ((P, "hall"), ("z", "hall-2")):  # of which one grew of the other
        grown = {"map": map_name, "coordinates": "c", "position_m": [1.0, 2.0, 3.0]}
        snapshot.estimate(payload_id, station.estimate(state="TRACKING", **grown))
    state = snapshot.document()
    state["station"]["apart_m"] = 1.5
    assert name in alarms.judge(state, now_ns, {})


def test_telemetry_without_any_video_names_the_firewall(told):
    snapshot, clock = told
    for _ in range(6):  # P was seen, the other one never
        clock.ns += S
        for name in ("new", P):
            snapshot.payload(name, station.payload())
    found = alarms.judge(snapshot.document(), time.time_ns(), {})
    assert "firewall" in found["no-frames/new"].alarm.text
    assert "firewall" not in found[f"no-frames/{P}"].alarm.text


def test_a_payload_that_came_just_now_gets_a_moment_for_its_first_frame(told):
    snapshot, clock = told
    for name in ("new", P):  # P comes back after a while
        clock.ns += 60 * S
        snapshot.process("-", station.process())
        snapshot.payload(name, station.payload())
        assert not any(name in found for found in ids(snapshot))
        clock.ns += 5 * S // 2
        snapshot.payload(name, station.payload())
        assert f"no-frames/{name}" in ids(snapshot)


def test_frames_without_poses(told):
    snapshot, clock = told
    for _ in range(5):
        clock.ns += S
        snapshot.payload(P, station.payload())
        snapshot.frame(P, station.frame())
    assert ids(snapshot) == {f"no-poses/{P}": "alarm"}


@pytest.mark.parametrize("how", ["not alive", "silent", "ended"])
def test_a_payload_that_is_gone(told, how):
    snapshot, clock = told
    if how == "silent":
        clock.ns += 6 * S
        snapshot.process("-", station.process())
    else:
        if how == "ended":
            snapshot.event(P, station.event(source="payload", name="stopped"))
        snapshot.payload(P, station.payload(alive=False))
    assert ids(snapshot) == {f"gone/{P}": "info" if how == "ended" else "alarm"}


def test_a_payload_gone_for_long_is_no_alarm_any_more(told):
    snapshot, clock = told
    for after_s, found in ((300, {f"gone/{P}"}), (301, set())):
        clock.ns += after_s * S
        snapshot.payload(P, station.payload(alive=False))
        snapshot.process("-", station.process())
        assert set(ids(snapshot)) == found


def test_a_payload_that_was_never_here_is_not_gone(told):
    told[0].payload("blimp-2", station.payload(alive=False))
    assert ids(told[0]) == {}


def test_an_unknown_clock(told):
    snapshot, clock = told
    for after_s, found in ((0, {}), (11, {f"clock/{P}": "warning"})):
        clock.ns += after_s * S
        snapshot.payload(P, station.payload(clock=None))
        snapshot.frame(P, station.frame())
        snapshot.estimate(P, station.estimate())
        snapshot.process("-", station.process())
        assert ids(snapshot) == found
    snapshot.payload(P, station.payload())
    assert ids(snapshot) == {}


@pytest.mark.parametrize(
    ("recording", "found"),
    [
        ({"problem": "the disk is full"}, {"recording": "alarm"}),
        ({"active": True, "free_MB": 2000.0}, {"disk": "warning"}),  # it ends at 1024
        ({"active": True, "free_MB": 2100.0}, {}),
        ({"active": False, "free_MB": 2000.0}, {}),
        ({"active": True, "free_MB": None}, {}),
        ({"active": True, "resumed": "flight-000001.mcap was cut"}, {"resumed": "warning"}),
        ({"active": True, "resumed": "flight-000001.mcap was cut", "duration_s": 121.0}, {}),
    ],
)
def test_the_recording(told, recording, found):
    told[0].recording("-", station.recording(**recording))
    assert ids(told[0]) == found


def test_a_process_restarted_or_silent(told):
    snapshot, clock = told
    snapshot.process("-", station.process(pid=101))
    assert ids(snapshot) == {"restarted/intake": "warning"}
    clock.ns += 40 * S
    snapshot.payload(P, station.payload(alive=False))
    assert ids(snapshot)["silent/intake"] == "alarm"
    assert "restarted/intake" not in ids(snapshot)


def test_the_localizer_of_a_payload_that_is_gone_may_be_silent(told):
    snapshot, clock = told
    snapshot.process("-", station.process(f"localizer/{P}", 7))
    clock.ns += 6 * S
    snapshot.process("-", station.process())
    assert set(ids(snapshot)) == {f"gone/{P}"}
    snapshot.payload(P, station.payload())
    snapshot.frame(P, station.frame())
    assert f"silent/localizer/{P}" in ids(snapshot)


def test_a_map_of_other_features(told):
    snapshot, _ = told
    refused = station.event(source="localizer", level="alarm", name="map-refused", text="other")
    snapshot.event(P, refused)
    assert ids(snapshot) == {f"map/{P}": "alarm"}
    state, later_ns = snapshot.document(), time.time_ns() + 60 * S
    assert alarms.judge(state, later_ns, {}) == {}
    # It has none at all, and says so with its frames for as long as that is so.
    snapshot.estimate(P, station.estimate(state="INITIALIZING", reason="no map: other features"))
    assert alarms.judge(snapshot.document(), later_ns, {})[f"map/{P}"].alarm.level == "alarm"


def test_a_payload_that_is_not_on_the_list(told):
    snapshot, _ = told
    for k, level in enumerate(("warning", "info")):
        text = "payload.blimp-7 reaches this station" if level == "warning" else "is over"
        event = station.event(name="unlisted", level=level, text=text, time_ns=time.time_ns() + k)
        snapshot.event("-", event)
        assert ids(snapshot) == ({"unlisted": "warning"} if level == "warning" else {})
    state = snapshot.document()
    state["events"] = [event for event in state["events"] if event["level"] == "warning"]
    later_ns = time.time_ns() + 60 * S
    assert set(alarms.judge(state, later_ns, {})) == {"unlisted"}
    state["processes"] = [{"name": "intake", "age_s": 0.1, "restarted_s": 40.0}]  # it says it anew
    assert alarms.judge(state, later_ns, {}) == {}


def test_what_flickers_stands_and_keeps_its_beginning(told):
    snapshot, _ = told
    good = snapshot.document()
    snapshot.recording("-", station.recording(problem="slow disk"))
    bad = snapshot.document()
    now_ns, standing = 50 * S, {}
    for k in range(40):  # there and gone by turns, four times a second
        standing = alarms.judge(bad if k % 2 == 0 else good, now_ns + k * S // 4, standing)
        assert standing["recording"].alarm.since_ns == now_ns
    gone_ns = now_ns + 39 * S // 4
    assert "recording" in alarms.judge(good, gone_ns + 2 * S, standing)
    assert alarms.judge(good, gone_ns + 4 * S, standing) == {}


def test_a_level_rises_at_once_and_falls_late(told):
    snapshot, _ = told
    state = {}
    for alarm in ("low", "critical"):
        snapshot.payload(P, station.payload(battery={"time_ns": 1, "alarm": alarm}))
        state[alarm] = snapshot.document()
    name = f"battery/{P}"
    standing = alarms.judge(state["low"], 10 * S, {})
    standing = alarms.judge(state["critical"], 11 * S, standing)
    assert standing[name].alarm.level == "alarm"
    standing = alarms.judge(state["low"], 12 * S, standing)
    assert standing[name].alarm.level == "alarm"
    standing = alarms.judge(state["low"], 15 * S, standing)
    assert (standing[name].alarm.level, standing[name].alarm.since_ns) == ("warning", 10 * S)


@pytest.mark.parametrize(
    ("held", "text"),
    [
        (["undervoltage", "throttled", "throttled-was"], "undervoltage, throttled: is its cell"),
        (["soft-temperature-limit"], "held back: soft-temperature-limit"),
        (["undervoltage-was"], ""),
        (None, ""),
    ],
)
def test_a_board_that_is_held_back_says_by_what(told, held, text):
    told[0].payload(P, station.payload(health={"time_ns": 1, "throttled": held}))
    texts = [alarm.text for alarm in alarms._found(told[0].document(), 0, frozenset())]
    assert len(texts) == bool(text) and all(text in one for one in texts)


def test_a_limit_for_the_end_lies_apart_from_the_one_for_the_beginning(told):
    snapshot, _ = told

    def at(celsius: float, standing: dict) -> bool:
        health = {"time_ns": 1, "temperature_C": celsius}
        snapshot.payload(P, station.payload(health=health))
        return f"hot/{P}" in alarms.judge(snapshot.document(), 100 * S, standing)

    assert not at(79.0, {})
    assert at(81.0, {})
    hot = alarms.judge(snapshot.document(), 0, {})
    assert at(77.0, hot)
    assert not at(75.0, hot)


def test_a_clock_set_back_makes_no_alarm_eternal(told):
    snapshot, _ = told
    good = snapshot.document()
    snapshot.recording("-", station.recording(problem="slow disk"))
    standing = alarms.judge(snapshot.document(), 5000 * S, {})
    standing = alarms.judge(good, 100 * S, standing)
    assert alarms.judge(good, 104 * S, standing) == {}


def test_the_gravest_come_first(told):
    snapshot, _ = told
    snapshot.payload(P, station.payload(battery={"time_ns": 1, "alarm": "low"}))
    snapshot.recording("-", station.recording(problem="slow disk"))
    documents = alarms.documents(alarms.judge(snapshot.document(), 0, {}))
    assert [item["level"] for item in documents] == ["alarm", "warning"]
