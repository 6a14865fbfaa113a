"""`python -m deploy.update --payload NAME`: this checkout's firmware onto a payload's card."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from deploy.board.releases import manifest
from deploy.board.releases.choose import HEALTHY
from deploy.errors import DeployError
from deploy.image.packages.board import load_board
from deploy.image.packages.wheels import fetch_wheels
from deploy.progress import Progress
from deploy.update import bundle as bundles
from deploy.update.bundle import CHECKOUT
from deploy.update.card import Card

_CACHE = CHECKOUT / "out/cache/image"  # where the image builder keeps them, too
_EXAMPLE = """example:
  python -m deploy.update --payload blimp-1 --host 192.168.4.20

The exit status is 0 when the new release is in force, 1 when the payload went back to the one
before (the reason is told), 2 when nothing was changed or it is not known."""
_NAME = re.compile(r"[a-z0-9_-]{1,32}", re.ASCII)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m deploy.update",
        description="Sends this checkout's firmware to a payload, which goes back by itself when no"
        " frames come of it within two minutes.",
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--payload", required=True, metavar="NAME", help="the payload's id")
    add("--host", help="its address (default: its id as a name in the network)")
    add("--port", type=int, default=22, help="of its sshd (default: 22)")
    add("--keys", type=Path, metavar="DIR", help="the folder of `blimp keys` (default: its own)")
    add("--identity", type=Path, metavar="FILE",
        help="the pilot's SSH key (default: the ground station's)")  # fmt: skip
    add("--site", type=Path, metavar="DIR", help="unpacked wheels (default: those of the lock)")
    add("--allow-older", action="store_true", help="may replace the newer version that runs now")
    add("--force", action="store_true", help="also while its autopilot is armed: video stops")
    return parser


def main() -> int:
    """Status 0, 1 or 2 as the help says."""
    try:
        return _update(_parser().parse_args())
    except DeployError as error:
        print(f"update: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("update: stopped; the card decides by itself", file=sys.stderr)
        return 2


def _update(given: argparse.Namespace) -> int:
    if not _NAME.fullmatch(given.payload):
        raise DeployError(f"--payload is {given.payload[:60]!r}; allowed: 1 to 32 of a-z 0-9 - _")
    host = given.host or given.payload
    if host.startswith("-"):
        raise DeployError(f"--host is {host!r}, which is no address")
    if not 1 <= given.port <= 65_535:
        raise DeployError(f"--port is {given.port}; allowed: 1 to 65535")
    for option, path in (("identity", given.identity), ("site", given.site)):
        if path is not None and not path.exists():
            raise DeployError(f"--{option} {path}: not there")
    key = bundles.release_key(given.keys, _log)
    card = Card(given.payload, host, key.parents[1], given.identity, given.port)
    state = card.ask("status")
    try:
        factory = manifest.Release(**state["factory"])
        running, board = str(state["in_force"]["version"]), str(state["board"])
        limit_s = float(state["limit_s"])
    except (KeyError, TypeError, ValueError):
        raise DeployError(f"{host}: tells its releases otherwise than this checkout") from None
    _log(f"{given.payload} ({board or 'an unknown board'}) runs {running}")
    site = given.site or fetch_wheels(load_board(board), _CACHE)
    files = bundles.release_of(CHECKOUT, site, factory.machine, factory.python)
    made = bundles.make(files, key, running if given.allow_older else "")
    held = {str(path): str(sha256) for path, sha256 in card.ask("holds").items()}
    size = bundles.size_to_send(made, held)
    version = made.listed.release.version
    with Progress(f"sending {version}", size) as progress:
        answer = card.give(made, held, progress.advance, force=given.force)
    if not answer.get("id"):
        _log(f"{version} is in force already")
        return 0
    _log(f"{version} is on the card and on trial, which ends within {limit_s:g} s")
    last = card.follow(str(answer["id"]), limit_s, _log)
    if last.get("outcome") == HEALTHY:
        _log(f"{version} is in force")
        return 0
    _log(f"{given.payload} went back to {last['previous'] or factory.version}: {last['reason']}")
    return 1


def _log(text: str) -> None:
    print(f"update: {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
