"""A root file system is built once, whole or not at all, and holds nothing of its builder's.

mmdebstrap's own minutes are not spent here: a stand-in of a few lines takes its place, which writes
down how it was called. What it would have built is checked by the slow build (`make image`).
"""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import eventually

from deploy.errors import DeployError
from deploy.image.packages.board import Board, load_board
from deploy.image.packages.rootfs import build_rootfs
from deploy.run import run
from tests.deploy.image.local_archive import Key, LocalArchive, need_tools

_ROOT = Path(__file__).parents[3]
_EPOCH = 1_767_225_600
_STAND_IN = f"""#!{sys.executable}
import json, os, pathlib, sys, time
called = pathlib.Path(os.environ["CALLED"])
inputs = {{pathlib.Path(word).name: pathlib.Path(word).read_text() for word in sys.argv[1:]
          if word.endswith(".sources")}}
calls = json.loads(called.read_text()) if called.exists() else []
keys = ("SOURCE_DATE_EPOCH", "TMPDIR", "PYTHONHASHSEED", "PYTHONPATH")
environment = {{key: os.environ.get(key) for key in keys}} | {{"pid": os.getpid()}}
calls.append([sys.argv[1:], environment, inputs])
(pathlib.Path(os.environ["TMPDIR"]) / "half").mkdir()
print("I: installing essential packages...", flush=True)
part = called.with_suffix(".part")
part.write_text(json.dumps(calls))
part.replace(called)
time.sleep(float(os.environ.get("TAKES_S", "0")))
if "FAILS" in os.environ:
    print("E: dpkg: it broke", flush=True)
    print("I: cleaning up", flush=True)
    sys.exit(25)
pathlib.Path(sys.argv[-2]).write_bytes(b"TAR")
"""


@pytest.fixture(scope="module")
def native(tmp_path_factory: pytest.TempPathFactory, keys: tuple[Key, Key]) -> Board:
    """A board of this machine's own architecture, with one package in a signed archive."""
    need_tools("dpkg")
    architecture = run(["dpkg", "--print-architecture"]).decode().strip()
    archive = LocalArchive(tmp_path_factory.mktemp("archive") / "debian", "Debian", architecture)
    archive.add("tool", "1.0")
    archive.publish(keys[0])
    board = load_board("qemu")
    return dataclasses.replace(
        board,
        architecture=architecture,
        archives=(archive.archive("debian", keys[0]),),
        packages=(dataclasses.replace(board.packages[0], names=("tool",)),),
    )


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stands in for mmdebstrap and for being root; the file that tells how it was called."""
    tools = tmp_path / "tools"
    tools.mkdir()
    (tools / "mmdebstrap").write_text(_STAND_IN)
    (tools / "mmdebstrap").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("CALLED", str(tmp_path / "calls.json"))
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    return tmp_path / "calls.json"


def _left(cache: Path) -> list[str]:
    return sorted(p.name for p in cache.iterdir() if p.suffix not in (".lock", ".log"))


def test_it_is_built_once_for_its_inputs(native: Board, calls: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    tar = build_rootfs(native, cache, _EPOCH)
    assert tar.read_bytes() == b"TAR" and _left(cache) == [tar.name]
    assert build_rootfs(native, cache, _EPOCH) == tar
    assert len(json.loads(calls.read_text())) == 1
    # Another list, another time: another tar. The first one stays.
    without = dataclasses.replace(native, left_out=())
    others = {build_rootfs(without, cache, _EPOCH), build_rootfs(native, cache, _EPOCH + 1)}
    assert len(others | {tar}) == 3 and len(_left(cache)) == 3


def test_mmdebstrap_is_told_archives_packages_and_what_to_leave_out(
    native: Board, calls: Path, tmp_path: Path
) -> None:
    build_rootfs(native, tmp_path / "cache", _EPOCH)
    ((words, environment, inputs),) = json.loads(calls.read_text())
    assert environment["SOURCE_DATE_EPOCH"] == str(_EPOCH)
    assert Path(environment["TMPDIR"]).parent == tmp_path / "cache"
    assert "--include=tool" in words and f"--architectures={native.architecture}" in words
    assert '--aptopt=APT::Install-Recommends "false"' in words
    rules = [word.removeprefix("--dpkgopt=") for word in words if word.startswith("--dpkgopt=")]
    document = "path-exclude=/usr/share/doc/*"
    licence = "path-include=/usr/share/doc/*/copyright"
    # dpkg goes by the last rule that fits.
    assert rules.index(document) < rules.index(licence)
    assert any("plugins.sh" in word and word.startswith("--customize-hook") for word in words)
    (sources,) = inputs.values()
    assert f"Signed-By: {native.archives[0].keyring}" in sources and "Trusted" not in sources


def test_a_build_that_fails_is_one_line_and_leaves_its_log_only(
    native: Board, calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAILS", "1")
    with pytest.raises(DeployError, match=r"^root file system of qemu: dpkg: it broke$"):
        build_rootfs(native, tmp_path / "cache", _EPOCH)
    assert _left(tmp_path / "cache") == []
    assert "E: dpkg: it broke" in (tmp_path / "cache/rootfs-qemu.log").read_text()
    monkeypatch.delenv("FAILS")
    build_rootfs(native, tmp_path / "cache", _EPOCH)
    assert len(_left(tmp_path / "cache")) == 1


def test_a_package_that_is_nowhere_is_said_before_the_minutes(
    native: Board, calls: Path, tmp_path: Path
) -> None:
    group = dataclasses.replace(native.packages[0], names=("tool", "gone"))
    with pytest.raises(DeployError, match="gone"):
        build_rootfs(dataclasses.replace(native, packages=(group,)), tmp_path / "cache", _EPOCH)
    assert not calls.exists()


def test_without_root_it_is_one_line(
    native: Board, calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(DeployError, match="is built as root: sudo"):
        build_rootfs(native, tmp_path / "cache", _EPOCH)
    assert not calls.exists() and _left(tmp_path / "cache") == []


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_stopped_or_killed_it_leaves_nothing_half_made(
    native: Board,
    calls: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    how: signal.Signals,
) -> None:
    """A second process waits for the first one's tar meanwhile, and then makes it."""
    if how == signal.SIGKILL:
        need_tools("setpriv")
    cache = tmp_path / "cache"

    def build() -> None:
        # A suite that runs in the background inherits an ignored SIGINT; a person's shell does not.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            build_rootfs(native, cache, _EPOCH)
        except KeyboardInterrupt:
            sys.exit(130)

    fork = multiprocessing.get_context("fork")
    first, second = fork.Process(target=build), fork.Process(target=build)
    monkeypatch.setenv("TAKES_S", "60")
    first.start()
    eventually(calls.exists)
    monkeypatch.delenv("TAKES_S")
    second.start()
    ((_, environment_of_first, _),) = json.loads(calls.read_text())
    assert first.pid is not None
    os.kill(first.pid, how)
    first.join(60)
    assert first.exitcode == (130 if how == signal.SIGINT else -how)
    # The tool doesn't outlive it.
    eventually(lambda: not Path(f"/proc/{environment_of_first['pid']}").exists())
    second.join(60)
    assert second.exitcode == 0
    made = _left(cache)
    assert len(made) == 1 and made == [build_rootfs(native, cache, _EPOCH).name]


def test_nothing_of_one_machine_s_own_goes_onto_all_cards(tmp_path: Path) -> None:
    own = (
        "etc/ssh/ssh_host_ed25519_key",
        "etc/hostname",
        "etc/resolv.conf",
        "etc/shadow-",
        "etc/apt/sources.list.d/0000board.sources",
        "var/lib/systemd/random-seed",
        "var/lib/dbus/machine-id",
        "var/log/apt/history.log",
        "var/cache/ldconfig/aux-cache",
        "var/lib/apt/lists/index",
        "var/lib/dpkg/status-old",
        "tmp/x",
    )
    kept = ("etc/ssh/moduli", "etc/shadow", "var/lib/dpkg/status", "usr/share/doc/a/copyright")
    root = tmp_path / "a root"
    for name in (*own, *kept, "etc/machine-id", "run/x", "var/tmp/y"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("of the builder")
    script = _ROOT / "deploy/image/packages/finish.sh"
    subprocess.run(["sh", str(script), str(root)], check=True)
    assert [name for name in own if (root / name).exists()] == []
    assert all((root / name).is_file() for name in kept)
    assert (root / "etc/machine-id").read_bytes() == b""
    assert (root / "var/log/apt").is_dir()
