"""The card's root file system from packages, as one tar: mmdebstrap with the board's archives."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.packages import apt, cache, foreign
from deploy.image.packages.board import Board
from deploy.image.packages.foreign import run_long

_HERE = Path(__file__).parent
# Raised when this module makes another tar of the same inputs.
_RECIPE = 1
_HOST_KEYS = "ssh_host_rsa_key ssh_host_ecdsa_key ssh_host_ed25519_key"


def build_rootfs(board: Board, cache_folder: Path, epoch: int) -> Path:
    """The tar of the board's root file system: made once, then taken from the cache.

    It holds Debian's essential packages, the board's and what they depend on; no kernel, no apt,
    no device nodes, no user, no key, an empty machine id. Its bytes follow from the packages'
    versions and the inputs: no file is younger than `epoch`.

    Args:
        board: whose; its archives must be in reach when the cache has no tar.
        cache_folder: where tars are kept, as `rootfs-BOARD-KEY.tar`.
        epoch: seconds since 1970, SOURCE_DATE_EPOCH. It is part of the key: one that moves with
            each commit builds each time.

    Raises:
        DeployError: not root, a tool is missing, an archive is out of reach or not trusted, a
            package isn't there; nothing half-made is left. What the tools said then stands in
            `rootfs-BOARD.log` there.
    """
    made_by = (_RECIPE, *(_HERE / name for name in ("finish.sh", "plugins.sh", "python.py")))
    inputs = (board.architecture, board.suite, board.archives, board.packages, board.left_out)
    target = cache_folder / f"rootfs-{board.name}-{cache.key(*inputs, epoch, *made_by)}.tar"
    with cache.made(target) as work:
        if work is None:
            return target
        if os.geteuid() != 0:
            raise DeployError(
                f"a root file system is built as root: sudo (once; it then lies in {cache_folder})"
            )
        emulated = foreign.prefix(board.architecture)
        # What cannot be had is said in seconds, before the minutes of building.
        with apt.opened(board) as archives:
            archives.plan(board.package_names)
        log = cache_folder / f"rootfs-{board.name}.log"
        words = [*emulated, *_mmdebstrap(board, work, work / target.name)]
        environment = {
            **foreign.environment(),
            "SOURCE_DATE_EPOCH": str(epoch),
            "TMPDIR": str(work),
            # Byte code of the same sources is then the same.
            "PYTHONHASHSEED": "0",
        }
        run_long(words, log, f"root file system of {board.name}", environment)
    return target


def _mmdebstrap(board: Board, work: Path, tar: Path) -> list[str]:
    """The command that builds `tar`; its inputs are written into `work`."""
    sources, pins = work / "board.sources", work / "board.pref"
    sources.write_text(apt.sources(board.archives))
    pins.write_text(apt.preferences(board.archives))
    for name in ("finish.sh", "plugins.sh"):
        shutil.copy(_HERE / name, work)
    rules = [
        f"path-include={name[1:]}" if name.startswith("!") else f"path-exclude={name}"
        for group in board.left_out
        for name in group.names
    ]
    copy_pins = f'cp {shlex.quote(str(pins))} "$1/etc/apt/preferences.d/board.pref"'
    finish, plugins = (
        f'sh {shlex.quote(str(work / name))} "$1"' for name in ("finish.sh", "plugins.sh")
    )
    python = f"{shlex.quote(sys.executable)} -m deploy.image.packages"
    return [
        "mmdebstrap",
        "--mode=root",
        "--variant=essential",
        f"--architectures={board.architecture}",
        '--aptopt=APT::Install-Recommends "false"',
        '--aptopt=APT::Sandbox::User "root"',
        '--aptopt=Acquire::Languages "none"',
        '--aptopt=Acquire::Retries "3"',
        *(f"--dpkgopt={rule}" for rule in rules),
        f"--include={','.join(board.package_names)}",
        f'--setup-hook=mkdir -p "$1/etc/apt/preferences.d"; {copy_pins}',
        # openssh-server makes no host keys where some are, which takes emulated RSA minutes;
        # `finish.sh` takes them away as it would real ones.
        f'--essential-hook=mkdir -p "$1/etc/ssh"; cd "$1/etc/ssh"; touch {_HOST_KEYS}',
        f'--customize-hook={python}.libraries "$1"',
        f'--customize-hook={python}.python "$1"',
        f"--customize-hook={plugins}",
        f"--customize-hook={finish}",
        "--format=tar",
        board.suite,
        str(tar),
        str(sources),
    ]
