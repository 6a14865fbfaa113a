"""Ground stations that must not be spoken to: nothing reaches them, and the payload's log says why.

The real program, connected to all of them at once: one of another authority, one whose certificate
has expired, one without any, one that was taken off the list. A good one hears it all the while.
"""

import datetime
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from firmware_program import LIMIT_S, LOOK_S, Program
from short_certificates import certify

from ground_station.keys.authority import Authority
from ground_station.stream.command import ask
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.wire import credentials, keys, messages
from pi_firmware.wire.refusal import refusal

LOOKS = 3  # times that each is looked at again after it was complained of
WRONG = ("foreign", "expired", "bare", "unlisted")


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Certificate folders: the payload's, a good ground station's, and the wrong ones'."""
    room = tmp_path_factory.mktemp("keys")
    ours, theirs = Authority.create(room / "ours"), Authority.create(room / "theirs")
    for authority in (ours, theirs):
        authority.add("ground", "main")
        authority.add("payload", "blimp-1")
    payload = Path(shutil.copytree(ours.of("payload.blimp-1"), room / "payload"))
    ours.add("ground", "later")  # the payload's copy does not list it
    ended = datetime.timedelta(days=-1)
    return {
        "payload": payload,
        "good": ours.of("ground.main"),
        "foreign": theirs.of("ground.main"),
        "expired": certify(ours, "ground.main", room / "expired", ended),
        "unlisted": ours.of("ground.later"),
    }


@pytest.fixture
def grounds(folders: dict[str, Path]) -> Iterator[dict[str, TelemetryListener]]:
    """Each listens at a port of its own."""
    opened = {
        name: TelemetryListener(["tls/127.0.0.1:0"], certificates=folders[name])
        for name in ("foreign", "expired", "unlisted")
    }
    opened["bare"] = TelemetryListener(["tcp/127.0.0.1:0"])
    yield opened
    for listener in opened.values():
        listener.close()


def endpoint(listener: TelemetryListener) -> str:
    return "tls/" + listener.endpoints[0].partition("/")[2]


def answers(listener: TelemetryListener) -> int:
    """How many answers a ground station gets that asks for an IDR whoever may be there."""
    body = messages.encode(messages.Command(time_ns=1))
    asked = listener.session.zenoh.get(keys.command("blimp-1", "idr"), payload=body, timeout=0.3)
    return sum(1 for reply in asked if reply.ok)


def test_the_wrong_ones_hear_nothing_command_nothing_and_are_told_of_once(
    folders: dict[str, Path], grounds: dict[str, TelemetryListener]
) -> None:
    where = {name: endpoint(listener) for name, listener in grounds.items()}
    with Program(folders["payload"], list(where.values())) as program:
        for name, words in (
            ("foreign", "its certificate is another authority's"),
            ("expired", "its certificate has expired"),
            ("bare", "speaks no TLS"),
            ("unlisted", "is ground.later's, who is not on this machine's list"),
        ):
            line = program.wait(where[name])
            assert line.startswith("pi_firmware: telemetry: ") and words in line, name
        for _ in range(LOOKS):
            time.sleep(LOOK_S)
            assert [answers(listener) for listener in grounds.values()] == [0] * len(WRONG)
        told = Counter(line for line in program.said if "telemetry: tls/" in line)
    assert set(told.values()) == {1} and len(told) == len(WRONG), told
    assert [listener.payloads() for listener in grounds.values()] == [[]] * len(WRONG)


def test_the_same_program_is_heard_and_commanded_by_the_good_one(
    folders: dict[str, Path], grounds: dict[str, TelemetryListener]
) -> None:
    """And says nothing of the others: it has somebody to speak to."""
    with TelemetryListener(["tls/127.0.0.1:0"], certificates=folders["good"]) as good:
        connect = [endpoint(grounds["foreign"]), *good.endpoints]
        with Program(folders["payload"], connect) as program:
            assert good.wait("blimp-1", lambda s: s.gate is not None, LIMIT_S)
            assert ask(good.session, "blimp-1", "idr", timeout_s=LIMIT_S).done
            assert not [line for line in program.said if "telemetry: " in line]


def test_nobody_there_is_no_refusal(folders: dict[str, Path]) -> None:
    held = credentials.load(folders["payload"])
    assert refusal("tls/127.0.0.1:9", held) == ""


def test_a_ground_station_that_does_not_trust_us_is_told(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    """Its certificate is good; the refusal comes after the handshake, as TLS 1.3 has it."""
    wary = Path(shutil.copytree(folders["good"], tmp_path / "wary"))
    shutil.copy(folders["foreign"] / "ca.pem", wary / "ca.pem")
    held = credentials.load(folders["payload"])
    with TelemetryListener(["tls/127.0.0.1:0"], certificates=wary) as listener:
        why = refusal(listener.endpoints[0], held)
    assert why.startswith(listener.endpoints[0]) and "this machine's certificate" in why


def test_a_good_ground_station_refuses_nothing(folders: dict[str, Path]) -> None:
    held = credentials.load(folders["payload"])
    with TelemetryListener(["tls/127.0.0.1:0"], certificates=folders["good"]) as listener:
        assert refusal(listener.endpoints[0], held, limit_s=1.0) == ""
