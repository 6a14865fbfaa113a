"""The process itself, on a real bus: starts, beats, serves, and ends."""

from __future__ import annotations

import contextlib
import resource
import signal
import socket
import time
from pathlib import Path

import httpx
import pytest
import web_station as station

from ground_station.service import bus_messages
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import EventMessage, ProcessMessage
from ground_station.service.settings import write_run

P = station.PAYLOAD


def test_it_serves_what_the_bus_says_beats_and_ends(bus_folder):
    write_run(bus_folder, station.run_of(bus_folder))
    with Bus(bus_folder, "test") as bus, station.web_process(bus_folder) as (process, port):
        beats: list[ProcessMessage] = []
        bus.subscribe(bus_messages.PROCESS, ProcessMessage, lambda _, note: beats.append(note))
        events: list[EventMessage] = []
        bus.subscribe(bus_messages.EVENT, EventMessage, lambda _, note: events.append(note))
        bus.serve("intake", lambda request: {"values": {"asked": len(request)}})

        def flies():
            station.say_all(bus.publish)
            state = httpx.get(f"http://127.0.0.1:{port}/api/state").json()
            return state["payloads"].get(P, {}).get("estimate")

        assert station.eventually(flies)["state"] == "TRACKING"
        station.eventually(lambda: any(note.name == "web" for note in beats))
        assert next(note.pid for note in beats if note.name == "web") == process.pid
        answer = httpx.post(f"http://127.0.0.1:{port}/api/recording", json={"active": True})
        assert answer.json() == {"done": True, "reason": "", "values": {"asked": 1}}
        bus.publish(
            bus_messages.RECORDING,
            bus_messages.STATION,
            station.recording(problem="the disk is full"),
        )
        station.eventually(lambda: any(note.name == "alarm-begins" for note in events))
        begin_s = time.monotonic()
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 0
        # Asked for are 3 s; a shared machine gets more.
        assert time.monotonic() - begin_s < 10.0
        assert process.stderr is not None and process.stderr.read() == ""


@pytest.mark.parametrize("relieved", [True, False])
def test_without_descriptors_it_lives_says_so_once_and_serves_again_or_ends(bus_folder, relieved):
    """It ended with a panic, after a traceback for each place in the queue, again each second."""
    write_run(bus_folder, station.run_of(bus_folder))
    with (
        Bus(bus_folder, "test") as bus,
        station.web_process(bus_folder) as (process, port),
        contextlib.ExitStack() as held,
    ):
        beats = bus.newest(bus_messages.PROCESS, ProcessMessage)
        url = f"http://127.0.0.1:{port}/healthz"
        assert httpx.get(url).is_success
        _, hard = resource.prlimit(process.pid, resource.RLIMIT_NOFILE)
        few = len(list(Path(f"/proc/{process.pid}/fd").iterdir())) + 2
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (few, hard))
        for _ in range(40):
            held.enter_context(socket.create_connection(("127.0.0.1", port)))
        began_s = beats.take(30).uptime_s
        while beats.take(30).uptime_s < began_s + 3:
            pass
        if relieved:
            held.close()
            resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (hard, hard))
            assert httpx.get(url, timeout=30.0).is_success
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 0
        said = "web: no connection is taken: Too many open files\n"
        assert process.stderr is not None and process.stderr.read() == said
