"""The firmware's wheels from `requirements.lock` for a board, unpacked as a release's `site/`."""

from __future__ import annotations

import fnmatch
import os
import re
import sys
import zipfile
from pathlib import Path, PurePosixPath

from deploy.errors import DeployError
from deploy.image.packages import cache
from deploy.image.packages.board import Board, Wheel
from deploy.run import run

# 1980-01-01, the oldest time that a zip file and FAT can tell.
_TIME_S = 315_532_800
_FOLDER_MODE = 0o755


def settle_times(folder: Path) -> None:
    """Gives everything in a folder, itself included, one fixed time, and its folders one mode."""
    for path in (*folder.rglob("*"), folder):
        if path.is_dir() and not path.is_symlink():
            path.chmod(_FOLDER_MODE)
        os.utime(path, (_TIME_S, _TIME_S), follow_symlinks=False)


# Raised when this module makes another folder of the same inputs.
_RECIPE = 1
_LOCK = Path(__file__).parents[3] / "requirements.lock"
_START = re.compile(r"^([A-Za-z0-9][A-Za-z0-9._-]*)==([^ ;\\]+)")
_NETWORK_TRIES, _NETWORK_LIMIT_S = "3", "60"

_FILE_MODE, _LIBRARY_MODE = 0o644, 0o755
_COMPILED = (".so", ".pyd", ".dylib")


def fetch_wheels(board: Board, cache_folder: Path, lock: Path = _LOCK) -> Path:
    """A folder with the board's wheels unpacked, to stand in `PYTHONPATH` as a release's `site/`.

    Each wheel is the one whose hash the lock holds; nothing is resolved and nothing of it runs.
    Its bytes, modes and times follow from the wheels alone.

    Args:
        board: whose; `wheels` says which of the lock are no packages of Debian.
        cache_folder: where it is kept, as `site-BOARD-KEY/`.
        lock: a requirements file with hashes.

    Raises:
        DeployError: a wheel isn't in the lock, has another hash or doesn't exist for the board, or
            the index is out of reach; nothing half-made is left.
    """
    pinned = {wheel.name: requirement(lock, wheel.name) for wheel in board.wheels}
    inputs = (board.machine, board.python, board.platforms, board.wheels, pinned)
    name = cache.key(*inputs, _RECIPE)
    target = cache_folder / f"site-{board.name}-{name}"
    with cache.made(target) as work:
        if work is None:
            return target
        site = work / target.name
        site.mkdir()
        for wheel in board.wheels:
            unpack(_download(board, wheel, pinned[wheel.name], work), site, wheel)
        settle_times(site)
    return target


def requirement(lock: Path, name: str) -> str:
    """The lock's lines of one distribution: version and hashes, without environment markers.

    Raises `DeployError` when it isn't there or has no hash.
    """
    try:
        lines = lock.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DeployError(f"{lock}: {getattr(error, 'strerror', None) or error}") from None
    for number, line in enumerate(lines):
        found = _START.match(line)
        if found and _normal(found[1]) == _normal(name):
            hashes = []
            for following in lines[number + 1 :]:
                if not following.startswith(" "):
                    break
                hashes.append(following.strip().rstrip("\\").strip())
            if not hashes or not all(value.startswith("--hash=sha256:") for value in hashes):
                raise DeployError(f"{lock}: {name} has no hashes")
            return " \\\n    ".join((f"{found[1]}=={found[2]}", *hashes)) + "\n"
    raise DeployError(f"{lock}: has no {name}, which the board's card needs")


def unpack(wheel_file: Path, site: Path, wheel: Wheel) -> None:
    """Unpacks what `wheel` keeps of a wheel (a zip, PEP 427) into `site`.

    Its hash stands in the lock, so that it is not looked at for harm; zipfile keeps it in `site`.

    Raises:
        DeployError: no wheel, one that wants an installer, a file that is there already, or
            compiled code where only portable Python is wanted.
    """
    try:
        with zipfile.ZipFile(wheel_file) as archive:
            members = [member for member in archive.infolist() if not member.is_dir()]
            for member in sorted(members, key=lambda member: member.filename):
                path = PurePosixPath(member.filename)
                if wheel.keep and not any(fnmatch.fnmatchcase(str(path), p) for p in wheel.keep):
                    continue
                # `NAME.data/purelib` is an installer's to move; no wheel taken has one.
                if path.parts[0].endswith(".data"):
                    raise DeployError(f"{wheel_file.name}: {path} wants an installer")
                if wheel.portable and path.suffix in _COMPILED:
                    raise DeployError(f"{wheel_file.name}: {path} is compiled, for who knows whom")
                if (site / path).exists():
                    raise DeployError(f"{wheel_file.name}: {path} is there from another wheel")
                Path(archive.extract(member, site)).chmod(
                    _LIBRARY_MODE if path.suffix == ".so" else _FILE_MODE
                )
    # zipfile says NotImplementedError of a compression that it does not know.
    except (zipfile.BadZipFile, EOFError, NotImplementedError) as error:
        raise DeployError(f"{wheel_file.name}: no wheel, or cut: {error}") from None


def _download(board: Board, wheel: Wheel, pinned: str, work: Path) -> Path:
    """The wheel's file, checked against the lock's hashes."""
    folder, wanted = work / wheel.name, work / f"{wheel.name}.txt"
    folder.mkdir()
    wanted.write_text(pinned)
    tags = [f"--platform={platform}" for platform in board.platforms]
    if wheel.portable:
        # Only pure Python is taken of it: whichever machine's wheel the lock has.
        tags += ["--platform=manylinux_2_17_aarch64", "--platform=manylinux2014_aarch64"]
    digits = board.python.replace(".", "")
    words = [
        *(sys.executable, "-m", "pip", "download", "--quiet", "--no-input", "--no-deps"),
        *("--disable-pip-version-check", "--require-hashes", "--only-binary=:all:"),
        *("--retries", _NETWORK_TRIES, "--timeout", _NETWORK_LIMIT_S),
        *("--python-version", board.python, "--implementation=cp"),
        *(f"--abi={abi}" for abi in (f"cp{digits}", "abi3", "none")),
        *(*tags, "--dest", str(folder), "--requirement", str(wanted)),
    ]
    try:
        run(words)
    except DeployError as error:
        version = pinned.split(" ", 1)[0]
        raise DeployError(f"wheel {version} for {board.machine}: {error}") from None
    found = sorted(folder.glob("*.whl"))
    if len(found) != 1:
        raise DeployError(f"wheel {wheel.name}: {len(found)} files came, 1 was expected")
    return found[0]


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
