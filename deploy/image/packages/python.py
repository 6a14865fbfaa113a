"""Compiles Python for the card with the card's own Python, emulated: no root, nothing installed.

On a read-only root no byte code can be kept, so each start would compile the firmware anew.
"""

from __future__ import annotations

import shutil
import tarfile
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.packages import cache
from deploy.image.packages.board import Board
from deploy.image.packages.foreign import interpreter
from deploy.image.packages.tree import settle_times
from deploy.run import run

_HERE = Path(__file__).parent

# Of a root file system, what Python needs to compile: itself and the libraries it is linked with.
_LIBRARIES = ("ld-linux", "libc.so", "libm.so", "libz.so", "libexpat.so")


def compiled(board: Board, rootfs: Path, tree: Path, installed_at: str, cache_folder: Path) -> Path:
    """A copy of `tree` with byte code beside all its Python, of the kind that never looks there.

    The same sources give the same bytes (PEP 552, unchecked hashes); times are fixed. Emulated it
    takes about half a second a file, so it is done once for a content.

    Args:
        board: whose.
        rootfs: its root file system's tar, which brings the Python.
        tree: a folder of Python; what of it is no `__pycache__` is copied.
        installed_at: where the folder will lie on the card, which tracebacks then name.
        cache_folder: where copies are kept, as `compiled-BOARD-KEY/`.

    Raises:
        DeployError: the tar has no such Python, the emulator is missing, or a file has an error;
            nothing half-made is left.
    """
    files = sorted(path for path in tree.rglob("*") if path.is_file() and path.suffix != ".pyc")
    content = [(path.relative_to(tree).as_posix(), path) for path in files]
    inputs = (board.architecture, board.python, installed_at, content, _HERE / "python.py")
    target = cache_folder / f"compiled-{board.name}-{cache.key(*inputs)}"
    with cache.made(target) as work:
        if work is not None:
            copy = work / target.name
            shutil.copytree(tree, copy, ignore=shutil.ignore_patterns("__pycache__"))
            _compile(board, rootfs, copy, installed_at, work / "python")
            settle_times(copy)
    return target


def _compile(board: Board, rootfs: Path, tree: Path, installed_at: str, root: Path) -> None:
    _take(board, rootfs, root)
    python = root / f"usr/bin/python{board.python}"
    if not python.is_file():
        raise DeployError(f"{rootfs}: has no /usr/bin/python{board.python}")
    words: list[str | Path] = [
        *(interpreter(board.architecture), "-L", root, python, "-I", "-S", "-m", "compileall"),
        *("-q", "-f", "--invalidation-mode", "unchecked-hash"),
        *("-s", tree.absolute(), "-p", installed_at, tree.absolute()),
    ]
    try:
        run(words, env={"PYTHONHASHSEED": "0"})
    except DeployError as error:
        raise DeployError(f"byte code of {tree} for Python {board.python}: {error}") from None


def _take(board: Board, rootfs: Path, root: Path) -> None:
    standard_library = f"./usr/lib/python{board.python}/"
    (root / "usr/lib").mkdir(parents=True)
    (root / "lib").symlink_to("usr/lib")
    try:
        with tarfile.open(rootfs) as file:
            for member in file:
                name, last = member.name, member.name.rsplit("/", 1)[-1]
                library = name.startswith("./usr/lib/") and last.startswith(_LIBRARIES)
                python = name == f"./usr/bin/python{board.python}" or name.startswith(
                    standard_library
                )
                if (library or python) and (member.isfile() or member.issym()):
                    file.extract(member, root, filter="tar")
    except (OSError, tarfile.TarError) as error:
        raise DeployError(f"{rootfs}: {error}") from None
