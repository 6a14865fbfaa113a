"""A card as the emulator sees it: what boots, what a working copy is, and when it is healthy."""

import shutil
import subprocess
from pathlib import Path

import emulator_card as card
import pytest

from deploy.errors import DeployError
from deploy.image.sparse import cut_out
from deploy.run import find, run

MIB = 1 << 20
TOOLS = ("sfdisk", "mkfs.vfat", "mcopy", "mke2fs", "e2fsck", "dumpe2fs", "debugfs", "fsck.vfat")
CONFIG = b"""# a comment
arm_64bit=1
kernel=vmlinuz   # which one
device_tree = board.dtb
initramfs initrd.img followkernel
"""
CONTENT = {
    "config.txt": CONFIG,
    "cmdline.txt": b"root=LABEL=blimp-root ro\n panic=10\n",
    "vmlinuz": b"kernel",
    "board.dtb": b"tree",
    "initrd.img": b"archive",
}

pytestmark = pytest.mark.skipif(
    any(find(tool) is None for tool in TOOLS), reason=f"needs {', '.join(TOOLS)}"
)


def put(image: Path, number: int, part: Path) -> None:
    offset = card.partition(image, number).start
    with image.open("r+b") as file:
        file.seek(offset)
        file.write(part.read_bytes())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("card")
    image = folder / "card.img"
    with image.open("wb") as file:
        file.truncate(40 * MIB)
    layout = b"label: dos\nstart=2048,size=32768,type=c\nsize=16384,type=83\nsize=16384,type=83\n"
    run(["sfdisk", "-q", image], input=layout)
    boot = folder / "boot"
    with boot.open("wb") as file:
        file.truncate(16 * MIB)
    run(["mkfs.vfat", boot])
    for name, data in CONTENT.items():
        (folder / name).write_bytes(data)
        run(["mcopy", "-i", boot, folder / name, "::"])
    put(image, card.BOOT, boot)
    for number in (card.ROOT, card.DATA):
        part = folder / f"part-{number}"
        with part.open("wb") as file:
            file.truncate(8 * MIB)
        run(["mke2fs", "-q", "-t", "ext4", part])
        put(image, number, part)
    return image


@pytest.fixture
def image(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(made, tmp_path / "card.img"))


def test_boot_files_are_the_ones_that_config_txt_names(image: Path, tmp_path: Path) -> None:
    boot = card.boot_files(image, tmp_path / "boot")
    assert boot.kernel.read_bytes() == b"kernel"
    assert boot.device_tree.read_bytes() == b"tree"
    assert boot.initrd is not None and boot.initrd.read_bytes() == b"archive"
    assert boot.command_line == "root=LABEL=blimp-root ro panic=10"


def test_a_card_without_its_kernel_is_not_bootable(image: Path, tmp_path: Path) -> None:
    offset = card.partition(image, card.BOOT).start
    run(["mdel", "-i", f"{image}@@{offset}", "::vmlinuz"])
    with pytest.raises(DeployError, match="not bootable, no 'vmlinuz'"):
        card.boot_files(image, tmp_path / "boot")


def test_a_working_copy_is_a_larger_card_with_the_same_content(image: Path, tmp_path: Path) -> None:
    copy = tmp_path / "work" / "card.img"
    card.working_copy(image, copy)
    assert copy.stat().st_size == 64 * MIB
    assert copy.read_bytes()[: 40 * MIB] == image.read_bytes()
    for number in (card.BOOT, card.ROOT, card.DATA):
        assert card.digest(copy, number) == card.digest(image, number)


def test_an_untouched_card_is_healthy_and_stays_as_it_is(image: Path, tmp_path: Path) -> None:
    before = image.read_bytes()
    found = card.health(image, tmp_path / "look", card.digest(image, card.ROOT))
    assert found == card.Health((), replayed=False)
    assert image.read_bytes() == before


def test_a_written_root_is_told(image: Path, tmp_path: Path) -> None:
    root = card.digest(image, card.ROOT)
    with image.open("r+b") as file:
        file.seek(card.partition(image, card.ROOT).stop - 1)
        file.write(b"x")
    assert card.health(image, tmp_path / "look", root).problems == ("root: was written to",)


def test_a_data_partition_with_a_fault_beyond_the_journal_is_told(
    image: Path, tmp_path: Path
) -> None:
    """A used block that the bitmap calls free, which no journal fixes."""
    part = tmp_path / "data"
    cut_out(image, card.partition(image, card.DATA), part)
    subprocess.run(
        ["/usr/sbin/debugfs", "-w", "-R", "freeb 100 4", str(part)],
        check=True, capture_output=True,
    )  # fmt: skip
    put(image, card.DATA, part)
    found = card.health(image, tmp_path / "look", card.digest(image, card.ROOT))
    assert [problem.split(":")[0] for problem in found.problems] == ["data"]


def test_a_mark_of_a_power_cut_is_no_fault_of_the_boot_partition(
    image: Path, tmp_path: Path
) -> None:
    offset = card.partition(image, card.BOOT).start
    with image.open("r+b") as file:
        file.seek(offset + 37)  # FAT16's byte of state: 1 says not unmounted
        file.write(b"\x01")
    root = card.digest(image, card.ROOT)
    assert card.health(image, tmp_path / "look", root).problems == ()
    with image.open("r+b") as file:  # the second copy of the table differs from the first
        file.seek(offset + 4 * 512)
        before = file.read(512)
        file.seek(offset + 4 * 512)
        file.write(bytes(512))
    assert before != bytes(512)
    problems = card.health(image, tmp_path / "look", root).problems
    assert len(problems) == 1 and problems[0].startswith("boot: FATs differ")


def test_no_image_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DeployError, match=r"nothing\.img: no such card image"):
        card.partition(tmp_path / "nothing.img", card.BOOT)


def test_a_partition_that_is_not_there_is_one_line(image: Path) -> None:
    with pytest.raises(DeployError, match="has no partition 4"):
        card.partition(image, 4)
