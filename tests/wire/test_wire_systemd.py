"""What systemd is told, with a socket of ours in its place."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pi_firmware.wire.systemd import Notifier

LIMIT_S = 20.0


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """The service manager's end, and what NOTIFY_SOCKET says of it."""
    name = f"@blimp-test-{os.getpid()}" if request.param == "abstract" else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.settimeout(LIMIT_S)
        end.bind(name.replace("@", "\0", 1) if name[0] == "@" else name)
        yield end, name


def test_each_word_arrives_as_the_protocol_has_it(manager: tuple[socket.socket, str]) -> None:
    end, name = manager
    notifier = Notifier({"NOTIFY_SOCKET": name})
    said = [
        notifier.ready(),
        notifier.status("30.0 Hz, 2 % lost"),
        notifier.alive(),
        notifier.stopping(),
    ]
    assert said == [True] * 4
    assert [end.recv(4096) for _ in range(4)] == [
        b"READY=1",
        b"STATUS=30.0 Hz, 2 % lost",
        b"WATCHDOG=1",
        b"STOPPING=1",
    ]


def test_a_status_stays_one_line_and_short(manager: tuple[socket.socket, str]) -> None:
    end, name = manager
    notifier = Notifier({"NOTIFY_SOCKET": name})
    assert notifier.status("camera gone\nMAINPID=1\0\x1b[2J")
    assert end.recv(4096) == b"STATUS=camera gone MAINPID=1 [2J"
    assert notifier.status("x" * 100_000 + "\udcff")
    assert len(end.recv(65536)) < 1000


def test_children_do_not_inherit_the_variables() -> None:
    program = (
        "import os\n"
        "from pi_firmware.wire.systemd import Notifier\n"
        "watchdog_s = Notifier().watchdog_s\n"
        "left = [n for n in os.environ if n.startswith(('NOTIFY', 'WATCHDOG'))]\n"
        "print(watchdog_s, left, os.system('test -z \"$NOTIFY_SOCKET$WATCHDOG_USEC\"'))\n"
    )
    names = {"NOTIFY_SOCKET": "/nowhere", "WATCHDOG_USEC": "15000000"}
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, **names},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.strip() == "15.0 [] 0"


@pytest.mark.parametrize(
    ("variables", "watchdog_s"),
    [
        ({"WATCHDOG_USEC": "15000000"}, 15.0),
        ({"WATCHDOG_USEC": "500000", "WATCHDOG_PID": str(os.getpid())}, 0.5),
        ({"WATCHDOG_USEC": "15000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "15000000", "WATCHDOG_PID": "nonsense"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": str(2**64 - 1)}, None),
        ({"WATCHDOG_USEC": "-5"}, None),
        ({"WATCHDOG_USEC": "nan"}, None),
        ({"WATCHDOG_USEC": "1" * 5000}, None),
        ({}, None),
    ],
)
def test_the_watchdog_is_ours_or_none(
    tmp_path: Path, variables: dict[str, str], watchdog_s: float | None
) -> None:
    environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "HOME": "/", **variables}
    assert Notifier(environment).watchdog_s == watchdog_s
    assert environment == {"HOME": "/"}


@pytest.mark.parametrize(
    "name", ["", "@", "/", "relative", "vsock:2:1234", "/nowhere/notify", "/" + "x" * 300, "/a\0b"]
)
def test_without_a_socket_that_can_be_nothing_is_said_and_nothing_raises(name: str) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "15000000"})
    assert not notifier.ready()
    assert not notifier.status("as ever")
    assert not notifier.alive()
    assert not notifier.stopping()


def test_a_manager_that_does_not_read_is_not_waited_for_and_one_that_comes_back_is_heard(
    tmp_path: Path,
) -> None:
    path = tmp_path / "notify"
    notifier = Notifier({"NOTIFY_SOCKET": str(path)})
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as deaf:
        deaf.bind(str(path))
        # The kernel holds some hundreds at most; then each costs its second and is given up.
        said = []
        while len(said) < 5000 and all(said):
            said.append(notifier.alive())
        assert not said[-1]
    assert not notifier.alive(), "nobody is there"
    path.unlink()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as anew:
        anew.bind(str(path))
        anew.settimeout(LIMIT_S)
        assert notifier.alive()
        assert anew.recv(4096) == b"WATCHDOG=1"
