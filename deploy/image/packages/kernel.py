"""The board's kernel from its package, without installing it: unpacked, thinned, indexed natively.

Installing would build an initrd under emulation, a quarter of an hour; the card has its own.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.initrd import Modules, name_of
from deploy.image.packages import apt, cache
from deploy.image.packages.board import Board, KernelChoice
from deploy.run import run

# Raised when this module makes something else of the same inputs.
_RECIPE = 1
_VERSIONED = r"linux-image-\d[a-z0-9.+~-]*"

# Where Raspberry Pi's and Debian's package keep what the Pi's own boot loader reads.
_FIRMWARE = Path("usr/lib/raspi-firmware")
_FIRMWARE_FILES = ("bootcode.bin", "start*.elf", "fixup*.dat")
_LICENCE = "LICENCE.firmware.txt"
_MODULES = Path("usr/lib/modules")

# What of a kernel's modules folder is neither a module nor made by depmod.
_MODULE_LISTS = ("modules.builtin", "modules.builtin.modinfo", "modules.order")


@dataclass(frozen=True)
class Kernel:
    """A kernel as it goes onto a card.

    Attributes:
        version: as `uname -r` says.
        image: what its file in `boot` is called.
        boot: a folder of files and folders for the boot partition: the kernel under the board's
            name for it, device trees, `overlays/`, the first stage's programs.
        root: a tree to lay over the root file system: modules with their index, licences.
    """

    version: str
    image: str
    boot: Path
    root: Path


def unpack_kernel(board: Board, cache_folder: Path) -> Kernel:
    """The board's kernel, downloaded and verified once, then kept in `cache_folder`.

    Raises:
        DeployError: the archive is out of reach or not trusted, the package lacks a file or a
            module that the board names; nothing half-made is left.
    """
    choice = board.kernel
    if choice is None:
        raise DeployError(f"board {board.name}: its kernel comes with its base image")
    name = cache.key(board.architecture, board.suite, board.archives, choice, _RECIPE)
    target = cache_folder / f"kernel-{board.name}-{name}"
    with cache.made(target) as work:
        if work is not None:
            _make(board, choice, work, work / target.name)
    (modules,) = (target / "root" / _MODULES).iterdir()
    return Kernel(modules.name, choice.image, target / "boot", target / "root")


def _make(board: Board, choice: KernelChoice, work: Path, folder: Path) -> None:
    with apt.opened(board) as archives:
        package = archives.dependency(choice.package, _VERSIONED)
        files = archives.download([package, *choice.firmware], work / "packages")
    unpacked = work / "unpacked"
    for file in files:
        run(["dpkg-deb", "--extract", file, unpacked])
    version = package.removeprefix("linux-image-")
    _boot(choice, version, unpacked, folder / "boot")
    _modules(choice, version, unpacked, folder / "root")
    for name in (package, *choice.firmware):
        licence = Path("usr/share/doc") / name / "copyright"
        if (unpacked / licence).is_file():
            _copy(unpacked / licence, folder / "root" / licence)
            if name in choice.firmware:
                _copy(unpacked / licence, folder / "boot" / _LICENCE)


def _boot(choice: KernelChoice, version: str, unpacked: Path, boot: Path) -> None:
    """Lays out the boot partition's files: device trees at the top, where a Pi looks for them."""
    image = unpacked / f"boot/vmlinuz-{version}"
    if not image.is_file():
        raise DeployError(f"package linux-image-{version}: has no /boot/vmlinuz-{version}")
    _copy(image, boot / choice.image)
    trees = unpacked / f"usr/lib/linux-image-{version}"
    for path in _matching(trees, choice.dtbs):
        _copy(path, boot / path.name)
    for path in _matching(trees / "overlays", choice.overlays):
        _copy(path, boot / "overlays" / path.name)
    if choice.firmware:
        for path in _matching(unpacked / _FIRMWARE, _FIRMWARE_FILES):
            _copy(path, boot / path.name)


def _modules(choice: KernelChoice, version: str, unpacked: Path, root: Path) -> None:
    """Copies the modules that the board names, with what they depend on, and indexes them."""
    # A merged /usr, as Debian has it, whichever of the two the package was made for.
    split, merged = Path("lib/modules") / version, _MODULES / version
    if not (unpacked / merged).is_dir():
        if not (unpacked / split).is_dir():
            raise DeployError(f"package linux-image-{version}: has no modules")
        (unpacked / merged).parent.mkdir(parents=True, exist_ok=True)
        (unpacked / split).rename(unpacked / merged)
    source, target = unpacked / merged, root / merged
    if choice.modules:
        run(["depmod", "--basedir", unpacked / "usr", version])
        for name in with_dependencies(source, choice.modules):
            _copy(source / name, target / name)
    else:
        shutil.copytree(source, target, symlinks=True)
        for link in ("build", "source"):
            (target / link).unlink(missing_ok=True)
    for name in _MODULE_LISTS:
        if (source / name).is_file():
            _copy(source / name, target / name)
    run(["depmod", "--basedir", root / "usr", version])


def with_dependencies(modules: Path, names: Iterable[str]) -> list[str]:
    """Paths in a modules folder of the named modules and all that they depend on, sorted.

    Those that a softdep asks for by an alias are among them. What is built into the kernel gives no
    path. Raises `DeployError` for modules that the kernel doesn't have.
    """
    tables = Modules(lambda table: _lines(modules / table))
    unknown = [name for name in names if name_of(name) not in {*tables.paths, *tables.builtin}]
    if unknown:
        raise DeployError(f"kernel {modules.name}: has no module {', '.join(unknown)}")
    waiting = [tables.paths[n] for n in map(name_of, names) if n in tables.paths]
    found: set[str] = set()
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += tables.needs[path]
            for asked in (tables.before, tables.after):
                for name in asked.get(name_of(path), []):
                    waiting += tables.behind(name)
    return sorted(found)


def _lines(file: Path) -> list[str]:
    return file.read_text().splitlines() if file.is_file() else []


def _matching(folder: Path, patterns: tuple[str, ...]) -> list[Path]:
    found: set[Path] = set()
    for pattern in patterns:
        some = [path for path in folder.glob(pattern) if path.is_file()]
        if not some:
            raise DeployError(f"kernel package: {pattern} matches nothing in its {folder.name}/")
        found.update(some)
    return sorted(found)


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(source, target)
