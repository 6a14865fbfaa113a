"""A payload is asked once, its answer is told, and silence is an error that says what is known."""

import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from ground_station.cli import main
from ground_station.keys.authority import Authority
from ground_station.stream.command import ask
from pi_firmware.wire import credentials, keys, messages
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.telemetry import Session, open_session, session_config

LIMIT_S = 20.0


class FakePayload:
    """Answers commands on a session as a payload does; `asked` keeps them."""

    def __init__(self, session: Session, payload_id: str = "blimp-1") -> None:
        self.asked: list[tuple[str, messages.Command]] = []
        self._alive = session.zenoh.liveliness().declare_token(keys.key(payload_id, keys.ALIVE))
        self._served = session.zenoh.declare_queryable(keys.command(payload_id, "*"), self._answer)

    def _answer(self, query: Any) -> None:
        name = str(query.key_expr).rpartition("/")[2]
        command = messages.decode(messages.Command, query.payload.to_bytes())
        self.asked.append((name, command))
        if name == "idr":
            answer = messages.Answer(time_ns=1, done=True)
        elif name == "bitrate":
            answer = messages.Answer(time_ns=1, done=True, values={"kbps": 800.0})
        elif name == "reboot":
            query.reply(query.key_expr, b"no answer as agreed")
            return
        elif name == "shutdown":
            return  # without an answer
        else:
            answer = messages.Answer(time_ns=1, done=False, reason="no recording\x1b[2J runs")
        query.reply(query.key_expr, messages.encode(answer))


@pytest.fixture
def ground() -> Iterator[Session]:
    session = open_session(listen=["tcp/127.0.0.1:0"])
    yield session
    session.close()


@pytest.fixture
def payload(ground: Session) -> Iterator[FakePayload]:
    session = open_session(connect=ground.listening)
    yield FakePayload(session)
    session.close()


def test_a_command_is_sent_once_and_answered(ground: Session, payload: FakePayload) -> None:
    assert ask(ground, "blimp-1", "idr", timeout_s=LIMIT_S).done
    answer = ask(ground, "blimp-1", "bitrate", {"kbps": 812.5}, LIMIT_S)
    assert answer.done and answer.values == {"kbps": 800.0}
    refused = ask(ground, "blimp-1", "record-stop", timeout_s=LIMIT_S)
    assert not refused.done and refused.reason.startswith("no recording")
    assert [name for name, _ in payload.asked] == ["idr", "bitrate", "record-stop"]
    assert payload.asked[1][1].arguments == {"kbps": 812.5}


def test_a_payload_that_comes_later_is_waited_for(ground: Session) -> None:
    sessions: list[Session] = []

    def come() -> None:
        sessions.append(open_session(connect=ground.listening))
        FakePayload(sessions[0])

    late = threading.Timer(0.5, come)
    late.start()
    assert ask(ground, "blimp-1", "idr", timeout_s=LIMIT_S).done
    late.join()
    sessions[0].close()


def test_silence_is_one_line_that_says_what_is_known(ground: Session, payload: FakePayload) -> None:
    cases: list[tuple[str, str, str]] = [
        ("blimp-2", "idr", r"'blimp-2' was not heard of within 0.5 s"),
        ("blimp-1", "shutdown", r"was asked for 'shutdown' and "),
        ("blimp-1", "reboot", r"blimp.answer: not JSON text"),
        ("blimp-1", "a*", r"command 'a\*': expected a name"),
        ("blimp-1", "**", r"expected a name"),
        ("Blimp", "idr", r"payload_id 'Blimp'"),
    ]
    for payload_id, name, reason in cases:
        with pytest.raises(TelemetryError, match=reason) as caught:
            ask(ground, payload_id, name, timeout_s=0.5)
        assert "\n" not in str(caught.value)
    assert [name for name, _ in payload.asked] == ["shutdown", "reboot"]
    with pytest.raises(TelemetryError, match="not finite"):
        ask(ground, "blimp-1", "bitrate", {"kbps": float("nan")}, 0.5)


def test_an_answer_that_does_not_come_is_not_waited_for_longer(ground: Session) -> None:
    session = open_session(connect=ground.listening)
    held: list[Any] = []
    served = session.zenoh.declare_queryable(keys.command("blimp-1", "*"), held.append)
    with pytest.raises(TelemetryError, match=r"was asked for 'idr' and did not answer within 1 s"):
        ask(ground, "blimp-1", "idr", timeout_s=1.0)
    assert len(held) == 1
    served.undeclare()
    session.close()


def test_a_living_payload_that_takes_no_commands_is_told_apart(ground: Session) -> None:
    session = open_session(connect=ground.listening)
    alive = session.zenoh.liveliness().declare_token(keys.key("old", keys.ALIVE))
    with pytest.raises(TelemetryError, match="'old' is alive but takes no commands"):
        ask(ground, "old", "idr", timeout_s=2.0)
    alive.undeclare()
    session.close()


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def test_the_command_line_listens_connects_and_goes_through_a_ground_station(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base, more = ["command", "blimp-1"], ["--timeout-s", str(LIMIT_S)]
    # By listening: the payload connects to where the ground station would be.
    endpoint = free_endpoint()
    waiting = open_session(connect=[endpoint])
    fake = FakePayload(waiting)
    out = tmp_path / "answer.json"
    command = [*base, "bitrate", "kbps=812.5", "--listen", endpoint, *more, "--json", str(out)]
    assert main(command) == 0
    assert capsys.readouterr().out.startswith("blimp-1: bitrate: done (kbps 800)\nnext: ")
    assert json.loads(out.read_text()) == {
        "payload": "blimp-1", "command": "bitrate", "arguments": {"kbps": 812.5},
        "done": True, "reason": "", "values": {"kbps": 800.0},
    }  # fmt: skip
    waiting.close()
    # By connecting to the payload.
    listening = open_session(listen=["tcp/127.0.0.1:0"])
    fake = FakePayload(listening)
    assert main([*base, "record-stop", "--connect", *listening.listening, *more]) == 1
    assert capsys.readouterr().out.startswith(
        "blimp-1: record-stop: refused: no recording [2J runs\nnext: "
    )
    # By connecting to a ground station that the payload is connected to.
    ground = open_session(listen=["tcp/127.0.0.1:0"])
    other = open_session(connect=ground.listening)
    third = FakePayload(other, "blimp-3")
    assert main(["command", "blimp-3", "idr", "--connect", *ground.listening, *more]) == 0
    assert [name for name, _ in third.asked] == ["idr"]
    assert [name for name, _ in fake.asked] == ["record-stop"]
    for session in (other, ground, listening):
        session.close()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["bitrate", "kbps"], "'kbps': expected KEY=VALUE"),
        (["bitrate", "kbps=fast"], "'fast' is not a number"),
        (["bitrate", "kbps=nan"], "not finite"),
        (["bitrate", "kbps=1", "kbps=2"], "given twice"),
        (["idr", "--timeout-s", "nan"], "--timeout-s is nan; allowed: 0.1 to 600"),
        (["idr", "--connect", "tcp/10.0.0.1:7447"], "only loopback is allowed"),
        (["idr", "--certificates", "/nonexistent"], "'ca.pem' is missing"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["command", "blimp-1", *arguments]) == 2
    error = capsys.readouterr().err
    assert reason in error and len(error.splitlines()) == 1


def test_nobody_there_is_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("--connect", "--listen"):
        command = ["command", "blimp-1", "idr", option, free_endpoint(), "--timeout-s", "0.5"]
        assert main(command) == 2
        error = capsys.readouterr().err
        assert len(error.splitlines()) == 1
        assert ("nobody is there" if option == "--connect" else "not heard of") in error


def test_a_ground_station_that_runs_already_is_named(
    ground: Session, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["command", "blimp-1", "idr", "--listen", *ground.listening]) == 2
    error = capsys.readouterr().err
    assert "the port is in use; one that runs already is asked with --connect" in error


def test_over_tls_only_a_ground_on_the_list_is_answered(tmp_path: Path) -> None:
    made = Authority.create(tmp_path / "keys")
    for role, name in (("ground", "main"), ("payload", "blimp-1"), ("payload", "blimp-2")):
        made.add(role, name)
    certificates = str(made.of("payload.blimp-1"))
    served = open_session(listen=["tls/127.0.0.1:0"], certificates=certificates)
    fake = FakePayload(served)
    ground = open_session(connect=served.listening, certificates=made.of("ground.main"))
    assert ask(ground, "blimp-1", "idr", timeout_s=LIMIT_S).done
    other = open_session(connect=served.listening, certificates=made.of("payload.blimp-2"))
    with pytest.raises(TelemetryError, match="was not heard of"):
        ask(other, "blimp-1", "idr", timeout_s=1.5)
    # A stranger's program need not wait until somebody takes questions, nor deny itself anything.
    held = credentials.load(made.of("payload.blimp-2"))
    bare = session_config([], served.listening, held, rules={"enabled": False})
    stranger = zenoh.open(bare)
    order = messages.encode(messages.Command(time_ns=1))
    limit_s = time.monotonic() + LIMIT_S
    while not list(stranger.info.peers_zid()) and time.monotonic() < limit_s:
        time.sleep(0.02)
    assert list(stranger.info.peers_zid())
    assert not list(stranger.get(keys.command("blimp-1", "idr"), payload=order, timeout=1.0))
    assert len(fake.asked) == 1
    stranger.close()
    for session in (other, ground, served):
        session.close()
