"""`python3 -m deploy.board.releases ACTION`: the card's side of an update."""

from __future__ import annotations

import argparse
import json
import os
import sys

from deploy.board.releases import receive, watch
from deploy.board.releases.places import Places
from deploy.board.releases.service import Service
from deploy.errors import DeployError


def main() -> int:
    """Status 0, or 2 with one line on standard error."""
    parser = argparse.ArgumentParser(
        prog="python3 -m deploy.board.releases", description="The firmware's releases on this card."
    )
    parser.add_argument("--root", default="/", help=argparse.SUPPRESS)
    parser.add_argument(
        "action",
        choices=("receive", "watch", "verify", "status", "holds"),
        help="take a bundle from standard input; watch a trial; read the release in force again;"
        " tell what runs; tell the files",
    )
    parser.add_argument("--force", action="store_true", help="receive while the autopilot is armed")
    given = parser.parse_args()
    os.umask(0o022)  # the firmware's user reads what root writes
    at, service = Places(given.root), Service()
    try:
        if given.action == "receive":
            answer = receive.receive(at, sys.stdin.buffer, service, force=given.force)
        elif given.action == "watch":
            watch.watch(at, service, lambda line: print(line, flush=True))
            return 0
        elif given.action == "verify":
            print(watch.verify(at, service) or "as it was installed", flush=True)
            return 0
        elif given.action == "status":
            answer = watch.status(at)
        else:
            answer = receive.holds(at)
    except DeployError as error:
        print(f"releases: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"releases: {error.filename or given.root}: {error.strerror}", file=sys.stderr)
        return 2
    print(json.dumps(answer))
    return 0


if __name__ == "__main__":
    sys.exit(main())
