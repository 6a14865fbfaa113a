"""The releases on /data as root changes them: one at a time, and every step can be repeated."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from deploy.board.releases import choose, manifest, places
from deploy.board.releases.choose import FELL_BACK, HEALTHY, size_fault
from deploy.board.releases.manifest import Manifest, Release
from deploy.board.releases.places import FACTORY, Places
from deploy.board.releases.service import Service
from deploy.errors import DeployError

_LOCK_S = 30.0
_REASON = 300


@contextlib.contextmanager
def lock(at: Places, wait_s: float = _LOCK_S) -> Iterator[None]:
    """One program changes releases at a time; raises `DeployError` when another does not end."""
    at.releases.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(at.releases / ".lock", os.O_RDWR | os.O_CREAT, 0o600)
    try:
        until_s = time.monotonic() + wait_s
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > until_s:
                    raise DeployError("another update is under way on this card") from None
                time.sleep(0.2)
        yield
    finally:
        os.close(descriptor)


def in_force(at: Places) -> tuple[str, Release]:
    """Name and release.json of what would run now; the image's when an update is damaged."""
    name = at.linked("current")
    if name != FACTORY and not size_fault(at, name):
        with contextlib.suppress(DeployError):
            return name, manifest.load_release(at.folder(name))
    return FACTORY, manifest.load_release(at.factory)


def begin(at: Places, name: str, *, telemetry: bool) -> str:
    """Switches to a release that lies in its folder, on trial; gives the trial's id.

    `telemetry` says whether the ground station hears the payload now, and so must afterwards.
    """
    trial = os.urandom(8).hex()
    document = {
        "schema": "blimp.trial/1",
        "id": trial,
        "release": name,
        "previous": at.linked("current"),
        "boot_id": "",  # the watcher has not begun
        "started_s": 0.0,
        "telemetry": telemetry,
    }
    places.write(at.trial, document)
    at.point("current", name)
    return trial


def settle(at: Places, service: Service) -> dict[str, Any] | None:
    """Finishes what a power cut left half done; gives the trial that is still going on."""
    trial = choose.read_trial(at)
    if trial is None:
        places.remove(at.trial)
        return None
    last = choose.read_last(at)
    if last is not None and last["id"] == trial["id"]:
        finish(at, service, trial, last["outcome"], last["reason"])
        return None
    if at.linked("current") != trial["release"]:
        finish(at, None, trial, FELL_BACK, f"{trial['release']}: interrupted before the switch")
        return None
    return trial


def finish(
    at: Places, service: Service | None, trial: dict[str, Any], outcome: str, reason: str
) -> None:
    """Ends a trial: stays, or goes back; the reason is on the card before anything changes."""
    last = {
        "schema": "blimp.last/1",
        "id": trial["id"],
        "release": trial["release"],
        "previous": trial["previous"],
        "outcome": outcome,
        "reason": reason[:_REASON],
    }
    places.write(at.last, last)
    if outcome == HEALTHY:
        at.point("previous", trial["previous"])
    else:
        at.point("current", trial["previous"])
        if service is not None:
            service.restart()
    places.remove(at.trial)
    prune(at)


def prune(at: Places) -> None:
    """Takes away all but the release in force and the one before it, and what was half written."""
    trial = choose.read_trial(at)
    kept = {at.linked("current"), at.linked("previous"), trial["release"] if trial else FACTORY}
    for path in sorted(at.releases.iterdir()):
        if path.is_dir() and not path.is_symlink():
            if path.name not in kept:
                discard(path)
        elif path.suffix == ".part":
            path.unlink()


def discard(folder: Path) -> None:
    """Takes a release away; one that is half gone has no release's name any more."""
    if folder.suffix != ".part":
        old = folder.with_name(folder.name + ".old.part")
        shutil.rmtree(old, ignore_errors=True)
        folder = folder.rename(old)
    shutil.rmtree(folder)


def hash_fault(folder: Path, listed: Manifest) -> str:
    """What reading every file of a release back from the card finds wrong; '' for nothing."""
    for file in listed.files:
        path = folder / file.path
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)  # not what memory kept
            os.close(descriptor)
            good = manifest.sha256_of(path) == file.sha256
        except OSError as error:
            return f"{file.path}: {error.strerror}"
        if not good:
            return f"{file.path}: the card reads other bytes than it was given"
    return ""
