"""The table of tasks: who is late, and threads that outlive what they run."""

import subprocess
import sys
import threading
import time
from types import SimpleNamespace
from typing import Any, cast

import pytest
from waiting import eventually

from pi_firmware import supervision
from pi_firmware.settings import Settings
from pi_firmware.supervision import PeriodicThread, Table

PROGRAM = """
import gc, sys
from pi_firmware import __main__, payload

class Told(payload.Payload):
    def run(self, stop):
        print("frozen", gc.get_freeze_count(), "of", len(gc.get_objects()))

payload.Payload = Told
sys.argv = ["pi_firmware", "--set", "camera.uri=test:", "--set", "telemetry.enabled=false"]
sys.exit(__main__.main())
"""


class Hand:
    """A clock moved by hand."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_late_is_who_began_and_was_not_heard_within_its_watchdog() -> None:
    clock = Hand()
    table = Table({"health": 5.0, "gone": 9.0, "wifi": 30.0}, clock)
    clock.now_s += 1000
    assert table.late() == [], "nobody has begun"
    table.beat("wifi")
    table.beat("health")
    clock.now_s += 5.0
    assert table.late() == []
    clock.now_s += 0.1
    assert table.late() == ["health"]
    clock.now_s += 25
    assert table.late() == ["health", "wifi"], "in the table's order"
    table.beat("health")
    assert table.late() == ["wifi"]


def test_a_call_that_raises_is_told_once_goes_on_and_does_not_beat() -> None:
    clock = Hand()
    table = Table({"poor": 5.0}, clock)
    calls: list[str] = []
    told: list[str] = []

    def poor() -> None:
        calls.append(threading.current_thread().name)
        if len(calls) < 20:
            clock.now_s += 1.0
            raise OSError("no such\ngauge")
        assert table.late() == ["poor"] or len(calls) > 20

    def report(line: str) -> None:
        told.append(line)
        raise RuntimeError("and telling of it fails, too")

    runner = PeriodicThread(table, "poor", 0.01, poor, report)
    runner.start()
    eventually(lambda: len(calls) >= 22)
    assert told == ["poor: OSError: no such gauge"] and set(calls) == {"poor"}
    assert table.late() == []
    runner.stop()
    after = len(calls)
    time.sleep(0.05)
    assert len(calls) == after


def test_each_new_reason_is_told() -> None:
    calls: list[int] = []
    told: list[str] = []

    def poor() -> None:
        calls.append(1)
        raise ValueError(len(calls) % 2)

    runner = PeriodicThread(Table({"poor": 5.0}), "poor", 0.01, poor, told.append)
    runner.start()
    eventually(lambda: len(calls) >= 3)
    runner.stop()
    assert {"poor: ValueError: 0", "poor: ValueError: 1"} == set(told)


def test_stopping_a_hung_task_does_not_wait_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervision, "_JOIN_LIMIT_S", 0.05)
    release = threading.Event()
    table = Table({"hung": 5.0})
    runner = PeriodicThread(table, "hung", 0.01, lambda: release.wait(20.0), print)
    runner.start()
    began_s = time.monotonic()
    runner.stop()
    assert time.monotonic() - began_s < 10.0
    release.set()


def test_missed_periods_are_not_made_up_for() -> None:
    began: list[float] = []

    def slow() -> None:
        began.append(time.monotonic())
        if len(began) == 1:
            time.sleep(0.7)  # three periods and a half

    runner = PeriodicThread(Table({"slow": 5.0}), "slow", 0.2, slow, print)
    runner.start()
    eventually(lambda: len(began) >= 4)
    runner.stop()
    # After the second call, at once, the third comes a whole period later.
    assert began[2] - began[1] > 0.15 and began[3] - began[2] > 0.15


def test_a_flight_empties_cpythons_lists_of_freed_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Named in the table is not yet done: only a thread that runs it empties the lists."""
    collected = threading.Event()
    monkeypatch.setattr(supervision.gc, "collect", collected.set)
    watching = supervision.Supervision(Settings(), lambda name, text: None)
    monkeypatch.setattr(watching, "health", lambda *_: None)
    silent = SimpleNamespace(publish=lambda _: None, ask_time=lambda: None, refusals=list)
    nothing: Any = SimpleNamespace(seen=None, armed=False)
    try:
        watching.start(nothing, nothing, nothing, cast(Any, silent), nothing)
        assert collected.wait(20)
    finally:
        watching.stop()
    (thread,) = (each for each in watching._threads if each._name == supervision.MEMORY)
    assert thread._period_s <= 60


def test_the_program_freezes_what_it_loaded_before_it_flies() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60, check=False
    )
    assert (ran.returncode, ran.stderr) == (0, "")
    frozen = int(ran.stdout.partition("frozen ")[2].split()[0])
    rest = int(ran.stdout.partition(" of ")[2].split()[0])
    assert frozen > 10_000 and rest < frozen / 5
