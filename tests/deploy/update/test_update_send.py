"""`python -m deploy.update` as one calls it, to a card behind an `ssh` that is a folder here, and
behind a real sshd on loopback."""

import contextlib
import getpass
import io
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from card_stand import CHECKOUT, NEW, Card, contents, lay, release_json

from deploy.board.releases import receive
from deploy.board.releases.choose import HEALTHY, Choice
from deploy.errors import DeployError
from deploy.update import __main__ as command
from deploy.update import bundle as bundles
from deploy.update import card as remote
from ground_station.keys.authority import Authority

OLDEST = "0.0.1+git0ldest"
WELL = "ActiveState=active\nNRestarts=0\nActiveEnterTimestampMonotonic=1\n"
ENDED = "ActiveState=activating\nNRestarts=1\nResult=exit-code\nExecMainStatus=1\n"

# Who is systemd: starts the firmware of the release that start.py chooses, which ends at once.
SYSTEMCTL = """#!/bin/sh
case $1 in
show) cat "$CARD/systemctl.show" ;;
restart) "$PYTHON" -m deploy.board.start --root "$CARD" >>"$CARD/journal" 2>&1 ;;
start) setsid "$PYTHON" -m deploy.board.releases --root "$CARD" watch >>"$CARD/journal" 2>&1 & ;;
esac
"""
# The last word is what is asked of the card's program.
PROGRAM = """#!/bin/sh
printf '%s\\n' "$*" >>"$CARD/asked"
[ ! -e "$CARD/unreachable" ] || { echo 'ssh: connect to host x: No route to host' >&2; exit 255; }
words=${SSH_ORIGINAL_COMMAND:-$*}; words=${words##*deploy.board.releases }; action=${words%% *}
[ "$action" != receive ] || [ ! -e "$CARD/cut" ] || { head -c 5000 >/dev/null; exit 255; }
exec "$PYTHON" -m deploy.board.releases --root "$CARD" $words
"""


class Stand:
    """A card that the command reaches, and an authority whose payload it is."""

    def __init__(self, folder: Path, card: Card, keys: Path) -> None:
        self.folder, self.card = folder, card
        self.keys, self.site = folder / "keys", folder / "site"
        shutil.copytree(keys, self.keys)
        shutil.copy(self.keys / "payload/blimp-1/allowed_signers", card.at.signers)
        shutil.rmtree(card.at.factory)
        lay(card.at.factory, contents(OLDEST, made="2020-01-01T00:00:00Z"))
        lay(self.site, {"library.py": b"NAME = 1\n"})
        for name, text in (("ssh", PROGRAM), ("systemctl", SYSTEMCTL)):
            (folder / "bin").mkdir(exist_ok=True)
            (folder / "bin" / name).write_text(text)
            (folder / "bin" / name).chmod(0o755)
        self.environment = {
            **os.environ,
            "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
            "CARD": str(card.root),
            "PYTHON": sys.executable,
            "PYTHONPATH": str(CHECKOUT),
        }
        self.behave(WELL)

    def behave(self, shown: str) -> None:
        (self.card.root / "systemctl.show").write_text(shown)

    def update(self, *more: object, keys: bool = False) -> subprocess.CompletedProcess[str]:
        """The command in this process, and what it says; `keys`: asks `blimp keys`, too."""
        given = ["--payload", "blimp-1", "--keys", self.keys, "--site", self.site]
        words = ["update", *map(str, [*given, "--host", "192.0.2.1", *more])]
        with (
            contextlib.redirect_stderr(io.StringIO()) as stderr,
            contextlib.redirect_stdout(io.StringIO()) as stdout,
            mock.patch.dict(os.environ, self.environment),
            mock.patch.object(sys, "argv", words),
            mock.patch.object(remote, "_POLL_S", 0.1),
            mock.patch.object(bundles, "release_key", bundles.release_key if keys else _first_key),
        ):
            try:
                status = command.main()
            except SystemExit as end:
                status = int(str(end.code))
        return subprocess.CompletedProcess(words, status, stdout.getvalue(), stderr.getvalue())


def _first_key(keys: Path, log: Callable[[str], None]) -> Path:
    """What `blimp keys` says of an authority that was never rotated, without its start."""
    return keys / "releases/1"


def authority(folder: Path) -> Path:
    """An authority with a station and the payload blimp-1."""
    made = Authority.create(folder)
    made.add("ground", "main")
    made.add("payload", "blimp-1")
    return folder


@pytest.fixture(scope="module")
def own_keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return authority(tmp_path_factory.mktemp("authority") / "own")


@pytest.fixture(scope="module")
def other_keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return authority(tmp_path_factory.mktemp("authority") / "other")


@pytest.fixture
def stand(tmp_path: Path, card: Card, own_keys: Path) -> Stand:
    return Stand(tmp_path, card, own_keys)


def test_a_checkout_comes_into_force(stand: Stand) -> None:
    done = stand.update(keys=True)
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert lines[0] == f"update: blimp-1 (zero2w) runs {OLDEST}"
    assert lines[1].startswith("sending 0.") and " MB in " in lines[1]
    assert lines[2].endswith("is on the card and on trial, which ends within 180 s")
    assert lines[3].endswith("is in force") and len(lines) == 4 and done.stdout == ""
    version = lines[3].split()[1]
    assert stand.card.choice() == Choice(version, "update")
    folder = stand.card.at.folder(version)
    tracked = (CHECKOUT / "pi_firmware/payload.py").read_bytes()
    assert (folder / "pi_firmware/payload.py").read_bytes() == tracked
    assert (folder / "site/library.py").is_file()
    # The host key is the one that the authority made for this payload, and no other.
    asked = (stand.card.root / "asked").read_text().splitlines()[0]
    assert "StrictHostKeyChecking=yes" in asked and "HostKeyAlias=blimp-1" in asked
    assert " -l pilot " in f" {asked} " and " -- 192.0.2.1 sudo -n " in asked
    again = stand.update()
    if ".dirty." not in version:  # a change without a commit is a new version each time
        assert again.returncode == 0 and again.stderr.endswith("is in force already\n")


def test_one_that_ends_by_itself_goes_back_with_status_1(stand: Stand) -> None:
    stand.behave(ENDED)
    done = stand.update()
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"update: blimp-1 went back to {OLDEST}: 0.")
    assert last.endswith("the firmware ended by itself (activating, exit-code, status 1)")
    assert stand.card.choice().how == "fell back" and stand.card.choice().name == ""


def one_line(done: subprocess.CompletedProcess[str], said: str) -> None:
    assert done.returncode == 2, done.stderr
    assert said in done.stderr.splitlines()[-1] and "Traceback" not in done.stderr


def test_what_the_card_refuses_is_one_line_and_status_2(stand: Stand, other_keys: Path) -> None:
    other = stand.update("--keys", other_keys)
    one_line(other, "blimp-1 refuses: the bundle's signature is of no release key")
    lay(stand.card.at.factory, {"release.json": release_json("99.0", made="2020-01-01T00:00:00Z")})
    one_line(stand.update(), "is older than 99.0")
    assert stand.card.names() == set()
    allowed = stand.update("--allow-older")
    assert allowed.returncode == 0, allowed.stderr


def test_a_link_that_breaks_in_the_midst_leaves_the_card_as_it_was(stand: Stand) -> None:
    (stand.card.root / "cut").touch()
    one_line(stand.update(), "ssh ended with status 255")
    assert stand.card.names() == set()


def test_a_payload_that_is_not_there_is_one_line(stand: Stand) -> None:
    (stand.card.root / "unreachable").touch()
    one_line(stand.update(), "192.0.2.1: ssh: connect to host x: No route to host")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--payload", "a b"], "--payload is 'a b'"),
        (["--host", "-oProxyCommand=x"], "argument --host|which is no address"),
        (["--host=-oProxyCommand=x"], "which is no address"),
        (["--port", "0"], "allowed: 1 to 65535"),
        (["--identity", "/not/there"], "--identity /not/there: not there"),
        (["--site", "/not/there"], "--site /not/there: not there"),
        (["--keys", "/not/there"], "no authority here"),
    ],
)
def test_bad_input_is_one_line(stand: Stand, given: list[str], said: str) -> None:
    done = stand.update(*given, keys=True)
    assert done.returncode == 2 and any(part in done.stderr for part in said.split("|"))
    assert not (stand.card.root / "asked").exists()


class Silent(remote.Card):
    """A card that answers what a test lays out."""

    def __init__(self, answers: list[Any]) -> None:
        self.name, self.host, self.answers = "blimp-1", "x", answers

    def ask(self, action: str) -> dict[str, Any]:
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if isinstance(answer, DeployError):
            raise answer
        return dict(answer)


def test_a_link_that_goes_and_comes_back_is_no_end() -> None:
    away = DeployError("x: no route")
    healthy = {"last": {"id": "t", "outcome": "healthy"}}
    older = {"last": {"id": "s", "outcome": "fell back"}}
    said: list[str] = []
    card = Silent([{"last": None}, away, away, older, away, healthy])
    assert card.follow("t", 120, said.append, lambda s: None)["outcome"] == HEALTHY
    assert said == ["not reached, trying on: x: no route"] * 2
    now_s = [0.0]

    def sleep(seconds: float) -> None:
        now_s[0] += seconds

    with pytest.raises(DeployError, match="not heard what became of it within 180 s"):
        Silent([away]).follow("t", 120, said.append, sleep, lambda: now_s[0])


@pytest.fixture
def sshd(stand: Stand, tmp_path: Path) -> Iterator[int]:
    """A real sshd on loopback, whose only command is the card's program; its port."""
    program = shutil.which("sshd", path=f"{os.environ['PATH']}:/usr/sbin")
    if program is None:
        pytest.skip("no sshd here (openssh-server)")
    if os.geteuid() == 0:
        with suppress(FileExistsError):
            os.makedirs("/run/sshd")  # noqa: PTH103
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    variables = "\n".join(
        f"export {name}='{stand.environment[name]}'"
        for name in ("PATH", "CARD", "PYTHON", "PYTHONPATH")
    )
    forced = tmp_path / "forced"
    forced.write_text(PROGRAM.replace("#!/bin/sh\n", f"#!/bin/sh\n{variables}\n"))
    forced.chmod(0o755)
    config = tmp_path / "sshd_config"
    config.write_text(
        f"Port {port}\nListenAddress 127.0.0.1\nPidFile none\nUsePAM no\nStrictModes no\n"
        f"HostKey {stand.keys}/payload/blimp-1/ssh_ed25519\n"
        f"AuthorizedKeysFile {stand.keys}/ground/main/ssh_ed25519.pub\n"
        f"PasswordAuthentication no\nForceCommand {forced}\n"
    )
    log = (tmp_path / "sshd.log").open("w")
    server = subprocess.Popen([program, "-D", "-e", "-f", str(config)], stderr=log)
    try:
        until_s = time.monotonic() + 20
        while time.monotonic() < until_s and server.poll() is None:
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                break
            time.sleep(0.05)
        if server.poll() is not None:
            pytest.skip(f"sshd does not run here: {(tmp_path / 'sshd.log').read_text()[-200:]}")
        yield port
    finally:
        server.terminate()
        server.wait(10)
        log.close()


def test_over_a_real_sshd(
    stand: Stand,
    sshd: int,
    tmp_path: Path,
    other_keys: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def reach(keys: Path, identity: Path | None = None) -> remote.Card:
        return remote.Card("blimp-1", "127.0.0.1", keys, identity, sshd, getpass.getuser())

    card = reach(stand.keys)
    monkeypatch.setattr(remote, "_POLL_S", 0.2)
    assert card.ask("status")["in_force"]["version"] == OLDEST
    held = card.ask("holds")
    assert held == receive.holds(stand.card.at)
    big = {"site/big": os.urandom(3_000_000)}
    made = bundles.make(contents(NEW, big), stand.keys / "releases/1")
    sizes: list[int] = []
    answer = card.give(made, held, sizes.append)
    assert sum(sizes) == bundles.size_to_send(made, held) > 3_000_000
    assert card.follow(answer["id"], 120, lambda line: None)["outcome"] == HEALTHY
    assert (stand.card.at.folder(NEW) / "site/big").read_bytes() == big["site/big"]
    # A refusal comes back as the card's own words, though the rest of the bundle is not read.
    stranger = bundles.make(contents("0.9.0", big), other_keys / "releases/1")
    for force in (False, True):
        with pytest.raises(DeployError, match="blimp-1 refuses: the bundle's signature is of no"):
            card.give(stranger, {}, sizes.append, force=force)
    # Another host key than the payload's own is refused.
    other = Path(shutil.copytree(other_keys, tmp_path / "other"))
    own = stand.keys / "ground/main/ssh_ed25519"
    wrong = reach(other, own)
    with pytest.raises(DeployError, match=r"another host key than this payload's$"):
        wrong.ask("status")
    # One that this authority knows no key of is taken at first sight, and kept.
    (other / "payload/blimp-1/ssh_ed25519.pub").unlink()
    first = reach(other, own)
    assert first.ask("status")["trial"] == ""
    assert (other / "known_hosts").stat().st_mode & 0o777 == 0o600
    assert (other / "known_hosts").read_text().startswith("blimp-1 ssh-ed25519 ")
    # Whose key the card does not know stays outside.
    with pytest.raises(DeployError, match="Permission denied"):
        reach(other).ask("status")
