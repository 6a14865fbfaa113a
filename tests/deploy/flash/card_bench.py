"""A small card image, a bench with it, and the flasher as the program that a person runs."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import os
import shutil
import subprocess
import sys
import unittest.mock
from pathlib import Path

from deploy.flash import __main__ as command

REPOSITORY = Path(__file__).parents[3]
MEBI = 1 << 20
BOOT_OFFSET = MEBI
GAP_MIB = 2
TOOLS = ("sfdisk", "mkfs.vfat", "mke2fs", "mcopy", "bmaptool", "e2fsck", "fsck.vfat")
SYSTEM_PATH = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"


@dataclasses.dataclass
class Bench:
    """An image with its `.sha256` and `.bmap`, keys, and a file that stands for the card."""

    folder: Path
    image: Path
    card: Path
    keys: Path

    def command(self, *more: str, wifi: bool = True, ask: bool = False) -> list[str]:
        """The flasher's words for a good run."""
        words = ["--device", str(self.card), "--image", str(self.image), "--payload", "blimp-1"]
        words += ["--keys", str(self.keys), *([] if ask else ["--yes"])]
        if wifi:
            words += ["--wifi-ssid", "hall", "--wifi-password-file", str(self.password())]
            words += ["--country", "DE"]
        return [sys.executable, "-m", "deploy.flash", *words, *more]

    def customise(self, *more: str) -> list[str]:
        """The flasher's words for settings only."""
        words = ["--customise-only", "--device", str(self.card), "--keys", str(self.keys), "--yes"]
        return [sys.executable, "-m", "deploy.flash", *words, *more]

    def password(self, text: str = "correct horse") -> Path:
        """A file with a password in it."""
        file = self.folder / "password"
        file.write_bytes(text.encode())
        return file

    def toml(self, card: Path | None = None) -> bytes:
        """The `blimp.toml` on a card."""
        return self.read("blimp/blimp.toml", card)

    def read(self, path: str, card: Path | None = None) -> bytes:
        """A file of a card's boot partition, by mtools."""
        words = ["mtype", "-i", f"{card or self.card}@@{BOOT_OFFSET}", f"::/{path}"]
        return tool(*words)

    def listed(self, card: Path | None = None) -> list[str]:
        """All paths in a card's boot partition."""
        words = ["mdir", "-/", "-b", "-i", f"{card or self.card}@@{BOOT_OFFSET}", "::/"]
        return sorted(line.removeprefix("::/") for line in tool(*words).decode().splitlines())


def run(
    words: list[str], *, input: str = "", program: bool = False
) -> subprocess.CompletedProcess[str]:
    """Runs the flasher to its end: in this process, or with `program` as a person runs it."""
    if program:
        return subprocess.run(
            words, cwd=REPOSITORY, input=input, capture_output=True, text=True, errors="replace",
            timeout=60, check=False,
        )  # fmt: skip
    with (
        contextlib.redirect_stderr(io.StringIO()) as stderr,
        contextlib.redirect_stdout(io.StringIO()) as stdout,
        unittest.mock.patch("sys.stdin", io.StringIO(input)),
    ):
        status = command.main(words[3:])
    return subprocess.CompletedProcess(words, status, stdout.getvalue(), stderr.getvalue())


def refused(words: list[str], said: str, *, input: str = "", program: bool = False) -> None:
    """Asserts a refusal: status 2, one line that says so, no traceback."""
    done = run(words, input=input, program=program)
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 2, done
    assert lines[-1].startswith("deploy.flash: ") and said in lines[-1], done.stderr
    assert "Traceback" not in done.stderr


def tool(*words: str, input: bytes = b"") -> bytes:
    """Runs a tool that must do well."""
    env = {**os.environ, "PATH": SYSTEM_PATH, "MTOOLS_SKIP_CHECK": "1", "LC_ALL": "C"}
    done = subprocess.run(words, input=input, capture_output=True, check=False, env=env)
    assert done.returncode == 0, (words, done.stderr)
    return done.stdout


def sum_of(image: Path) -> None:
    """Writes the `.sha256` beside an image, as sha256sum does."""
    digest = hashlib.sha256(image.read_bytes()).hexdigest()
    image.with_name(image.name + ".sha256").write_text(f"{digest}  {image.name}\n")


def make_image(path: Path, *, boot_mib: int = 8, root_mib: int = 8, label: str = "BLIMPBOOT",
               folder: bool = True) -> None:  # fmt: skip
    """A card image as the builder's: FAT, ext4 with files, a gap, an empty ext4 for data."""
    work = path.parent / (path.name + ".work")
    work.mkdir()
    size = (1 + boot_mib + root_mib + GAP_MIB + 4) * MEBI
    data_start = (1 + boot_mib + root_mib + GAP_MIB) * 2048
    with open(path, "wb") as file:
        file.truncate(size)
    table = (
        f"label: dos\nlabel-id: 0x1234abcd\nstart=2048, size={boot_mib * 2048}, type=c, bootable\n"
        f"size={root_mib * 2048}, type=83\nstart={data_start}, size={4 * 2048}, type=83\n"
    )
    tool("sfdisk", "--quiet", "--no-reread", str(path), input=table.encode())
    boot = work / "boot"
    with open(boot, "wb") as file:
        file.truncate(boot_mib * MEBI)
    kind = "16" if boot_mib < 40 else "32"
    tool("mkfs.vfat", "-s", "1", "-F", kind, "-n", label, str(boot))
    for name, data in {
        "config.txt": b"camera_auto_detect=1\n",
        "kernel8.img": b"k" * 70_000,
    }.items():
        tool("mcopy", "-i", str(boot), "-", f"::/{name}", input=data)
    if folder:
        tool("mmd", "-i", str(boot), "::/blimp")
    tree = work / "tree"
    tree.mkdir()
    # What is not all the same byte, so that a block in the wrong place is seen.
    noise = hashlib.shake_256(b"root").digest(root_mib * MEBI // 2)
    (tree / "program").write_bytes(noise)
    for name, mib in (("root", root_mib), ("data", 4)):
        with open(work / name, "wb") as file:
            file.truncate(mib * MEBI)
    tool("mke2fs", "-q", "-t", "ext4", "-d", str(tree), str(work / "root"))
    tool("mke2fs", "-q", "-t", "ext4", str(work / "data"))
    # dd writes zeros, too: what a file system needs as zeros is in the map, only the gap is not.
    for name, mib in (("boot", 1), ("root", 1 + boot_mib), ("data", data_start // 2048)):
        tool("dd", f"if={work / name}", f"of={path}", "bs=1M", f"seek={mib}",
             "conv=notrunc", "status=none")  # fmt: skip
    shutil.rmtree(work)
