"""`python -m deploy.image`: the image builder."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from deploy.errors import DeployError
from deploy.image import card, raspios, release
from deploy.image.packages.board import load_board, with_archives
from deploy.image.packages.kernel import unpack_kernel
from deploy.image.packages.python import byte_compile
from deploy.image.packages.rootfs import build_rootfs
from deploy.image.packages.wheels import fetch_wheels

_CHECKOUT = Path(__file__).parents[2]
_BOARDS = ("qemu", "zero2w", "zerow")
# No file of the packages' root is younger, so that its cache outlives our own commits.
_ROOTFS_EPOCH = 1_767_225_600  # 2026-01-01

_DESCRIPTION = """\
Builds the whole SD card of a payload as a file: nothing is mounted, no loop device is used. Beside
the image: .bmap (which blocks to write), .manifest.json (what is in it) and .sha256. The same
inputs give the same bytes.

  qemu     for the emulator: Debian 13, arm64
  zero2w   Raspberry Pi Zero 2 W: Debian 13, arm64, with Raspberry Pi's kernel and firmware
  zerow    Raspberry Pi Zero W: Raspberry Pi OS Lite (32-bit, trixie), named by --base; what it
           lacks is installed from its own sources, and kept for the next time

zero2w and zerow are not verified on hardware.
"""
_EXAMPLE = """\
example:
  sudo .venv/bin/python -m deploy.image --board qemu
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m deploy.image",
        description=_DESCRIPTION,
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--board", choices=_BOARDS, required=True)
    add("--out", type=Path, metavar="FILE", help="default: out/image/blimp-BOARD.img")
    add("--base", type=Path, metavar="IMG[.xz]", help="Raspberry Pi OS Lite, for zerow only")
    add("--epoch", type=int, metavar="S",
        help="time of everything in it, s since 1970 (default: SOURCE_DATE_EPOCH, or the last"
        " commit's)")  # fmt: skip
    add("--cache", type=Path, metavar="DIR", help="of packages (default: out/cache/image)")
    add("--archive", action="append", default=[], metavar="NAME=URL",
        help="where an archive of packages is, as raspberrypi=https://…")  # fmt: skip
    add("--keyring", action="append", default=[], metavar="NAME=FILE",
        help="the keys that an archive's index must be signed with")  # fmt: skip
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Builds an image; status 0, or 2 with one line on what a person can fix."""
    options = _parser().parse_args(arguments)
    started = time.monotonic()

    def log(line: str) -> None:
        print(f"image: {time.monotonic() - started:6.1f} s  {line}", file=sys.stderr, flush=True)

    try:
        image = options.out or _CHECKOUT / f"out/image/blimp-{options.board}.img"
        _build(options, image, _epoch(options), log)
    except DeployError as error:
        print(f"deploy.image: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("deploy.image: interrupted; no image was made", file=sys.stderr)
        return 130
    print(image)
    flash = f"make flash DEVICE=/dev/sdX IMAGE={shlex.quote(str(image))} PAYLOAD=blimp-1 WIFI=SSID"
    print(f"next: {flash} COUNTRY=DE", file=sys.stderr)  # programs read where the image is
    return 0


def _build(options: argparse.Namespace, image: Path, epoch: int, log: card.Log) -> None:
    board = with_archives(load_board(options.board), _archives(options))
    if bool(board.base) != (options.base is not None):
        wants = f"needs --base: {board.base}" if board.base else "takes no --base"
        raise DeployError(f"--board {board.name}: {wants}")
    cache_folder = options.cache or _CHECKOUT / "out/cache/image"
    log("wheels")
    site = fetch_wheels(board, cache_folder)
    if board.base:
        raspios.build(image, board, options.base, site, cache_folder, _CHECKOUT, epoch, log)
        return
    log("kernel")
    kernel = unpack_kernel(board, cache_folder)
    log("packages (the first time this takes a quarter of an hour)")
    rootfs = build_rootfs(board, cache_folder, _ROOTFS_EPOCH)

    def compile_at(folder: Path, at: str) -> None:
        byte_compile(board, rootfs, folder, at, cache_folder)

    card.build(image, board, kernel, rootfs, site, _CHECKOUT, epoch, compile_at, log)
    log("done")


def _epoch(options: argparse.Namespace) -> int:
    if options.epoch is not None:
        return int(options.epoch)
    given = os.environ.get("SOURCE_DATE_EPOCH")
    if given is None:
        return release.epoch(_CHECKOUT)
    if not given.isdigit():
        raise DeployError(f"SOURCE_DATE_EPOCH='{given}': not a number of seconds")
    return int(given)


def _archives(options: argparse.Namespace) -> dict[str, dict[str, str]]:
    changes: dict[str, dict[str, str]] = {}
    for option, key in (("archive", "url"), ("keyring", "keyring")):
        for text in getattr(options, option):
            name, sign, value = text.partition("=")
            if not sign or not name or not value:
                raise DeployError(f"--{option} {text}: expected NAME=…")
            changes.setdefault(name, {})[key] = value
    return changes


if __name__ == "__main__":
    sys.exit(main())
