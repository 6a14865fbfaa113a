"""Starts the firmware: `python3 -m deploy.board.start`, for systemd.

Chooses the release, counts the start of one that is under trial, and runs its `pi_firmware` in this
process, as starting Python once more would cost. Whatever is wrong with an update, something is
started.
"""

from __future__ import annotations

import json
import os
import runpy
import sys
from pathlib import Path

from deploy.board.releases import choose, places
from deploy.board.releases.places import Places

ENVIRONMENT = "BLIMP_RELEASE"
"""Tells the firmware its release: a JSON object of `version`, `how` and `reason`."""


def choice(at: Places, state: choose.State) -> choose.Choice:
    """The release to start now; counts the start of an update, which its first frame forgets."""
    if state.on_trial and state.trial is not None:
        if 0 <= state.starts < choose.STARTS and not _count(
            at.starts, state.trial["id"], state.starts
        ):
            state = state._replace(starts=-1)
    elif state.current != places.FACTORY:
        _count(at.frameless, state.current, state.frameless)
    return choose.choose(state, lambda name: choose.size_fault(at, name))


def _count(path: Path, of: str, before: int) -> bool:
    try:
        places.write(path, {"id": of, "starts": before + 1})
    except OSError as error:
        print(f"start: {path}: {error.strerror}", file=sys.stderr)
        return False
    return True


def release_of(at: Places, chosen: choose.Choice) -> dict[str, str]:
    """What the firmware is told of its release."""
    release = places.read(at.folder(chosen.name) / choose.RELEASE) or {}
    version = chosen.name or str(release.get("version", ""))
    return {"version": version, "how": chosen.how, "reason": chosen.reason}


def main(arguments: list[str]) -> int:
    """Runs the firmware; `--root DIR` in tests, all else goes to the firmware."""
    root = "/"
    if arguments[:1] == ["--root"] and len(arguments) > 1:
        root, arguments = arguments[1], arguments[2:]
    at = Places(root)
    state = choose.read_state(at)
    chosen = choice(at, state)
    release = release_of(at, chosen)
    try:
        trial = state.trial["id"] if state.on_trial and state.trial is not None else ""
        running = {**release, "name": chosen.name, "trial": trial}
        places.write(at.running, running, durable=False)
    except OSError as error:  # the watcher knows less, the firmware flies all the same
        print(f"start: {at.running}: {error.strerror}", file=sys.stderr)
    said = f"start: release {release['version'] or '?'} ({chosen.how})"
    print(f"{said}: {chosen.reason}" if chosen.reason else said, flush=True)
    os.environ[ENVIRONMENT] = json.dumps(release)
    folder = at.folder(chosen.name)
    sys.path[:0] = [str(folder), str(folder / "site")]
    sys.dont_write_bytecode = True
    sys.argv = ["pi_firmware", "--config", str(at.config), *arguments]
    runpy.run_module("pi_firmware", run_name="__main__", alter_sys=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
