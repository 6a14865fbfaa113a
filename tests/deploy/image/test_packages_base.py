"""What a base image lacks is installed by its own apt from a signed archive, once, and only that.

The base holds this machine's own programs, so that nothing is emulated and no minutes are spent;
that armhf's programs run emulated is the other boards' machinery (test_packages_programs.py).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import http.server
import json
import multiprocessing
import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from card_parts import EPOCH, ImageReader, needs_tools
from native_root import add_programs
from raspios_base import make_tree, write_base
from waiting import eventually

from deploy.errors import DeployError
from deploy.image import card, raspios, sparse
from deploy.image.packages import apt, base
from deploy.image.packages.board import Board, Group, load_board
from deploy.run import run
from tests.deploy.image.local_archive import Key, LocalArchive, need_tools

pytestmark = [pytest.mark.skipif(os.geteuid() != 0, reason="a chroot is root's"), needs_tools]

_ROOT = Path(__file__).parents[3]
_PYC = "usr/lib/python3/dist-packages/__pycache__/tool.cpython-313.pyc"
_GSTREAMER = "usr/lib/any/gstreamer-1.0"
# Writes down which plugins are there, where GStreamer would write what it learnt of them.
_PYTHON = f'#!/bin/sh\necho /{_GSTREAMER}/* >"$GST_REGISTRY"\n'.encode()
_POSTINST = """\
chown 1:44 /usr/bin/tool
chmod 4755 /usr/bin/tool
chmod 755 /usr/bin/python3
mkdir /var/lib/tool
chown 1:44 /var/lib/tool
chmod 2770 /var/lib/tool
ln -s /usr/bin/tool /usr/bin/also
[ -z "$TMPDIR$PYTHONPATH" ] || exit 1
touch /etc/ssh/ssh_host_rsa_key /var/cache/tool /tmp/tool
if sh /usr/sbin/policy-rc.d tool start; then exit 1; else [ $? = 101 ]; fi
"""


class _Silent(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        pass


@contextlib.contextmanager
def _served(folder: Path) -> Iterator[str]:
    """A folder on the loopback, by HTTP: what a chroot reaches."""
    handler = functools.partial(_Silent, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@dataclasses.dataclass
class Stand:
    """A base that lacks two packages, and the archive that its sources name."""

    board: Board
    archive: LocalArchive
    key: Key
    base: Path
    checkout: Path

    def build(self, image: Path, cache: Path) -> list[str]:
        said: list[str] = []
        raspios.build(image, self.board, self.base, None, cache, self.checkout, EPOCH, said.append)
        return said


@pytest.fixture(scope="module")
def stand(
    tmp_path_factory: pytest.TempPathFactory, checkout: Path, keys: tuple[Key, Key]
) -> Iterator[Stand]:
    need_tools("dpkg", "unshare")
    if subprocess.run(["unshare", "--mount", "true"], check=False, capture_output=True).returncode:
        pytest.skip("no mount namespace may be made here")
    architecture = run(["dpkg", "--print-architecture"]).decode().strip()
    folder, key = tmp_path_factory.mktemp("stand"), keys[0]
    board = dataclasses.replace(
        load_board("zerow"),
        architecture=architecture,
        packages=(Group("for a test", ("base-files", "helper", "tool")),),
    )
    with _served(folder / "archive") as url, pytest.MonkeyPatch.context() as patch:
        # Small, and no waiting for an archive that was taken away on purpose.
        patch.setitem(card.BOOT_BYTES, "zerow", 40 << 20)
        # Of this machine, and nowhere in the base.
        patch.setenv("TMPDIR", str(folder))
        patch.setattr(apt, "SETTINGS", apt.SETTINGS + 'Acquire::Retries "0";\n')
        archive = LocalArchive(folder / "archive", "Base", architecture)
        archive.add("helper", "1.5", {"usr/share/helper": b"helps"})
        archive.add(
            "tool",
            "2.0-1",
            {
                "usr/bin/tool": b"#!/bin/sh\n",
                "usr/bin/python3": _PYTHON,
                f"{_GSTREAMER}/libgstapp.so": b"stays",
                f"{_GSTREAMER}/libgstrealmedia.so": b"no pipeline names it",
                "usr/share/doc/tool/README": b"to read",
                "usr/share/doc/tool/copyright": b"free",
                "etc/tool.conf": b"set\n",
                _PYC: b"3.13" + bytes(4) + b"timesizecode",
            },
            depends="helper",
            conflicts="rival",
            postinst=_POSTINST,
        )
        archive.publish(key)
        tree = make_tree(folder / "work", architecture)
        add_programs(tree)
        for name in ("usr/bin/busybox", "usr/lib/systemd/systemd"):
            tree.write(name, "no ELF file", 0o755)
        tree.write("usr/share/keyrings/base.gpg", key.public.read_bytes())
        tree.write(
            "etc/apt/sources.list.d/base.sources",
            f"Types: deb\nURIs: {url}\nSuites: trixie\nComponents: main\n"
            "Signed-By: /usr/share/keyrings/base.gpg\n",
        )
        status = tree.read("var/lib/dpkg/status").decode()
        status += "\nPackage: rival\nStatus: install ok installed\nMaintainer: A <a@example.org>\n"
        status += f"Architecture: {architecture}\nVersion: 1\nDescription: in the way\n"
        tree.write("var/lib/dpkg/status", status)
        tree.write("var/lib/dpkg/info/rival.list", "/.\n/usr\n/usr/bin\n/usr/bin/rival\n")
        tree.write("var/lib/dpkg/available", "")
        tree.write("usr/bin/rival", "in the way", 0o755)
        tree.folder("usr/lib/tmpfiles.d", 0o1777, 2, 3)
        image = write_base(folder / "raspios.img", tree, 160 << 20)
        yield Stand(board, archive, key, image, checkout)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def image(stand: Stand, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("image") / "blimp-zerow.img"
    said = stand.build(place, cache)
    assert any("2 packages that the base lacks" in line for line in said)
    return place


@pytest.fixture(scope="module")
def reader(image: Path, tmp_path_factory: pytest.TempPathFactory) -> ImageReader:
    return ImageReader(image, tmp_path_factory.mktemp("parts"))


def _kept(cache: Path) -> list[str]:
    return sorted(path.name for path in cache.iterdir() if path.suffix not in (".lock", ".log"))


def test_what_was_missing_is_on_the_card_as_its_packages_made_it(reader: ImageReader) -> None:
    tool = reader.stat("usr/bin/tool")
    assert (tool["mode"], tool["uid"], tool["gid"]) == ("04755", "1", "44")
    folder = reader.stat("var/lib/tool")
    assert (folder["mode"], folder["uid"], folder["gid"]) == ("02770", "1", "44")
    assert reader.stat("usr/bin/also")["target"] == "/usr/bin/tool"
    assert reader.read("usr/share/helper") == "helps" and reader.read("etc/tool.conf") == "set\n"
    # dpkg had its rival make room; the board's own list leaves documents out.
    assert not reader.exists("usr/bin/rival")
    assert not reader.exists("usr/share/doc/tool/README")
    assert reader.read("usr/share/doc/tool/copyright") == "free"
    assert reader.read(_PYC).encode() == b"3.13\1\0\0\0" + bytes(8) + b"code"
    reader.check()


def test_the_plugins_that_stay_are_listed_by_the_card_s_own_programs(reader: ImageReader) -> None:
    listed = "usr/share/blimp/gstreamer-registry.bin"
    assert reader.read(listed) == f"/{_GSTREAMER}/libgstapp.so\n"
    assert reader.stat(listed)["mode"] == "0644"
    # GStreamer believes it of plugins of the same time, which no image may have to clamp.
    plugin = reader.stat(f"{_GSTREAMER}/libgstapp.so")
    assert int(plugin["mtime"].partition(":")[0], 16) == 315_532_800  # 1980
    root = _ROOT / "deploy/board/root/usr/lib"
    (line,) = [
        line.split()
        for line in (root / "blimp/data.conf").read_text().splitlines()
        if listed in line
    ]
    assert line[0] == "C" and line[-1] == f"/{listed}"  # unless the payload has written its own
    assert (
        f"GST_REGISTRY={line[1]}\n" in (root / "systemd/system/blimp-payload.service").read_text()
    )


def test_what_the_base_had_is_untouched(stand: Stand, reader: ImageReader, tmp_path: Path) -> None:
    table = json.loads(run(["sfdisk", "--json", stand.base]))["partitiontable"]["partitions"]
    place = tmp_path / "root"
    with open(stand.base, "rb") as file:
        file.seek(table[1]["start"] * 512)
        place.write_bytes(file.read(table[1]["size"] * 512))
    same = ["usr/bin/ip", "usr/share/of-the-base", "usr/share/über uns/a b.txt", "usr/bin/apt-get",
            "usr/bin/iw", "usr/lib/tmpfiles.d", "usr/sbin", "root",
            "etc/apt/sources.list.d/base.sources"]  # fmt: skip

    def facts(part: Path, path: str) -> str:
        said = reader.debugfs(f'stat "/{path}"', part)
        # Not when it was looked at or given another name: inode, modes, owners, size, time, blocks.
        lines = said.splitlines()
        return "\n".join(line for line in lines if line.lstrip()[:6] not in ("ctime:", "atime:"))

    for path in same:
        before, after = facts(place, path), facts(reader.root, path)
        if path == "usr/sbin":  # a folder keeps its owner and mode; what is in it changes
            before, after = before.splitlines()[1], after.splitlines()[1]
        assert before == after, path
    assert "security.capability" in reader.debugfs('ea_list "/usr/bin/iw"')


def test_nothing_of_the_work_is_left(reader: ImageReader) -> None:
    for path in ("usr/sbin/policy-rc.d", "etc/apt/apt.conf.d/zz-blimp", "etc/ssh/ssh_host_rsa_key",
                 "var/cache/tool", "var/cache/apt", "var/lib/apt/lists", "var/lib/dpkg/status-old",
                 "tmp/tool", "dev/null"):  # fmt: skip
        assert not reader.exists(path), path
    assert reader.read("etc/hostname") == "blimp\n"


def test_the_manifest_has_the_versions_that_came_and_the_base_as_it_still_is(
    stand: Stand, image: Path
) -> None:
    document = json.loads(card.beside(image, ".manifest.json").read_text())
    assert document["base"] == {"name": stand.base.name, "sha256": sparse.sha256(stand.base)}
    versions = {row["name"]: row["version"] for row in document["packages"]}
    assert (versions["tool"], versions["helper"]) == ("2.0-1", "1.5")
    assert "rival" not in versions


def test_the_second_build_needs_neither_archive_nor_root_and_is_the_same(
    stand: Stand, image: Path, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = _kept(cache)
    assert len(kept) == 1
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(base, "run_long", None)
    again = tmp_path / image.name
    stand.build(again, cache)
    assert card.beside(again, ".sha256").read_text() == card.beside(image, ".sha256").read_text()
    assert _kept(cache) == kept


def test_without_root_it_is_one_line(
    stand: Stand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(DeployError, match="added to a base as root: sudo"):
        stand.build(tmp_path / "out/x.img", tmp_path / "cache")
    assert _kept(tmp_path / "cache") == [] and list((tmp_path / "out").iterdir()) == []


@contextlib.contextmanager
def _broken(stand: Stand, how: str, another: Key) -> Iterator[None]:
    """The archive with something wrong with it, as long as the block lasts."""
    index = stand.archive.folder / "dists/trixie/InRelease"
    if how == "another":
        stand.archive.publish(another)
    else:
        index.parent.rename(index.parent.with_name("away"))
    try:
        yield
    finally:
        if how == "away":
            index.parent.with_name("away").rename(index.parent)
        stand.archive.publish(stand.key)


@pytest.mark.parametrize("how", ["another", "away"])
def test_an_archive_out_of_reach_or_not_signed_by_its_key_is_one_line(
    stand: Stand, keys: tuple[Key, Key], how: str, tmp_path: Path
) -> None:
    with (
        _broken(stand, how, keys[1]),
        pytest.raises(DeployError, match=r"^packages of zerow: .*127\.0\.0\.1") as caught,
    ):
        stand.build(tmp_path / "out/x.img", tmp_path / "cache")
    assert "\n" not in str(caught.value)
    assert _kept(tmp_path / "cache") == [] and list((tmp_path / "out").iterdir()) == []
    assert (tmp_path / "cache/base-zerow.log").stat().st_size > 0


def test_a_package_that_is_nowhere_is_named(stand: Stand, tmp_path: Path) -> None:
    packages = (Group("for a test", ("tool", "no-such-thing")),)
    other = dataclasses.replace(stand, board=dataclasses.replace(stand.board, packages=packages))
    with pytest.raises(DeployError, match="Unable to locate package no-such-thing"):
        other.build(tmp_path / "out/x.img", tmp_path / "cache")
    assert _kept(tmp_path / "cache") == []


def test_a_disk_without_room_is_told_before_the_work(
    stand: Stand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(base, "_ROOM_BYTES", 1 << 60)
    with pytest.raises(DeployError, match=r"cache: \d+ MiB free; .* need \d+ MiB$"):
        stand.build(tmp_path / "out/x.img", tmp_path / "cache")
    assert _kept(tmp_path / "cache") == []


def test_killed_in_the_middle_nothing_half_is_left(
    stand: Stand, image: Path, cache: Path, tmp_path: Path
) -> None:
    """apt and what it runs end, too; what was kept stays whole; the next build makes the layer."""
    need_tools("setpriv")
    name = "slow"
    stand.archive.add(name, "1", postinst="touch /tmp/here; sleep 300")
    stand.archive.publish(stand.key)
    kept = {path: path.read_bytes() for path in cache.glob("*.tar")}
    place = tmp_path / "x.img"
    packages = (Group("for a test", (name,)),)
    other = dataclasses.replace(stand, board=dataclasses.replace(stand.board, packages=packages))
    process = multiprocessing.get_context("fork").Process(target=other.build, args=(place, cache))
    process.start()
    try:
        here = ".base-*.part-*/root/tmp/here"
        eventually(lambda: list(cache.glob(here)) or not process.is_alive())
        (work,) = cache.glob(".base-*.part-*")
    finally:
        process.kill()
        process.join(60)
        assert process.exitcode == -signal.SIGKILL
    eventually(lambda: not _inside(work))
    assert {path: path.read_bytes() for path in cache.glob("*.tar")} == kept
    assert not place.exists() and work.exists()
    stand.archive.add(name, "2")
    stand.archive.publish(stand.key)
    other.build(place, cache)
    assert len(_kept(cache)) == len(kept) + 1 and not work.exists()


def _inside(root: Path) -> list[int]:
    """The processes whose root lies in a folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*/root"):
        with contextlib.suppress(OSError):
            if str(path.readlink()).startswith(str(root)):
                found.append(int(path.parent.name))
    return found
