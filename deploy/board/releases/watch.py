"""Decides within three minutes whether a new release stays, and goes back when it does not.

Healthy is: frames leave the encoder within two minutes (READY=1 of sd_notify, which the firmware
says then and only then) and keep coming for one (or its watchdog ends it), and the ground station
hears it if it did before.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from deploy.board.releases import choose, manifest, places, shelf
from deploy.board.releases.choose import FELL_BACK, HEALTHY, MANIFEST
from deploy.board.releases.places import FACTORY, Places
from deploy.board.releases.service import Seen, Service

LIMIT_S = 120.0
# An emulated processor takes minutes to load the firmware. Below the unit's TimeoutStartSec.
_LIMITS_S = {"qemu": 220.0}
STEADY_S = 60.0
_LOOK_S = 1.0
_RESTART_S = 30.0
_AT_IT = ("activating", "deactivating")


def decide(
    trial: dict[str, Any],
    running: dict[str, Any],
    seen: Seen,
    elapsed_s: float,
    limit_s: float = LIMIT_S,
) -> tuple[str, str]:
    """`HEALTHY`, or `FELL_BACK` with the reason, or '' while it is open.

    `running` is what start.py said of the firmware's last start, `elapsed_s` is since the first
    start in this boot.
    """
    release = trial["release"]
    started = running.get("trial") == trial["id"]
    if started and running.get("name") != release:
        return FELL_BACK, str(running.get("reason") or f"{release}: not started")
    if started and seen.restarts:
        return FELL_BACK, f"{release}: the firmware ended by itself ({seen.said})"
    lacks, until_s = f"not steady within {limit_s + STEADY_S:g} s", limit_s + STEADY_S
    if not started or not seen.active:
        lacks, until_s = f"no frames within {limit_s:g} s ({seen.said})", limit_s
    elif trial["telemetry"] and not seen.telemetry:
        lacks = f"the ground station does not hear it within {until_s:g} s, and did before"
    elif seen.active_s >= STEADY_S:
        return HEALTHY, ""
    return ("", "") if elapsed_s < until_s else (FELL_BACK, f"{release}: {lacks}")


def watch(
    at: Places,
    service: Service,
    log: Callable[[str], None],
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Watches the trial that is under way to its end; without one it does nothing."""
    with shelf.lock(at):
        trial = shelf.settle(at, service)
        if trial is None:
            return
        limit_s = limit_of(at)
        boot_id, now_s = at.this_boot(), at.uptime_s()
        first = trial["boot_id"] == ""
        if trial["boot_id"] != boot_id or now_s < trial["started_s"]:
            trial |= {"boot_id": boot_id or "unknown", "started_s": now_s}
            places.write(at.trial, trial)
        before = trial["previous"] or "the image's"
        log(f"{trial['release']} is on trial, after {before}")
        # A board that comes back from a power cut starts the firmware itself.
        if first:
            service.restart()
        restarted_s = at.uptime_s()
        while True:
            running = places.read(at.running) or {}
            seen, waited_s = service.seen(), at.uptime_s() - restarted_s
            # Nobody started it: the watcher before this one was killed just then. A slow board
            # that is at it is left alone.
            missed = running.get("trial") != trial["id"] and not seen.said.startswith(_AT_IT)
            if missed and waited_s >= _RESTART_S:
                service.restart()
                restarted_s = at.uptime_s()
            elapsed_s = at.uptime_s() - trial["started_s"]
            outcome, reason = decide(trial, running, seen, elapsed_s, limit_s)
            if outcome:
                break
            sleep(_LOOK_S)
        log(f"{trial['release']}: {outcome}{f': {reason}' if reason else ''}")
        shelf.finish(at, service if outcome == FELL_BACK else None, trial, outcome, reason)


def verify(at: Places, service: Service) -> str:
    """Goes back from a release of which the card reads other bytes than it was given; '' if none.

    What lies there compiled is in no list. An armed vehicle flies on with what it has loaded, and
    its next start is another release's.
    """
    with shelf.lock(at):
        name = at.linked("current")
        if shelf.settle(at, service) is not None or shelf.in_force(at)[0] == FACTORY:
            return ""
        folder = at.folder(name)
        fault = shelf.hash_fault(folder, manifest.parse((folder / MANIFEST).read_bytes()))
        if fault:
            ended = {"id": "", "release": name, "previous": at.linked("previous")}
            restarts = None if service.seen().armed else service
            shelf.finish(at, restarts, ended, FELL_BACK, f"{name}: {fault}")
        return fault


def limit_of(at: Places) -> float:
    """How long a new release has on this card to send its first frames, s."""
    return _LIMITS_S.get(_board(at), LIMIT_S)


def _board(at: Places) -> str:
    return str((places.read(at.board) or {}).get("board", ""))


def status(at: Places) -> dict[str, Any]:
    """What runs, what is on trial and what became of the last update, for JSON."""
    current, release = shelf.in_force(at)
    trial = choose.read_trial(at)
    return {
        "schema": "blimp.releases/1",
        "board": _board(at),
        "limit_s": limit_of(at) + STEADY_S,
        "in_force": {"name": current, **release._asdict()},
        "factory": manifest.load_release(at.factory)._asdict(),
        "running": places.read(at.running),
        "trial": trial["id"] if trial else "",
        "last": choose.read_last(at),
    }
