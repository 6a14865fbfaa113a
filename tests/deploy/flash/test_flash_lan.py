"""A card as `make flash` writes it reaches `blimp serve --lan`, and a station set by the block."""

from __future__ import annotations

import json
import os
import re
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
SHIPPED = REPOSITORY / "ground_station/service/station.toml"
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
def data(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where the person at the station has their keys."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_DATA_HOME", str(tmp_path_factory.mktemp("share")))
        yield Path(os.environ["XDG_DATA_HOME"])


@pytest.fixture(scope="module")
def card(data: Path, shared_image: Path, tmp_path_factory: pytest.TempPathFactory) -> Card:
    """A board's card after its first start; keys and flasher by the commands a person types."""
    tmp_path = tmp_path_factory.mktemp("card")
    bench = Bench(tmp_path, shared_image, tmp_path / "card", data / "blimp/keys")
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


def reaches(
    namespaces: list[str], card: Card, folder: Path, *words: str, interfaces: int
) -> dict[str, dict[str, object]]:
    """What the station's page says of its payloads."""
    serve = [BLIMP, "serve", "--map", str(REPOSITORY / "maps/atrium"), *words]
    serve += ["--set", f"recording.folder={folder / 'recordings'}"]
    toml = str(card.blimp / "payload.toml")
    hosts = [*namespaces, sys.executable, str(HOSTS), toml, str(interfaces), *serve]
    done = subprocess.run(
        hosts, capture_output=True, text=True, timeout=200, cwd=folder,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    return dict(json.loads(done.stdout)) if done.stdout.strip("{} \n") else pytest.fail(done.stderr)


@pytest.mark.parametrize(("words", "interfaces"), [([], 1), (["ground0"], 2)])
def test_a_flashed_card_reaches_serve_lan(
    namespaces: list[str], card: Card, tmp_path: Path, words: list[str], interfaces: int
) -> None:
    heard = reaches(namespaces, card, tmp_path, "--lan", *words, interfaces=interfaces)
    assert list(heard) == ["blimp-1"]
    assert heard["blimp-1"]["alive"] and heard["blimp-1"]["encrypted"]
    assert int(str(heard["blimp-1"]["frames"])) >= 10


def test_a_flashed_card_reaches_a_station_set_by_the_block_of_station_toml(
    namespaces: list[str], card: Card, data: Path, tmp_path: Path
) -> None:
    block = "\n".join(re.findall(r"^#   (.+)$", SHIPPED.read_text(), re.MULTILINE))
    certificates = data / "blimp/keys/ground/main"
    block = block.replace("/etc/blimp/certificates", str(certificates)).replace("wlan0", "ground0")
    config = tmp_path / "station.toml"
    config.write_text(block)
    heard = reaches(namespaces, card, tmp_path, "--config", str(config), interfaces=1)
    assert heard["blimp-1"]["alive"] and heard["blimp-1"]["encrypted"]
