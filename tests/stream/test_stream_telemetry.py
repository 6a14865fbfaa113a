"""The listener keeps what payloads say, refuses what they should not say, and knows who lives."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import islice
from typing import Any

import pytest
from waiting import eventually

from ground_station.stream.telemetry import (
    ClockFollower,
    FrameCounts,
    PayloadState,
    TelemetryListener,
)
from pi_firmware.settings import TelemetrySettings
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire import keys, messages
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.telemetry import open_session, session_config

LIMIT_S = 20.0
Connect = Callable[..., Telemetry]


def gate(sequence: int, **fields: Any) -> messages.Gate:
    values = {"captured": sequence + 1, "gated": 0, "heartbeats": 0, "sent": sequence, "ssrc": 9}
    return messages.Gate(
        time_ns=sequence, capture_ns=sequence, sequence=sequence, passed=True, heartbeat=False,
        entropy_bits=7.0, sharpness=1.0, **(values | fields),
    )  # fmt: skip


@pytest.fixture
def listener() -> Iterator[TelemetryListener]:
    with TelemetryListener(["tcp/127.0.0.1:0"]) as opened:
        yield opened


@pytest.fixture
def payload() -> Iterator[Connect]:
    """Connects payloads, and closes them whatever a test ends with."""
    with ExitStack() as opened:

        def connect(listener: TelemetryListener, payload_id: str = "blimp-1") -> Telemetry:
            settings = TelemetrySettings(connect=list(listener.endpoints))
            telemetry = Telemetry(payload_id, settings)
            opened.callback(telemetry.close)
            return telemetry

        yield connect


def test_a_payload_lives_from_its_start_to_its_end(
    listener: TelemetryListener, payload: Connect
) -> None:
    telemetry = payload(listener)
    assert listener.wait("blimp-1", lambda state: state.alive, LIMIT_S)
    telemetry.close()
    assert listener.wait("blimp-1", lambda state: not state.alive, LIMIT_S)


def test_payloads_are_told_apart(listener: TelemetryListener, payload: Connect) -> None:
    one, two = payload(listener, "one"), payload(listener, "two")
    one.publish(messages.Battery(time_ns=1, voltage=3.5))
    two.publish(messages.Battery(time_ns=2, voltage=4.1))
    for payload_id, voltage in (("one", 3.5), ("two", 4.1)):
        state = listener.wait(payload_id, lambda s: s.battery is not None, LIMIT_S)
        assert state is not None and state.battery is not None
        assert state.battery.voltage == voltage
    assert listener.payloads() == ["one", "two"]


def test_a_new_start_counts_from_zero(listener: TelemetryListener, payload: Connect) -> None:
    telemetry = payload(listener)
    health = messages.Health(time_ns=4, uptime_s=2.5, wifi_signal_dBm=-61.0, late=["camera"])
    telemetry.publish(health)
    telemetry.publish(gate(5))
    state = listener.wait("blimp-1", lambda s: s.gate is not None, LIMIT_S)
    assert state is not None and state.health == health and [*state.decisions] == [5]
    telemetry.publish(messages.Event(time_ns=9, name=messages.EVENT_STARTED, text="again"))
    assert listener.wait_for_event("blimp-1", messages.EVENT_STARTED, LIMIT_S)
    state = listener.state("blimp-1")
    assert state is not None and state.decisions == {} and state.frames is state.health is None


def test_discarded_frames_are_counted_and_none_of_an_older_payload() -> None:
    state = PayloadState("blimp-1", gate=gate(5, captured=10, gated=2, sent=5, discarded=3))
    assert state.frames == FrameCounts(10, 2, 0, 5, discarded=3)
    values = {"captured": 11, "gated": 2, "heartbeats": 1, "sent": 5, "discarded": 4}
    state.events = [messages.Event(time_ns=6, name="stopped", text="", values=values)]
    assert state.frames == FrameCounts(11, 2, 1, 5, discarded=4)
    del values["discarded"]
    assert state.frames == FrameCounts(11, 2, 1, 5, discarded=0)


def test_decisions_are_kept_by_frame_and_the_newest_counts(
    listener: TelemetryListener, payload: Connect
) -> None:
    telemetry = payload(listener)
    for sequence in range(50):
        telemetry.publish(gate(sequence, gated=sequence // 10))
    state = listener.wait("blimp-1", lambda s: len(s.decisions) == 50, LIMIT_S)
    assert state is not None
    assert state.frames == FrameCounts(captured=50, gated=4, heartbeats=0, sent=49)
    assert state.ssrc == 9


def test_the_last_event_arrives_although_the_payload_ends_at_once(
    listener: TelemetryListener, payload: Connect
) -> None:
    for number in range(8):
        telemetry = payload(listener, f"p{number}")
        telemetry.publish(messages.Event(time_ns=1, name=messages.EVENT_END_OF_STREAM, text=""))
        telemetry.close()
    for number in range(8):
        assert listener.wait_for_event(f"p{number}", messages.EVENT_END_OF_STREAM, LIMIT_S), number


def test_hostile_messages_are_refused_and_counted(listener: TelemetryListener) -> None:
    session = open_session(connect=listener.endpoints)
    kinds = (keys.BATTERY, keys.GATE, keys.EVENT)
    hostile = [b"", b"\xff" * 99, b"{}", b"[[[[", b'{"schema":"blimp.gate/1.0"}', b"null"]
    publishers = [session.zenoh.declare_publisher(keys.key("bad", kind)) for kind in kinds]
    for publisher in publishers:
        for body in hostile:
            publisher.put(body)
    expected = len(kinds) * len(hostile)
    state = listener.wait("bad", lambda s: s.refused == expected, LIMIT_S)
    assert state is not None and state.battery is None and state.events == []
    session.zenoh.put("blimp/Not-An-Id/battery", b"{}")
    publishers[0].put(messages.encode(messages.Battery(time_ns=1, voltage=3.3)))
    assert listener.wait("bad", lambda s: s.battery is not None, LIMIT_S)
    assert listener.payloads() == ["bad"]
    session.close()


def test_a_message_of_megabytes_is_dropped_and_its_payload_heard_on(
    listener: TelemetryListener,
) -> None:
    session = open_session(connect=listener.endpoints)
    publisher = session.zenoh.declare_publisher(keys.key("blimp-1", keys.EVENT))
    event = messages.Event(time_ns=1, name="large", text="x" * 5_000_000)
    publisher.put(messages.encode(event))
    publisher.put(messages.encode(messages.Event(time_ns=2, name="small", text="")))
    assert listener.wait_for_event("blimp-1", "small", LIMIT_S)
    state = listener.state("blimp-1")
    assert state is not None and [event.name for event in state.events] == ["small"]
    session.close()


def test_who_is_gone_makes_room_for_who_comes(listener: TelemetryListener) -> None:
    session = listener.session.zenoh
    for number in range(130):  # names that were never alive
        body = messages.encode(messages.Autopilot(time_ns=number, connected=True))
        session.put(keys.key(f"blimp-{number}", keys.AUTOPILOT), body)
    assert listener.wait("blimp-129", lambda s: s.autopilot is not None, LIMIT_S)
    assert len(listener.payloads()) == 64


def test_clocks_of_those_that_are_gone_are_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ground_station.stream.telemetry._PERIOD_S", 0.001)
    monkeypatch.setattr("ground_station.stream.telemetry._KEPT_CLOCKS", 4)
    names = iter(f"blimp-{number}" for number in range(20))
    with TelemetryListener(["tcp/127.0.0.1:0"]) as listener:
        session = listener.session.zenoh
        alone = ClockFollower(session, lambda: [*islice(names, 1)] or ["last"], time.time_ns)
        eventually(lambda: "last" in alone._served and len(alone._served) <= 4)
        alone.close()


def test_messages_are_handed_on_as_they_come(payload: Connect) -> None:
    heard: list[tuple[str, str, messages.Message]] = []
    with TelemetryListener(
        ["tcp/127.0.0.1:0"],
        on_message=lambda *said: heard.append(said),
    ) as listener:
        telemetry = payload(listener)
        event = messages.Event(time_ns=1, name="hello", text="")
        telemetry.publish(event)
        assert listener.wait_for_event("blimp-1", "hello", LIMIT_S)
    assert heard == [("blimp-1", "event", event)]


def test_an_endpoint_in_use_is_one_line(listener: TelemetryListener) -> None:
    with pytest.raises(TelemetryError) as caught:
        TelemetryListener(listener.endpoints)
    assert listener.endpoints[0] in str(caught.value) and "in use" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_two_listeners_on_free_ports_do_not_meet(
    listener: TelemetryListener, payload: Connect
) -> None:
    with TelemetryListener(["tcp/127.0.0.1:0"]) as other:
        assert other.endpoints != listener.endpoints
        payload(listener)
        assert listener.wait("blimp-1", lambda state: state.alive, LIMIT_S)
        assert other.payloads() == []


def test_a_payload_that_starts_first_is_found_when_the_listener_comes() -> None:
    with TelemetryListener(["tcp/127.0.0.1:0"]) as before:
        endpoints = before.endpoints
    telemetry = Telemetry("early", TelemetrySettings(connect=list(endpoints)))
    with TelemetryListener(endpoints) as listener:
        assert listener.wait("early", lambda state: state.alive, LIMIT_S)
        telemetry.close()


def test_a_session_uses_neither_shared_memory_nor_multicast() -> None:
    settings = session_config(["tcp/127.0.0.1:7447"], [])
    for name in ("transport/shared_memory", "scouting/multicast", "scouting/gossip"):
        assert json.loads(settings.get_json(f"{name}/enabled")) is False


END = """
import atexit, threading, time
atexit.register(lambda: print([t.name for t in threading.enumerate() if t.daemon]))  # runs last
from pi_firmware.wire.telemetry import callback_threads, open_session
session = open_session()
subscriber = session.zenoh.declare_subscriber("blimp/a/b", print)
[thread] = callback_threads()
session.close()
late = threading.Thread(target=time.sleep, args=(0.5,), name=thread.name, daemon=True)
late.start()
"""


def test_a_program_ends_after_its_callbacks() -> None:
    """Otherwise one end in twenty is an abort: Zenoh's threads meet an interpreter that is gone."""
    run = subprocess.run([sys.executable, "-c", END], capture_output=True, text=True, timeout=60)
    assert run.returncode == 0 and run.stdout == "[]\n", run.stderr
