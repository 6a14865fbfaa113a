"""Archives are trusted by their keys, and a board takes from one only what it means to."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from deploy.errors import DeployError
from deploy.image.packages import apt
from deploy.image.packages.board import Board, load_board, with_archives
from tests.deploy.image.local_archive import Key, LocalArchive

_ONLY = ("linux-image-*", "raspi-firmware")


@dataclasses.dataclass
class Shelf:
    """Debian's and Raspberry Pi's archive in small, and a board that knows both."""

    debian: LocalArchive
    pi: LocalArchive
    debian_key: Key
    pi_key: Key
    board: Board


@pytest.fixture
def shelf(tmp_path: Path, keys: tuple[Key, Key]) -> Shelf:
    debian = LocalArchive(tmp_path / "debian", "Debian")
    debian.add("tool", "1.0", depends="raspi-firmware")
    debian.add("raspi-firmware", "9.0")
    pi = LocalArchive(tmp_path / "pi", "Raspberry Pi Foundation")
    pi.add("tool", "2.0")
    pi.add("raspi-firmware", "1.0")
    pi.add("linux-image-rpi-v8", "1:6", depends="linux-image-6.12.1+rpt-rpi-v8")
    pi.add("linux-image-6.12.1+rpt-rpi-v8", "1:6")
    pi.add("desktop", "1.0")
    debian.publish(keys[0])
    pi.publish(keys[1])
    archives = (debian.archive("debian", keys[0]), pi.archive("pi", keys[1], _ONLY))
    board = dataclasses.replace(load_board("zero2w"), archives=archives)
    return Shelf(debian, pi, *keys, board)


def test_only_what_the_board_lists_comes_from_the_second_archive(shelf: Shelf) -> None:
    with apt.opened(shelf.board) as archives:
        plan = archives.plan(["tool", "linux-image-rpi-v8"])
        with pytest.raises(DeployError, match="desktop"):
            archives.plan(["desktop"])
    # The pinned one wins even where Debian's version is higher; a higher one elsewhere doesn't.
    installs = re.compile(r"^Inst (\S+) \((\S+) (.+?) \[[a-z0-9-]+\]\)", re.MULTILINE)
    found = sorted(installs.findall(plan))
    assert [(name, version) for name, version, _ in found] == [
        ("linux-image-6.12.1+rpt-rpi-v8", "1:6"),
        ("linux-image-rpi-v8", "1:6"),
        ("raspi-firmware", "1.0"),
        ("tool", "1.0"),
    ]
    origins = {name: origin for name, _, origin in found}
    assert origins["tool"].startswith("Debian")
    assert origins["raspi-firmware"].startswith("Raspberry Pi Foundation")


def test_a_package_arrives_as_it_was_signed(shelf: Shelf, tmp_path: Path) -> None:
    with apt.opened(shelf.board) as archives:
        kernel = archives.dependency("linux-image-rpi-v8", r"linux-image-\d\S*")
        assert kernel == "linux-image-6.12.1+rpt-rpi-v8"
        files = archives.download([kernel, "raspi-firmware"], tmp_path / "got")
    assert len(files) == 2
    sent = {deb.read_bytes() for deb in (shelf.pi.folder / "pool").glob("*.deb")}
    assert all(file.read_bytes() in sent for file in files)


@pytest.mark.parametrize("signer", ["another", "nobody", "changed"])
def test_an_index_that_the_key_did_not_sign_is_refused(shelf: Shelf, signer: str) -> None:
    if signer == "changed":
        index = shelf.pi.folder / "dists/trixie/InRelease"
        index.write_bytes(index.read_bytes().replace(b"Label: Raspberry", b"Label: Rhubarb"))
    else:
        shelf.pi.publish(shelf.debian_key if signer == "another" else None)
    with pytest.raises(DeployError) as caught, apt.opened(shelf.board):
        pass
    assert "zero2w" in str(caught.value) and "\n" not in str(caught.value)
    assert "/pi trixie" in str(caught.value)


def test_packages_that_are_not_the_index_s_are_refused(shelf: Shelf, tmp_path: Path) -> None:
    deb = shelf.pi.folder / "pool/raspi-firmware_1.0.deb"
    deb.write_bytes(deb.read_bytes()[:-1] + b"X")
    with apt.opened(shelf.board) as archives, pytest.raises(DeployError) as caught:
        archives.download(["raspi-firmware"], tmp_path / "got")
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "got").glob("*.deb"))


def test_a_trusted_archive_under_another_name_is_refused(shelf: Shelf) -> None:
    """Pins go by that name: under another one, everything would come from it."""
    shelf.pi.origin = "Elsewhere"
    shelf.pi.publish(shelf.pi_key)
    with (
        pytest.raises(DeployError, match="'Elsewhere', 'Raspberry Pi Foundation' was expected"),
        apt.opened(shelf.board),
    ):
        pass


def test_an_archive_without_address_or_keys_is_one_line(shelf: Shelf, tmp_path: Path) -> None:
    nowhere = with_archives(load_board("zero2w"), {"raspberrypi": {"url": ""}})
    with pytest.raises(DeployError, match="--archive raspberrypi=URL"):
        apt.sources(nowhere.archives[2:])
    lost = with_archives(shelf.board, {"pi": {"keyring": str(tmp_path / "lost.gpg")}})
    with pytest.raises(DeployError, match=r"archive pi: keyring .*lost\.gpg is not there"):
        apt.sources(lost.archives)
    bad = with_archives(shelf.board, {"pi": {"url": "file:///a\nTrusted: yes"}})
    with pytest.raises(DeployError, match="is no URL"):
        apt.sources(bad.archives)


def test_nothing_of_this_system_s_apt_is_touched(shelf: Shelf, tmp_path: Path) -> None:
    with apt.opened(shelf.board) as archives:
        root = archives._root
        assert (root / "var/lib/apt/lists").is_dir()
        text = archives._run("apt-config", "dump")
        folders = [line for line in text.splitlines() if line.startswith("Dir::State::status")]
        assert folders == [f'Dir::State::status "{root}/var/lib/dpkg/status";']
    assert not root.exists()
