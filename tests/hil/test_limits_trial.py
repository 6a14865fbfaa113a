"""One trial: what is due and counted, what holds a process back, and a flight that is flown."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import limits_stand
import limits_trial
import pytest
from limits_axes import Conditions
from limits_stand import Flight, TrialError, measure
from limits_throttle import Group, method, stopped_in_turn, throttled, tree, usable_group
from limits_trial import SEAM_S, SETTLE_S, Outcome, Round, Trial, due, judge, round_of, since_found

from ground_station.errors import InputError
from ground_station.localization.estimate import State
from ground_station.replay.live import LiveFrame
from ground_station.replay.rig import FirmwareError
from pi_firmware.wire.errors import StreamError

ATRIUM = Path(__file__).parents[2] / "maps" / "atrium"
S = 10**9
ROUND = Round(5 * S, 32 * S)


def frames(
    from_ns: int, seconds: float, rate_hz: float, tracking: float = 1.0
) -> list[tuple[int, bool, float | None]]:
    """Estimates of a stretch, of which this share is TRACKING, evenly."""
    count = round(seconds * rate_hz)
    return [
        (from_ns + round(k * S / rate_hz), int((k + 1) * tracking) > int(k * tracking), 30.0 + k)
        for k in range(count)
    ]


def trial(rate_hz: float = 30.0, duration_s: float = 20.0) -> Trial:
    return Trial("flight.mcap", "map", rate_hz, duration_s, payloads=2)


def test_frames_of_a_flight_that_keeps_its_pace_are_those_captured() -> None:
    assert due(960, [k * S // 30 for k in range(960)], 30.0) == 960
    assert due(960, [k * S // 30 for k in range(100, 700)], 30.0) == 960
    assert due(960, [], 30.0) == 960


def test_a_flight_that_a_slow_firmware_stretches_owes_what_a_camera_would_have_given() -> None:
    """960 frames in twice their time: a camera would not have waited."""
    assert due(960, [k * S // 15 for k in range(960)], 30.0) == 1919


def test_a_flight_counts_from_when_its_place_was_found() -> None:
    states = ["INITIALIZING", "DEGRADED", "TRACKING", "LOST", "TRACKING"]

    def flown(step_s: float) -> list[LiveFrame]:
        return [
            cast(LiveFrame, SimpleNamespace(
                clock_ns=S + round(n * step_s * S), estimate=SimpleNamespace(state=State(state))))
            for n, state in enumerate(states)
        ]  # fmt: skip

    flight = flown(0.1)
    assert since_found(flight) == flight[2:]
    assert since_found(flight[:2]) == []
    slow = flown(SETTLE_S)
    assert since_found(slow) == slow[1:]  # a search so long is a limit, too


def test_the_share_of_nothing_is_nothing() -> None:
    assert Outcome(0, 0).share == 0.0 and Outcome(10, 9).share == 0.9


def test_of_several_payloads_the_worst_one_counts() -> None:
    start = ROUND.first_ns + 5 * S
    heard = {"a": frames(start, 30, 30), "b": frames(start, 30, 30, 0.8)}
    outcome = judge(heard, {"a": start, "b": start}, ROUND, trial())
    assert outcome.worst == "b" and outcome.due == 600
    assert outcome.share == pytest.approx(0.8, abs=0.01)
    assert outcome.latency_p50_ms == pytest.approx(329.5, abs=1.0)


def test_a_payload_that_falls_silent_owes_its_frames() -> None:
    start = ROUND.first_ns + 5 * S
    heard = {"a": frames(start, 30, 30), "b": frames(start, 5, 30)}
    outcome = judge(heard, {"a": start, "b": start, "c": start}, ROUND, trial())
    assert (outcome.worst, outcome.share) == ("c", 0.0)
    outcome = judge(heard, {"a": start, "b": start}, ROUND, trial())
    assert outcome.share == pytest.approx(0.25, abs=0.01)


def test_the_seam_of_a_loop_counts_neither_for_nor_against() -> None:
    start = ROUND.first_ns + 20 * S  # the seam lies 12 s on
    heard = frames(start, 30, 30)
    lost = [(t, ROUND.counts(t) and tracking, ms) for t, tracking, ms in heard]
    outcome = judge({"a": lost}, {"a": start}, ROUND, trial())
    assert outcome.share == 1.0 and outcome.due == 600 - 30 * SEAM_S


def test_a_round_is_as_long_as_the_firmware_flies_it() -> None:
    assert round_of(ATRIUM / "flight.mcap").length_ns == pytest.approx(32 * S, abs=S / 25)


@pytest.fixture
def busy() -> Iterator[subprocess.Popen[bytes]]:
    """A process that would take a whole core."""
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as one:
        yield one
        one.kill()


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def used(pid: int, seconds: float = 0.8) -> float:
    """Cores that a process uses now."""
    began_s, before_s = time.monotonic(), cpu_s(pid)
    time.sleep(seconds)
    return (cpu_s(pid) - before_s) / (time.monotonic() - began_s)


def state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def test_a_process_is_held_back_as_the_machine_can(busy: subprocess.Popen[bytes]) -> None:
    with throttled(busy.pid, 0.2) as by:
        assert by == method()
        assert used(busy.pid) < 0.7  # a busy machine may give less, and stops it later
    assert busy.poll() is None


def test_a_process_is_held_back_by_stopping_it_in_turn(busy: subprocess.Popen[bytes]) -> None:
    with stopped_in_turn(busy.pid, 0.2):
        assert len(os.sched_getaffinity(busy.pid)) == 1
        share = used(busy.pid)
        began_s, before_s = time.monotonic(), cpu_s(busy.pid)
        while cpu_s(busy.pid) == before_s:  # it does go on
            assert time.monotonic() < began_s + 30.0
            time.sleep(0.02)
    assert share < 0.7  # turns are longer where this program waits for a core
    assert state(busy.pid) in "RS"


FAMILY = """
import subprocess, sys
busy = [sys.executable, "-c", "while True: pass"]
born = [subprocess.Popen(busy) for _ in range(2)]
print(*(one.pid for one in born), flush=True)
sys.stdin.readline()
born.append(subprocess.Popen(busy))
print(born[-1].pid, flush=True)
sys.stdin.readline()
for one in born:
    one.kill()
    one.wait()
"""


def held(*pids: int, limit_s: float = 30.0) -> bool:
    """Whether any of them is seen stopped, or in a group with less of the processor."""
    until_s = time.monotonic() + limit_s
    while time.monotonic() < until_s:
        for pid in pids:
            if state(pid) == "T" or "/blimp-limits-" in Path(f"/proc/{pid}/cgroup").read_text():
                return True
        time.sleep(0.001)
    return False


@pytest.mark.parametrize("hold", [throttled, stopped_in_turn])
def test_what_a_process_has_started_and_will_start_is_held_back_with_it(
    hold: Callable[[int, float, tuple[int, ...]], AbstractContextManager[object]],
) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", FAMILY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as family:
        assert family.stdin is not None and family.stdout is not None
        child, other = map(int, family.stdout.readline().split())
        with hold(family.pid, 0.1, (other,)):
            print(file=family.stdin, flush=True)
            later = int(family.stdout.readline())
            assert tree(family.pid, (other,)) == {family.pid, child, later}
            assert all(held(pid) for pid in (family.pid, child, later))
            assert not held(other, limit_s=0.2)
        assert not held(child, later, limit_s=0.2)
        print(file=family.stdin, flush=True)


def test_the_throttle_survives_the_end_of_whom_it_holds(busy: subprocess.Popen[bytes]) -> None:
    for hold in (throttled, stopped_in_turn, throttled):
        with hold(busy.pid, 0.5):
            busy.kill()
            busy.wait()


def test_no_group_is_left_behind(busy: subprocess.Popen[bytes]) -> None:
    group = usable_group()
    if group is None:
        pytest.skip("no control group with a cpu controller that this user may make")
    _, parent, version = group
    with Group(parent, version) as one:
        one.limit(0.5)
        one.take(busy.pid)
        assert str(busy.pid) in (one.folder / "cgroup.procs").read_text().split()
    assert not one.folder.exists()
    assert str(busy.pid) in (parent / "cgroup.procs").read_text().split()


@pytest.mark.parametrize("cores", [0.0, -1.0, 1.5, float("nan")])
def test_a_share_that_is_none_is_refused(cores: float) -> None:
    with pytest.raises(ValueError, match="cores"), throttled(1, cores):
        pass


def test_a_flight_over_a_link_with_both_sides_held_back_is_flown_and_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The ground's share is receiver and localizer, and not the firmware, which has its own."""
    programs: list[list[str]] = []

    @contextlib.contextmanager
    def told(pid: int, cores: float, spared: tuple[int, ...]) -> Iterator[str]:
        with throttled(pid, cores, spared) as by:
            names = []
            for held in tree(pid, spared):
                words = Path(f"/proc/{held}/cmdline").read_text().split("\0")
                names.append(words[2] if words[1] == "-m" else Path(words[1]).name)
            programs.append(sorted(names))
            yield by

    monkeypatch.setattr(limits_stand, "throttled", told)
    flight = Flight(ATRIUM / "flight.mcap", ATRIUM, 2.0)
    under = Conditions({"delay_s": 0.01}, payload_cores=0.9, ground_cores=0.9, rate_hz=5.0)
    measured = measure(flight, under, seed=1)
    assert measured.why == "" and measured.held_by == f"{method()}, {method()}"
    assert programs == [
        ["ground_station.service.intake", "ground_station.service.localizing", "limits_trial.py"],
        ["pi_firmware"],
    ]
    outcome = Outcome(**measured.outcome)
    assert outcome.due >= 1 and outcome.received and outcome.ground_cores
    assert 0.0 <= measured.share == outcome.share <= 1.0
    assert measured.link["received"] == measured.link["delayed"] > 10
    assert measured.others_cores is not None and measured.took_s > 2.0


def test_a_recording_that_is_missing_is_no_limit(tmp_path: Path) -> None:
    with pytest.raises(TrialError, match=r"status 1: .*none\.mcap"):
        measure(Flight(tmp_path / "none.mcap", ATRIUM, 2.0), Conditions(), seed=1)


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (StreamError("no video within 30 s on UDP port 5600"), 2),
        (FirmwareError("the firmware ended with status 3: no frame"), 2),
        (FirmwareError("the firmware ended with status 2: encoder.bitrate_kbps"), 1),
        (InputError("flight.mcap: it carries no camera calibration"), 1),
    ],
)
def test_only_what_a_burden_can_do_counts_as_not_borne(
    error: Exception, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_: Trial) -> Outcome:
        raise error

    path = tmp_path / "trial.json"
    path.write_text(json.dumps(asdict(Trial("flight.mcap", "map", 30.0, 1.0))))
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(limits_trial, "fly", fails)
    try:
        assert limits_trial.main(str(path)) == status
    finally:
        signal.signal(signal.SIGTERM, before)
