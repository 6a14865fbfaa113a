"""A kernel is unpacked from its signed package: boot files, modules with what they need."""

from __future__ import annotations

import dataclasses
import shutil
import struct
from pathlib import Path

import pytest

from deploy.errors import DeployError
from deploy.image.packages.board import Board, load_board
from deploy.image.packages.kernel import unpack_kernel, with_dependencies
from tests.deploy.image.local_archive import Key, LocalArchive, need_tools

_VERSION = "6.12.1+rpt-rpi-v8"
_TREES = f"usr/lib/linux-image-{_VERSION}"
_MODULES = f"lib/modules/{_VERSION}"


def _module(information: bytes) -> bytes:
    """An ELF64 object with a `.modinfo` section and nothing else: what depmod reads of a module."""
    names = b"\0.modinfo\0.shstrtab\0"
    body = information + names
    header = struct.pack(
        "<4sBBBB8xHHIQQQIHHHHHH",
        *(b"\x7fELF", 2, 1, 1, 0),
        *(1, 183, 1, 0, 0, 64 + len(body), 0, 64, 0, 0, 64, 3, 2),
    )
    section = struct.Struct("<IIQQQQIIQQ")
    return (
        header
        + body
        + section.pack(*([0] * 10))
        + section.pack(1, 1, 2, 0, 64, len(information), 0, 0, 1, 0)
        + section.pack(10, 3, 0, 0, 64 + len(information), len(names), 0, 0, 1, 0)
    )


def _packages(archive: LocalArchive) -> None:
    archive.add("linux-image-rpi-v8", "1:6", depends=f"linux-image-{_VERSION}")
    archive.add(
        f"linux-image-{_VERSION}",
        "1:6",
        {
            f"boot/vmlinuz-{_VERSION}": b"KERNEL",
            f"{_TREES}/broadcom/bcm2710-rpi-zero-2-w.dtb": b"TREE",
            f"{_TREES}/broadcom/bcm2712-rpi-5-b.dtb": b"OTHER",
            f"{_TREES}/overlays/disable-bt.dtbo": b"OVERLAY",
            f"{_TREES}/overlays/README": b"TEXT",
            f"{_MODULES}/kernel/fs/overlay.ko": _module(b"name=overlay\0depends=\0"),
            f"{_MODULES}/kernel/net/wifi.ko": _module(b"name=wifi\0alias=pci:v1*\0depends=\0"),
            f"{_MODULES}/modules.builtin": b"kernel/fs/ext4/ext4.ko\n",
            f"{_MODULES}/modules.order": b"kernel/fs/overlay.ko\nkernel/net/wifi.ko\n",
            f"usr/share/doc/linux-image-{_VERSION}/copyright": b"GPL-2",
        },
    )
    archive.add(
        "raspi-firmware",
        "1:20260101",
        {
            "usr/lib/raspi-firmware/bootcode.bin": b"FIRST",
            "usr/lib/raspi-firmware/start.elf": b"START",
            "usr/lib/raspi-firmware/fixup.dat": b"FIXUP",
            "usr/share/doc/raspi-firmware/copyright": b"may be given away",
        },
    )


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory, keys: tuple[Key, Key]) -> Board:
    need_tools("depmod")
    archive = LocalArchive(tmp_path_factory.mktemp("archive") / "pi", "Raspberry Pi Foundation")
    _packages(archive)
    archive.publish(keys[0])
    only = ("linux-image-*", "raspi-firmware")
    archives = (archive.archive("raspberrypi", keys[0], only),)
    return dataclasses.replace(load_board("zero2w"), archives=archives)


def _choose(board: Board, **changes: object) -> Board:
    assert board.kernel is not None
    return dataclasses.replace(board, kernel=dataclasses.replace(board.kernel, **changes))  # type: ignore[arg-type]


def test_the_zero_2_w_s_kernel_and_firmware_come_from_the_signed_archive(
    board: Board, tmp_path: Path
) -> None:
    kernel = unpack_kernel(board, tmp_path)
    assert kernel.version == _VERSION
    boot = {p.relative_to(kernel.boot).as_posix(): p for p in kernel.boot.rglob("*") if p.is_file()}
    assert sorted(boot) == [
        "LICENCE.firmware.txt",
        "bcm2710-rpi-zero-2-w.dtb",
        "bootcode.bin",
        "fixup.dat",
        "kernel8.img",
        "overlays/README",
        "overlays/disable-bt.dtbo",
        "start.elf",
    ]
    assert boot["kernel8.img"].read_bytes() == b"KERNEL"
    modules = kernel.root / "usr/lib/modules" / _VERSION
    assert (modules / "kernel/net/wifi.ko").is_file()
    table = (modules / "modules.dep").read_text()
    assert "kernel/net/wifi.ko:" in table and "kernel/fs/overlay.ko:" in table
    assert "alias pci:v1* wifi" in (modules / "modules.alias").read_text()
    assert (modules / "modules.builtin").is_file()
    assert (kernel.root / f"usr/share/doc/linux-image-{_VERSION}/copyright").is_file()


def test_only_the_modules_that_the_board_names_go_along(board: Board, tmp_path: Path) -> None:
    kernel = unpack_kernel(_choose(board, modules=("overlay", "ext4")), tmp_path)
    assert [path.name for path in kernel.root.rglob("*.ko")] == ["overlay.ko"]
    table = kernel.root / "usr/lib/modules" / _VERSION / "modules.dep"
    assert table.read_text() == "kernel/fs/overlay.ko:\n"


def test_a_kernel_that_is_there_needs_no_archive(
    board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = unpack_kernel(board, tmp_path)
    monkeypatch.setenv("PATH", "/nonexistent")
    assert unpack_kernel(board, tmp_path) == first
    # And what a killed build left is nobody's kernel, and is cleared away by the next.
    shutil.rmtree(first.boot.parent)
    left = tmp_path / f".{first.boot.parent.name}.part-dead"
    left.mkdir()
    monkeypatch.undo()
    assert unpack_kernel(board, tmp_path) == first
    assert not left.exists()


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"dtbs": ("broadcom/none*.dtb",)}, r"none\*\.dtb matches nothing"),
        ({"modules": ("overlay", "vivid", "i2c-dev")}, "has no module vivid, i2c-dev"),
        ({"package": "linux-image-none"}, "linux-image-none"),
        ({"firmware": ("raspi-nothing",)}, "raspi-nothing"),
    ],
)
def test_what_a_package_lacks_is_said_and_leaves_nothing(
    board: Board, tmp_path: Path, changes: dict[str, object], complaint: str
) -> None:
    with pytest.raises(DeployError, match=complaint) as caught:
        unpack_kernel(_choose(board, **changes), tmp_path)
    assert "\n" not in str(caught.value)
    assert [path for path in tmp_path.iterdir() if not path.name.endswith(".lock")] == []


def test_modules_bring_their_dependencies_hard_and_soft(tmp_path: Path) -> None:
    (tmp_path / "modules.dep").write_text(
        "fs/ext4.ko.xz: fs/jbd2.ko.xz lib/crc16.ko.xz\nfs/jbd2.ko.xz:\nlib/crc16.ko.xz:\n"
        "crypto/crc32c_generic.ko.xz: lib/base.ko.xz\nlib/base.ko.xz:\ndrivers/i2c-dev.ko.xz:\n"
    )
    (tmp_path / "modules.alias").write_text("# Aliases\nalias crc32c crc32c_generic\n")
    (tmp_path / "modules.softdep").write_text("# Soft\nsoftdep ext4 pre: crc32c post: nothing\n")
    (tmp_path / "modules.builtin").write_text("kernel/drivers/mmc-block.ko\n")
    assert with_dependencies(tmp_path, ["ext4", "i2c_dev", "mmc_block"]) == [
        "crypto/crc32c_generic.ko.xz",
        "drivers/i2c-dev.ko.xz",
        "fs/ext4.ko.xz",
        "fs/jbd2.ko.xz",
        "lib/base.ko.xz",
        "lib/crc16.ko.xz",
    ]
