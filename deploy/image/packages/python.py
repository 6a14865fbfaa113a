"""Compiles Python for the card with the card's own Python, emulated: no root, nothing installed.

On a read-only root no byte code can be kept, so each start would compile the firmware again. And
a `.pyc` names the time of its source, and one that doesn't match is compiled again, whenever the
image's times are clamped: PEP 552 lets it name the source's hash instead, and not look.

    python -m deploy.image.packages.python ROOT

settles so all byte code in a root file system.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.packages import cache
from deploy.image.packages.board import Board
from deploy.image.packages.foreign import interpreter
from deploy.image.tree import Tree
from deploy.run import run

# Of a root file system, what Python needs to compile: itself and the libraries it is linked with.
_LIBRARIES = ("ld-linux", "libc.so", "libm.so", "libz.so", "libexpat.so")


def byte_compile(
    board: Board, rootfs: Path, tree: Path, installed_at: str, cache_folder: Path | None = None
) -> None:
    """Puts byte code beside all Python in `tree`, of the kind that never looks at its source.

    The same sources give the same bytes (PEP 552, unchecked hashes). Emulated, a file takes about
    half a second; with a cache, only those do whose content or place is new.

    `rootfs` is the tar of the board's root file system, which brings the Python; `installed_at` is
    where the folder will lie on the card, which tracebacks then name. Raises `DeployError` when the
    tar has no such Python, the emulator is missing, or a file has an error.
    """
    # `cpython-313`: PEP 3147's name of the interpreter that reads it.
    ending = f".cpython-{board.python.replace('.', '')}.pyc"
    wanted = {}
    for source in sorted(tree.rglob("*.py")):
        target = source.parent / "__pycache__" / (source.stem + ending)
        target.parent.mkdir(exist_ok=True)
        place = f"{installed_at}/{source.relative_to(tree)}"
        inputs = (board.architecture, board.python, place, source)
        kept = (cache_folder or tree) / "bytecode" / cache.key(*inputs)
        if cache_folder is not None and kept.is_file():
            shutil.copyfile(kept, target)
        else:
            wanted[source] = (target, kept)
    if wanted:
        _compile(board, rootfs, tree, list(wanted), installed_at)
    for target, kept in wanted.values():
        if cache_folder is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            part = kept.with_suffix(f".{os.getpid()}")
            shutil.copyfile(target, part)
            part.replace(kept)


def _compile(board: Board, rootfs: Path, tree: Path, files: list[Path], installed_at: str) -> None:
    with tempfile.TemporaryDirectory(prefix="blimp-python-") as folder:
        root = Path(folder)
        _take(board, rootfs, root)
        python = root / f"usr/bin/python{board.python}"
        if not python.is_file():
            raise DeployError(f"{rootfs}: has no /usr/bin/python{board.python}")
        words: list[str | Path] = [
            *(interpreter(board.architecture), "-L", root, python, "-I", "-S", "-m", "compileall"),
            *("-q", "-f", "--invalidation-mode", "unchecked-hash", "-i", "-"),
            *("-s", tree.absolute(), "-p", installed_at),
        ]
        names = "".join(f"{path.absolute()}\n" for path in files)
        try:
            run(words, env={"PYTHONHASHSEED": "0"}, input=names.encode())
        except DeployError as error:
            raise DeployError(f"byte code for Python {board.python}: {error}") from None


def _take(board: Board, rootfs: Path, root: Path) -> None:
    program, standard_library = (f"usr/{part}/python{board.python}" for part in ("bin", "lib"))
    (root / "usr/lib").mkdir(parents=True)
    (root / "lib").symlink_to("usr/lib")
    for path, entry in Tree.from_tar(rootfs).items():
        library = path.startswith("usr/lib/") and path.rpartition("/")[2].startswith(_LIBRARIES)
        if not library and path != program and not path.startswith(f"{standard_library}/"):
            continue
        place = root / path
        place.parent.mkdir(parents=True, exist_ok=True)
        if entry.kind == "file":
            place.write_bytes(entry.content.read())
            place.chmod(entry.mode & 0o777)
        elif entry.kind == "link":
            place.symlink_to(entry.target)


_HEADER_BYTES = 16
_MAGIC_BYTES = 4
_UNCHECKED_HASH = (1).to_bytes(4, "little")
# What PEP 552 fills with the source's hash; nobody compares it in an unchecked file.
_NO_HASH = bytes(8)


def unchecked(data: bytes) -> bytes:
    """A `.pyc` file's bytes with a header (PEP 552) that asks for no comparison with its source."""
    return data[:_MAGIC_BYTES] + _UNCHECKED_HASH + _NO_HASH + data[_HEADER_BYTES:]


def settle(root: Path) -> int:
    """Rewrites every cached `.pyc` under `root`; how many there are."""
    count = 0
    for path in sorted(root.glob("usr/**/__pycache__/*.pyc")):
        data = path.read_bytes()
        if len(data) > _HEADER_BYTES and not path.is_symlink():
            path.write_bytes(unchecked(data))
            count += 1
    return count


if __name__ == "__main__":
    settle(Path(sys.argv[1]))
