"""Commands are carried out or refused with a reason, and never end a flight."""

import math
import threading
import time
from collections.abc import Iterator

import pytest

from pi_firmware.commands import Action, Commands, Refusal
from pi_firmware.wire.messages import Answer, Command

LIMIT_S = 10.0


def refuse() -> None:
    raise Refusal("not now")


def break_down() -> None:
    raise KeyError("inside")


@pytest.fixture
def told() -> list[str]:
    return []


@pytest.fixture
def commands(told: list[str]) -> Iterator[Commands]:
    made = Commands(
        {
            "idr": Action(lambda: None),
            "bitrate": Action(
                lambda kbps: {"kbps": 2 * kbps}, {"kbps": (50, 20_000)}, frozenset({"kbps"})
            ),
            "expose": Action(lambda **given: given, {"exposure_s": (0, 1), "gain": (0, 16)}),
            "refuse": Action(refuse),
            "break": Action(break_down),
            "sleep": Action(lambda: time.sleep(0.3)),
        },
        told.append,
    )
    yield made
    made.close()


def command(**arguments: float) -> Command:
    return Command(time_ns=1, arguments=arguments)


def test_a_command_is_done_and_says_what_is_set(commands: Commands) -> None:
    done = commands.carry_out("bitrate", command(kbps=600))
    assert (done.done, done.reason, done.values) == (True, "", {"kbps": 1200})
    assert commands.carry_out("idr", command()).done
    assert commands.carry_out("expose", command(gain=2)).values == {"gain": 2}


@pytest.mark.parametrize(
    ("name", "arguments", "reason"),
    [
        ("fly", {}, "no command 'fly' (there are: bitrate, break, expose, idr, refuse, sleep)"),
        ("idr", {"now": 1}, "idr: unknown number 'now' (it takes: none)"),
        ("bitrate", {}, "bitrate: 'kbps' is missing"),
        ("bitrate", {"kbps": 49}, "bitrate: 'kbps' is 49; allowed: 50 to 20000"),
        ("bitrate", {"kbps": math.nan}, "bitrate: 'kbps' is nan; allowed: 50 to 20000"),
        ("refuse", {}, "not now"),
        ("break", {}, "KeyError: 'inside'"),
    ],
)
def test_what_is_not_done_has_a_reason(
    commands: Commands, name: str, arguments: dict[str, float], reason: str
) -> None:
    answer = commands.carry_out(name, command(**arguments))
    assert (answer.done, answer.reason, answer.values) == (False, reason, {})


def test_each_command_is_answered_once_in_order_and_told(
    commands: Commands, told: list[str]
) -> None:
    answers: list[Answer] = []
    last = threading.Event()
    for name in ("sleep", "refuse", "idr"):
        commands.ask(name, command(), answers.append)
    commands.ask("bitrate", command(kbps=100), lambda answer: (answers.append(answer), last.set()))
    assert last.wait(LIMIT_S)
    assert [a.done for a in answers] == [True, False, True, True]
    commands.close()
    assert told == ["sleep: done", "refuse: not now", "idr: done", "bitrate: done"]


def test_a_flood_of_commands_is_refused_and_not_stored(commands: Commands) -> None:
    answers: list[Answer] = []
    for _ in range(100):
        commands.ask("sleep", command(), answers.append)
    refused = [a for a in answers if not a.done]
    assert len(refused) >= 91
    assert {a.reason for a in refused} == {"8 commands wait already"}
