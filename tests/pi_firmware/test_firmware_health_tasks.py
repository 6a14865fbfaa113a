"""The table of tasks: who is late, and threads that outlive what they run."""

import threading
import time

import pytest
from waiting import eventually

from pi_firmware.health.tasks import PeriodicThread, Table, Task

LIMIT_S = 20.0
TASKS = (Task("health", 1.0, 5.0), Task("battery", 1.0, 10.0), Task("wifi", 1.0, 30.0))


class Hand:
    """A clock moved by hand."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_late_is_who_began_and_was_not_heard_within_its_watchdog() -> None:
    clock = Hand()
    table = Table(TASKS, clock)
    clock.now_s += 1000
    assert table.late() == [] and table.ages() == {}, "nobody has begun"
    table.beat("wifi")
    table.beat("health")
    clock.now_s += 5.0
    assert table.late() == []
    clock.now_s += 0.1
    assert table.late() == ["health"]
    clock.now_s += 25
    assert table.late() == ["health", "wifi"], "in the table's order"
    assert table.ages() == pytest.approx({"health": 30.1, "wifi": 30.1})
    table.beat("health")
    assert table.late() == ["wifi"]
    table.end("wifi")
    table.end("wifi")
    assert table.late() == [] and list(table.ages()) == ["health"]
    clock.now_s += 6
    assert table.late() == ["health"]


def test_an_unknown_name_is_refused() -> None:
    table = Table(TASKS)
    for use in (table.beat, table.end):
        with pytest.raises(KeyError, match="helth"):
            use("helth")


def test_it_is_safe_from_many_threads() -> None:
    table = Table(TASKS)
    faults: list[BaseException] = []

    def work(name: str) -> None:
        try:
            for _ in range(500):
                table.beat(name)
                table.late()
                table.end(name)
                table.ages()
        except BaseException as error:
            faults.append(error)

    threads = [threading.Thread(target=work, args=(task.name,)) for task in TASKS for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LIMIT_S)
    assert faults == [] and table.ages() == {}


def test_a_thread_runs_its_task_again_and_again_and_beats() -> None:
    calls: list[str] = []
    table = Table([Task("quick", 0.01, 5.0)])
    runner = PeriodicThread(
        table, "quick", lambda: calls.append(threading.current_thread().name), print
    )
    assert table.ages() == {}
    runner.start()
    runner.start()
    eventually(lambda: len(calls) >= 5)
    assert set(calls) == {"quick"} and list(table.ages()) == ["quick"]
    assert runner.stop()
    after = len(calls)
    time.sleep(0.05)
    assert len(calls) == after and table.ages() == {}, "ended in order: nobody misses it"


def test_a_call_that_raises_is_told_once_goes_on_and_does_not_beat() -> None:
    clock = Hand()
    table = Table([Task("poor", 0.01, 5.0)], clock)
    calls: list[int] = []
    told: list[str] = []

    def poor() -> None:
        calls.append(1)
        if len(calls) < 20:
            raise OSError("no such\ngauge")

    def report(line: str) -> None:
        told.append(line)
        raise RuntimeError("and telling of it fails, too")

    runner = PeriodicThread(table, "poor", poor, report)
    runner.start()
    eventually(lambda: len(calls) >= 10)
    if len(calls) < 20:
        assert told == ["poor: OSError: no such gauge"]
    eventually(lambda: len(calls) >= 21)
    assert told == ["poor: OSError: no such gauge"]
    assert runner.stop()


def test_a_task_that_always_fails_becomes_late() -> None:
    clock = Hand()
    table = Table([Task("poor", 0.01, 5.0)], clock)
    calls: list[int] = []

    def poor() -> None:
        calls.append(1)
        raise ValueError(len(calls) % 2)

    told: list[str] = []
    runner = PeriodicThread(table, "poor", poor, told.append)
    runner.start()
    clock.now_s += 6.0
    eventually(lambda: len(calls) >= 3)
    assert table.late() == ["poor"]
    assert {"poor: ValueError: 0", "poor: ValueError: 1"} == set(told), "each new reason is told"
    assert runner.stop()


def test_a_hung_task_is_late_and_stopping_it_does_not_wait_for_ever() -> None:
    clock = Hand()
    table = Table([Task("hung", 0.01, 5.0)], clock)
    release = threading.Event()
    runner = PeriodicThread(table, "hung", lambda: release.wait(LIMIT_S), print)
    runner.start()
    clock.now_s += 6.0
    assert table.late() == ["hung"]
    assert not runner.stop(limit_s=0.05)
    assert table.late() == ["hung"], "it has not ended"
    release.set()
    assert runner.stop(LIMIT_S)
    assert table.late() == []


def test_missed_periods_are_not_made_up_for() -> None:
    table = Table([Task("slow", 0.2, 5.0)])
    began: list[float] = []

    def slow() -> None:
        began.append(time.monotonic())
        if len(began) == 1:
            time.sleep(0.7)  # three periods and a half

    runner = PeriodicThread(table, "slow", slow, print)
    runner.start()
    eventually(lambda: len(began) >= 4)
    assert runner.stop()
    # After the second call, at once, the third comes a whole period later.
    assert began[2] - began[1] > 0.15 and began[3] - began[2] > 0.15


def test_a_task_may_stop_its_own_thread() -> None:
    table = Table([Task("last", 0.01, 5.0)])
    runners: list[PeriodicThread] = []
    calls: list[bool] = []
    runners.append(PeriodicThread(table, "last", lambda: calls.append(runners[0].stop()), print))
    runners[0].start()
    eventually(lambda: len(calls) == 1)
    assert runners[0].stop(LIMIT_S)
    assert calls == [False], "it had not ended yet as it asked"
