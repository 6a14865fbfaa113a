"""A card as `make flash` writes it reaches `blimp serve --lan`.

That the block of station.toml sets the same is held by tests/service/test_lan.py.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from card_bench import REPOSITORY, Bench, run

from deploy.board.candidate import Check
from deploy.board.card import Card, Owners
from deploy.board.disk import Disk
from deploy.board.provision import IN_FORCE, provision

pytestmark = pytest.mark.alone  # a station and a payload fly

HOSTS = Path(__file__).with_name("lan_hosts.py")
BLIMP = str(Path(sys.executable).with_name("blimp"))
BOARD = REPOSITORY / "deploy/board/payload/qemu.toml"
_UNCHECKED: Check = lambda _: None  # noqa: E731 - the firmware itself is started with it


@pytest.fixture
def namespaces() -> list[str]:
    """The command that runs another one in network namespaces of its own."""
    if missing := [name for name in ("unshare", "ip") if shutil.which(name) is None]:
        pytest.skip(f"not on this machine: {', '.join(missing)}")
    command = ["unshare", "-rn"]
    probe = "ip link set lo up && ip link add a0 type veth peer name b0"
    tried = subprocess.run([*command, "sh", "-c", probe], capture_output=True, text=True)
    if tried.returncode:
        pytest.skip(f"network namespaces are not allowed here: {tried.stderr.strip()[:100]}")
    return command


@pytest.fixture(scope="module")
def card(shared_image: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Card]:
    """A board's card after its first start; keys and flasher by the commands a person types."""
    tmp_path = tmp_path_factory.mktemp("card")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_DATA_HOME", str(tmp_path / "share"))
        yield flashed(tmp_path, shared_image)


def flashed(tmp_path: Path, shared_image: Path) -> Card:
    bench = Bench(tmp_path, shared_image, tmp_path / "card", tmp_path / "share/blimp/keys")
    bench.card.write_bytes(bytes(shared_image.stat().st_size))
    for words in (["init"], ["ground", "main"], ["payload", "blimp-1"]):
        done = run([BLIMP, "keys", *words], program=True)
        assert done.returncode == 0, done.stderr
    done = run(bench.command())
    assert done.returncode == 0, done.stderr
    card = Card(tmp_path / "board")
    for path in bench.listed():
        if path.startswith("blimp/") and not path.endswith("/"):
            file = card.boot / path.removeprefix("blimp/")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(bench.read(path))
    card.data.mkdir()
    card.defaults.parent.mkdir(parents=True)
    shutil.copy(BOARD, card.defaults)  # the emulated board's
    outcome = provision(card, Disk(), Owners(), _UNCHECKED)
    assert outcome.state == IN_FORCE, outcome
    return card


@pytest.mark.parametrize(("words", "interfaces"), [([], 1), (["ground0"], 2)])
def test_a_flashed_card_reaches_serve_lan(
    namespaces: list[str], card: Card, tmp_path: Path, words: list[str], interfaces: int
) -> None:
    """By what the station's page says of its payloads."""
    serve = [BLIMP, "serve", "--map", str(REPOSITORY / "maps/atrium"), "--lan", *words]
    serve += ["--set", f"recording.folder={tmp_path / 'recordings'}"]
    toml = str(card.blimp / "payload.toml")
    done = subprocess.run(
        [*namespaces, sys.executable, str(HOSTS), toml, str(interfaces), *serve],
        capture_output=True, text=True, timeout=200, cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    heard = json.loads(done.stdout)
    assert list(heard) == ["blimp-1"], done.stderr
    assert heard["blimp-1"]["alive"] and heard["blimp-1"]["encrypted"]
    assert heard["blimp-1"]["frames"] >= 10
