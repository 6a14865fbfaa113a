"""A whole card from small ingredients, read back with the tools of others."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from card_parts import (
    CAPABILITY,
    EPOCH,
    RELEASE,
    ImageReader,
    build,
    make_ingredients,
    needs_tools,
)

from deploy.errors import DeployError
from deploy.image import __main__ as command
from deploy.image import card, sparse
from deploy.provisioning.text import parse
from deploy.run import run

pytestmark = needs_tools


@pytest.fixture(scope="module")
def image(tmp_path_factory, checkout):
    folder = tmp_path_factory.mktemp("image")
    place = folder / "out/blimp-qemu.img"
    build(place, make_ingredients(folder / "in"), checkout, EPOCH)
    return place


@pytest.fixture(scope="module")
def reader(image, tmp_path_factory):
    return ImageReader(image, tmp_path_factory.mktemp("parts"))


def test_three_partitions_that_begin_at_whole_erase_units(image, reader):
    parts = reader.table["partitions"]
    assert [part["type"] for part in parts] == ["c", "83", "83"]
    assert all(part["start"] * 512 % (4 << 20) == 0 for part in parts)
    assert parts[0]["bootable"] and reader.table["label"] == "dos"
    size = image.stat().st_size
    assert size & (size - 1) == 0, "QEMU takes cards of a power of two"


def test_file_systems_are_clean_and_named_as_fstab_and_the_kernel_line_name_them(reader):
    reader.check()
    labels = {reader.facts(part)["Filesystem volume name"] for part in (reader.root, reader.data)}
    assert labels == {"blimp-root", "blimp-data"}
    assert reader.boot.read_bytes()[71:82] == b"BLIMPBOOT  "
    mounted = {
        line.split()[0] for line in reader.read("etc/fstab").splitlines() if line[:5] == "LABEL"
    }
    assert mounted == {"LABEL=blimp-data", "LABEL=BLIMPBOOT"}
    assert f"root=UUID={reader.facts(reader.root)['Filesystem UUID']}" in reader.boot_text(
        "cmdline.txt"
    )
    assert "has_journal" in reader.facts(reader.data)["Filesystem features"]
    assert "has_journal" not in reader.facts(reader.root)["Filesystem features"]


def test_the_boot_partition_has_what_the_first_stages_read(reader):
    names = reader.boot_names()
    assert {"vmlinuz", "bcm2837-rpi-3-b.dtb", "overlays/disable-bt.dtbo", "initrd.img"} <= names
    assert {"config.txt", "cmdline.txt", "blimp/blimp-example.toml", "blimp/README.txt"} <= names
    assert "blimp/blimp.toml" not in names, "nobody has provisioned it"
    config = reader.boot_text("config.txt").splitlines()
    for line in ("kernel=vmlinuz", "initramfs initrd.img followkernel", "camera_auto_detect=1",
                 "dtparam=i2c_arm=on", "enable_uart=1", "dtoverlay=disable-bt",
                 "dtparam=watchdog=on"):  # fmt: skip
        assert line in config
    words = reader.boot_text("cmdline.txt").split()
    assert {"ro", "panic=10", "rootfstype=ext4"} <= set(words)
    assert not any(word.startswith(("console=serial", "console=ttyAMA")) for word in words)


def test_the_example_on_the_boot_partition_is_a_valid_provisioning(reader):
    text = reader.boot_text("blimp/blimp-example.toml")
    assert parse(text.encode()).payload_id == "blimp-1"


def test_owners_modes_times_and_capabilities_are_the_tars(reader):
    assert reader.stat("usr/bin/ip")["mode"] == "04755"
    assert reader.stat("tmp")["mode"] == "01777" and reader.stat("root")["mode"] == "0700"
    odd = reader.stat("usr/share/über uns/a b.txt")
    assert (odd["uid"], odd["gid"]) == ("1", "44")
    assert reader.read("usr/share/über uns/a b.txt") == "übrig"
    assert reader.stat("lib")["target"] == "usr/lib"
    older, newer = reader.stat("usr/lib/os-release"), reader.stat("usr/bin/busybox")
    assert older["mtime"].startswith(f"{1_700_000_000:#x}")
    assert newer["mtime"].startswith(f"{EPOCH:#x}"), "nothing is younger than the epoch"
    clock = reader.stat("usr/lib/clock-epoch")
    assert clock["mtime"] == newer["mtime"], "where the clock of a board without one starts"
    said = reader.debugfs('ea_get -x "/usr/bin/iw" security.capability')
    assert CAPABILITY.hex() in said.replace(" ", "")


def test_firmware_wheels_programs_and_board_are_in_their_places(reader, checkout):
    release = json.loads(reader.read("usr/lib/blimp/release/release.json"))
    assert release["schema"] == "blimp.release/1" and release["machine"] == "aarch64"
    assert release["version"].startswith("0.") and ".dirty" not in release["version"]
    firmware = reader.read("usr/lib/blimp/release/pi_firmware/__main__.py")
    assert firmware == (checkout / "pi_firmware/__main__.py").read_text()
    assert reader.read("usr/lib/blimp/release/site/mcap/__init__.py") == "x = 1\n"
    for name in ("__init__.py", "errors.py", "board/start.py", "provisioning/__init__.py"):
        assert reader.exists(f"usr/lib/blimp/deploy/{name}")
    for name in ("image", "flash", "board/root"):
        assert not reader.exists(f"usr/lib/blimp/deploy/{name}")
    assert json.loads(reader.read("usr/share/blimp/board.json"))["board"] == "qemu"
    settings = (checkout / "deploy/board/payload/qemu.toml").read_text()
    assert reader.read("usr/share/blimp/payload.toml") == settings
    assert reader.stat("etc/sudoers.d/blimp")["mode"] == "0440"
    assert reader.stat("data")["type"] == reader.stat("boot/firmware")["type"] == "directory"


def test_no_account_has_a_password_or_an_empty_one(reader):
    passwd, shadow = reader.rows("etc/passwd"), reader.rows("etc/shadow")
    assert set(passwd) == set(shadow)
    assert all(row[1] == "x" for row in passwd.values())
    assert all(row[1] == "*" and row[2] == "" for row in shadow.values())
    assert "$6$" not in reader.read("etc/shadow") + reader.read("etc/gshadow")
    shadow_file = reader.stat("etc/shadow")
    assert (shadow_file["mode"], shadow_file["uid"], shadow_file["gid"]) == ("0640", "0", "42")
    assert passwd["blimp"][2:4] == ["901", "901"] and passwd["pilot"][2:4] == ["1000", "1000"]
    assert "somebody" not in passwd, "a person of the base"
    groups = reader.rows("etc/group")
    assert all("blimp" in groups[name][3] for name in ("video", "i2c", "dialout"))


def test_what_is_of_one_machine_or_day_is_not_on_the_card(reader):
    for path in ("etc/ssh/ssh_host_ed25519_key", "etc/passwd-", "var/log/dpkg.log", "dev/null",
                 "var/cache/apt"):  # fmt: skip
        assert not reader.exists(path), path


def test_units_are_enabled_by_the_preset_alone(reader):
    wants = "etc/systemd/system/multi-user.target.wants"
    assert reader.stat(f"{wants}/blimp-payload.service")["target"] == (
        "/usr/lib/systemd/system/blimp-payload.service"
    )
    assert reader.exists(f"{wants}/systemd-networkd.service")
    assert reader.exists("etc/systemd/system/sockets.target.wants/systemd-networkd.socket")
    assert reader.exists("etc/systemd/system/dbus-net.service")
    assert not reader.exists(f"{wants}/other.service"), "another's preset comes after ours"
    assert reader.stat("etc/systemd/system/getty@.service")["target"] == "/dev/null"


@pytest.fixture(scope="module")
def unpacked(reader, tmp_path_factory):
    """The image's root as a folder, without owners."""
    folder = tmp_path_factory.mktemp("root")
    reader.debugfs(f"rdump / {folder}")
    return folder


def test_systemctl_would_enable_the_same(unpacked, tmp_path):
    systemctl = shutil.which("systemctl")
    if systemctl is None:
        pytest.skip("no systemctl here")
    root = tmp_path / "root"
    shutil.copytree(unpacked, root, symlinks=True)

    def links() -> dict[str, str]:
        enabled = root / "etc/systemd/system"
        return {
            str(path.relative_to(enabled)): Path(str(path.readlink())).name
            for path in sorted(enabled.rglob("*"))
            if path.is_symlink()
        }

    ours = links()
    done = subprocess.run(
        [systemctl, f"--root={root}", "preset-all"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    # The default target, too, falls to `disable *`; ours stays.
    assert links() | {"default.target": "multi-user.target"} == ours


def test_the_initrd_loads_modules_in_the_order_of_their_dependencies(reader, tmp_path):
    archive = tmp_path / "initrd"
    reader._run("mcopy", "-n", "-i", str(reader.boot), "::initrd.img", str(archive))
    packed = gzip.decompress(archive.read_bytes())
    listed = run(["cpio", "-i", "--to-stdout", "--quiet", "modules/*", "init"], input=packed)
    names = run(["cpio", "-t", "--quiet"], input=packed).decode().split()
    modules = [name.partition("-")[2] for name in names if name.startswith("modules/")]
    assert modules == ["crc32c_generic.ko", "crc16.ko", "jbd2.ko", "ext4.ko"]
    assert f"ext4 of {RELEASE}".encode() in listed, "unpacked for insmod"
    assert "init" in names and "bin/busybox" in names and "bin/switch_root" in names


def test_manifest_checksum_and_block_map_are_of_this_image(image, reader):
    digest = hashlib.sha256(image.read_bytes()).hexdigest()
    assert card.beside(image, ".sha256").read_text() == f"{digest}  {image.name}\n"
    document = json.loads(card.beside(image, ".manifest.json").read_text())
    assert document["image"] == {"size": image.stat().st_size, "sha256": digest}
    assert document["packages"] == [
        {"name": "base-files", "version": "13.8", "architecture": "arm64"}
    ]
    assert {"name": "mcap", "version": "1.2.0"}.items() <= document["wheels"][0].items()
    assert document["epoch"] == EPOCH and len(document["revision"]) == 40
    assert "blimp-payload.service" in document["units"]
    hashes = [hashlib.sha256(part.read_bytes()).hexdigest() for part in reader.parts]
    assert [part["sha256"] for part in document["partitions"]] == hashes
    assert all(document["tools"].values()) and "4." in document["tools"]["mkfs.vfat"]


def test_a_card_that_held_something_else_is_whole_after_its_mapped_blocks_are_written(
    image, tmp_path
):
    used = tmp_path / "used-card"
    used.write_bytes(b"\xa5" * image.stat().st_size)
    bmap = card.beside(image, ".bmap")
    subprocess.run(["bmaptool", "-q", "copy", "--bmap", bmap, image, used], check=True)
    reader = ImageReader(used, tmp_path / "parts")
    reader.check()
    reader.debugfs(f"dump <8> {tmp_path / 'journal'}", reader.data)
    journal = (tmp_path / "journal").read_bytes()
    assert len(journal) >= 4 << 20
    assert b"\xa5" * 16 not in journal, "an old journal would be played back after a power cut"


def test_the_image_is_stored_without_its_empty_parts(image):
    assert image.stat().st_blocks * 512 < image.stat().st_size / 3


_TABLES = f"modules/usr/lib/modules/{RELEASE}"


@pytest.mark.parametrize(
    ("path", "harm", "says"),
    [
        ("root.tar", lambda file: os.truncate(file, file.stat().st_size // 2), "no readable tar"),
        ("root.tar", Path.unlink, "no readable tar"),
        ("boot/vmlinuz", Path.unlink, "no kernel 'vmlinuz'"),
        (f"{_TABLES}/modules.dep", Path.unlink, "no modules.dep"),
        (
            f"{_TABLES}/modules.builtin",
            lambda file: os.truncate(file, 0),
            "no overlay, neither as a module nor built in",
        ),
        (
            "boot/vmlinuz",
            lambda file: os.truncate(file, 70 << 20),
            r"BLIMPBOOT: contents need \d+ MiB and get 64 MiB",
        ),
    ],
)
def test_what_is_broken_or_too_big_is_one_line_and_the_old_image_stays(
    path, harm, says, checkout, tmp_path
):
    place = tmp_path / "out/blimp-qemu.img"
    place.parent.mkdir()
    place.write_bytes(b"the old one")
    given = make_ingredients(tmp_path / "in")
    harm(tmp_path / "in" / path)
    with pytest.raises(DeployError, match=says) as failure:
        build(place, given, checkout, EPOCH)
    assert "\n" not in str(failure.value)
    assert place.read_bytes() == b"the old one"
    assert list(place.parent.iterdir()) == [place], "nothing half-made is left"


def test_a_tool_that_fails_in_the_midst_leaves_nothing(checkout, tmp_path, monkeypatch):
    place = tmp_path / "out/blimp-qemu.img"
    tools = tmp_path / "tools"
    tools.mkdir()
    (tools / "bmaptool").write_text("#!/bin/sh\necho 'No space left on device' >&2\nexit 1\n")
    (tools / "bmaptool").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    with pytest.raises(DeployError, match=r"^bmaptool: No space left on device$"):
        build(place, make_ingredients(tmp_path / "in"), checkout, EPOCH)
    assert list(place.parent.iterdir()) == []


def test_one_build_at_a_time_and_what_a_killed_one_left_goes(tmp_path):
    image = tmp_path / "out/blimp-qemu.img"
    left = tmp_path / "out/.blimp-qemu.img.part-killed"
    left.mkdir(parents=True)
    (left / "root").write_bytes(b"half")
    with card.building(image) as work:
        assert not left.exists() and work.is_dir()
        with pytest.raises(DeployError, match="another image is being built"), card.building(image):
            pass
        assert work.is_dir()
        for suffix in ("", *card.DESCRIPTIONS):
            card.beside(work / image.name, suffix).write_bytes(b"whole")
    assert {path.name for path in image.parent.iterdir()} == {
        card.beside(image, suffix).name for suffix in ("", *card.DESCRIPTIONS)
    }


def test_the_command_makes_of_packages_kernel_and_wheels_the_same_image(
    image, checkout, tmp_path, monkeypatch, capsys
):
    """The same inputs give the same bytes, whatever order and mode their files came in."""
    umask = os.umask(0o077)
    given = make_ingredients(tmp_path / "in", reverse=True)
    compiled = []
    monkeypatch.setattr(command, "_CHECKOUT", checkout)
    monkeypatch.setattr(command, "fetch_wheels", lambda board, cache: given.site)
    monkeypatch.setattr(command, "unpack_kernel", lambda board, cache: given.kernel)
    monkeypatch.setattr(command, "build_rootfs", lambda board, cache, epoch: given.rootfs)
    monkeypatch.setattr(command, "byte_compile", lambda *given: compiled.append(given[3]))
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    try:
        assert command.main(["--board", "qemu"]) == 0
    finally:
        os.umask(umask)
    place = checkout / "out/image/blimp-qemu.img"
    said = capsys.readouterr()
    assert said.out == f"{place}\n" and "root partition" in said.err
    assert compiled == ["/usr/lib/blimp"]
    assert sparse.sha256(place) == sparse.sha256(image), "the epoch is the last commit's time"
    for suffix in card.DESCRIPTIONS:
        assert card.beside(place, suffix).read_text() == card.beside(image, suffix).read_text()


def test_a_time_that_fat_cannot_tell_is_refused(checkout, tmp_path):
    with pytest.raises(DeployError, match="--epoch 0: allowed: 315532800 to 4354819199"):
        build(tmp_path / "x.img", make_ingredients(tmp_path / "in"), checkout, 0)
