"""The Zero W's card out of a base image that this test makes in the real one's layout."""

from __future__ import annotations

import json
import uuid

import pytest
from card_parts import EPOCH, ImageReader, needs_tools
from raspios_base import BOARD, make_base

from deploy.errors import DeployError
from deploy.image import card, ext4, raspios, sparse
from deploy.image.tree import Tree
from deploy.run import run

pytestmark = needs_tools


@pytest.fixture(scope="module", autouse=True)
def small_boot_partition():
    """What is tested here does not depend on its size, and hashing a real one's takes long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(card.BOOT_BYTES, "zerow", 40 << 20)
        yield


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return make_base(tmp_path_factory.mktemp("base") / "raspios.img")


@pytest.fixture(scope="module")
def packed(base):
    """As Raspberry Pi gives it; unpacked ones are in test_packages_base.py."""
    run(["xz", "-1", "--keep", base])
    return base.with_name(f"{base.name}.xz")


@pytest.fixture(scope="module")
def image(tmp_path_factory, packed, checkout):
    place = tmp_path_factory.mktemp("image") / "blimp-zerow.img"
    raspios.build(place, BOARD, packed, None, place.parent, checkout, EPOCH)
    return place


@pytest.fixture(scope="module")
def reader(image, tmp_path_factory):
    return ImageReader(image, tmp_path_factory.mktemp("parts"))


def test_the_card_has_the_layout_of_the_others(reader):
    assert [part["type"] for part in reader.table["partitions"]] == ["c", "83", "83"]
    reader.check()
    facts = reader.facts(reader.root)
    assert facts["Filesystem volume name"] == "blimp-root"
    assert f"root=UUID={facts['Filesystem UUID']}" in reader.boot_text("cmdline.txt")


def test_the_boot_partition_keeps_the_bases_first_stages_and_starts_ours(reader):
    names = reader.boot_names()
    assert {"kernel.img", "bootcode.bin", "start.elf", "overlays/disable-bt.dtbo"} <= names
    assert not names & {"initramfs", "issue.txt"}
    config = reader.boot_text("config.txt").splitlines()
    assert "kernel=kernel.img" in config and "initramfs initrd.img followkernel" in config
    assert "arm_64bit=1" not in config and "dtoverlay=disable-bt" in config
    assert "init=" not in reader.boot_text("cmdline.txt").replace("initrd", "")


def test_the_root_keeps_the_bases_files_and_takes_ours(reader, checkout):
    assert reader.read("usr/share/of-the-base") == "stays"
    assert reader.stat("usr/bin/ip")["mode"] == "04755", "an entry that was not touched"
    assert reader.stat("usr/share/über uns/a b.txt")["gid"] == "44"
    assert reader.read("etc/hostname") == "blimp\n", "replaced"
    assert json.loads(reader.read("usr/share/blimp/board.json"))["board"] == "zerow"
    ours = reader.stat("usr/lib/blimp/release/pi_firmware/__main__.py")
    assert (ours["uid"], ours["gid"], ours["mode"]) == ("0", "0", "0644")
    assert ours["mtime"].startswith(f"{EPOCH:#x}")
    wants = "etc/systemd/system/multi-user.target.wants"
    assert reader.exists(f"{wants}/blimp-payload.service")
    assert not reader.exists(f"{wants}/NetworkManager.service")
    assert not reader.exists("etc/ssh/ssh_host_ed25519_key")


def test_the_base_is_named_in_the_manifest(image, packed):
    document = json.loads(card.beside(image, ".manifest.json").read_text())
    assert document["base"] == {"name": "raspios.img.xz", "sha256": sparse.sha256(packed)}
    assert "gstreamer1.0-libcamera" in {row["name"] for row in document["packages"]}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"codename": "bookworm"}, "of 'bookworm'; expected 'trixie'"),
        ({"architecture": "arm64"}, "for arm64; expected armhf"),
        ({"parts": 1}, "partitions of type c; expected c and 83"),
        ({"kernel": "6.12.1+rpt-rpi-v7"}, "one kernel .* expected, there: 6.12.1.rpt-rpi-v7"),
        (
            {"without": "busybox-static", "identifier": "debian"},
            "install there first: busybox-static$",
        ),
    ],
)
def test_another_base_is_refused_by_what_it_is(changes, says, checkout, tmp_path):
    base = make_base(tmp_path / "other.img", **changes)
    place = tmp_path / "out/blimp-zerow.img"
    with pytest.raises(DeployError, match=says) as failure:
        raspios.build(place, BOARD, base, None, place.parent, checkout, EPOCH)
    assert "\n" not in str(failure.value) and str(base) in str(failure.value)
    assert list(place.parent.iterdir()) == []


def test_a_base_that_is_cut_or_none_is_refused(base, checkout, tmp_path):
    cut = tmp_path / "cut.img"
    cut.write_bytes(base.read_bytes()[: 80 << 20])
    text = tmp_path / "text.img"
    text.write_text("no image")
    for place, says in (
        (cut, "cut at 83886080 of"),
        (text, "no partition table of a Raspberry Pi OS image"),
        (tmp_path / "none.img", "no such image"),
    ):
        with pytest.raises(DeployError, match=says):
            raspios.build(tmp_path / "out.img", BOARD, place, None, tmp_path, checkout, EPOCH)
        assert not (tmp_path / "out.img").exists()


def test_a_root_with_too_few_inodes_gets_more(tmp_path):
    """Of small files a base has room for the bytes long before it has inodes for the number."""
    place, tree = tmp_path / "root", Tree()
    ext4.make(place, 48 << 20, tree, "rootfs", uuid.UUID(int=1), EPOCH, journal=True)
    before = int(ext4.facts(place)["Free inodes"])
    for number in range(before + 100):
        tree.write(f"{number:04d}", "x")
    raspios._grow(place, tree, EPOCH)
    assert int(ext4.facts(place)["Free inodes"]) >= len(tree)
    ext4.fill(place, tree, EPOCH)
