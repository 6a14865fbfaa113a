"""Which release to start: a pure decision, and the cheap look at a release that it needs.

Imported at each start of the firmware: nothing heavier than `json` and `typing` in it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from deploy.board.releases import places
from deploy.board.releases.places import FACTORY, Places

STARTS = 3
"""A release under trial is started so often at most before it has shown that it works."""
FRAMELESS = 5
"""After so many starts in a row without a frame an update leaves its place to the one before."""

OF_IMAGE, UPDATE, FELL_BACK = "factory", "update", "fell back"
HEALTHY = "healthy"
RELEASE, MANIFEST = "release.json", "manifest.json"


class Choice(NamedTuple):
    """The release to start, how it came to be that one, and for a way back the reason."""

    name: str
    how: str
    reason: str = ""


class State(NamedTuple):
    """What the card says of its releases.

    `current` and `previous` are names ('' the image's release), `trial` and `last` the documents of
    those files, or None; `starts` counts those of the release under trial before this one, and is
    negative when they cannot be counted; `frameless` those since the last frame of an update.
    """

    current: str = FACTORY
    previous: str = FACTORY
    trial: dict[str, Any] | None = None
    last: dict[str, Any] | None = None
    starts: int = 0
    frameless: int = 0

    @property
    def on_trial(self) -> bool:
        """Whether the release in force still has to show that it works."""
        return self.trial is not None and self.trial["release"] == self.current


def choose(state: State, fault: Callable[[str], str]) -> Choice:
    """The release to start.

    `fault` says what is wrong with a release, '' for nothing; it is asked only of those that might
    be started, and never of the image's: what else is there?
    """
    order, reason = [state.current, state.previous], ""
    if state.on_trial and state.trial is not None:
        order = [state.current, state.trial["previous"]]
        if state.starts < 0:
            reason = f"{state.current}: its starts cannot be counted on /data/state"
            del order[0]
        elif state.starts >= STARTS:
            reason = f"{state.current}: started {STARTS} times without getting healthy"
            del order[0]
    elif state.frameless >= FRAMELESS and state.current != FACTORY:
        reason = f"{state.current}: no frame in {FRAMELESS} starts"
        del order[: state.frameless // FRAMELESS]  # and not for ever the one before
    for name in order:
        if name == FACTORY:
            break
        wrong = fault(name)
        if not wrong:
            return _choice_of(name, reason, state.last)
        reason = reason or f"{name}: {wrong}"
    return _choice_of(FACTORY, reason, state.last)


def _choice_of(name: str, reason: str, last: dict[str, Any] | None) -> Choice:
    """An update that failed is told until another one is in force."""
    if not reason and last is not None and last["outcome"] == FELL_BACK:
        reason = last["reason"] if last["previous"] == name else ""
    if reason:
        return Choice(name, FELL_BACK, reason)
    return Choice(name, OF_IMAGE if name == FACTORY else UPDATE)


def read_state(at: Places) -> State:
    """What the card says; damaged files are as absent ones."""
    trial = read_trial(at)
    return State(
        at.linked("current"),
        at.linked("previous"),
        trial,
        read_last(at),
        starts_of(at.starts, trial["id"]) if trial else 0,
        starts_of(at.frameless, at.linked("current")),
    )


def read_trial(at: Places) -> dict[str, Any] | None:
    """The trial under way: `id`, `release`, `previous`, `boot_id`, `started_s`, `telemetry`."""
    trial = _texts(places.read(at.trial), "id", "release", "previous", "boot_id")
    if trial is None or not places.is_name(trial["release"]):
        return None
    if trial["previous"] and not places.is_name(trial["previous"]):
        return None
    started_s = trial.get("started_s")
    trial["started_s"] = float(started_s) if isinstance(started_s, int | float) else 0.0
    trial["telemetry"] = trial.get("telemetry") is True
    return trial


def read_last(at: Places) -> dict[str, Any] | None:
    """What became of the last update: `id`, `release`, `previous`, `outcome`, `reason`."""
    last = _texts(places.read(at.last), "id", "release", "previous", "outcome", "reason")
    return last if last and last["outcome"] in (HEALTHY, FELL_BACK) else None


def starts_of(path: Path, of: str) -> int:
    """How many starts of a trial or release a file counts."""
    found = places.read(path)
    if found is None or found.get("id") != of:
        return 0
    starts = found.get("starts")
    return starts if isinstance(starts, int) and 0 <= starts < 1000 else STARTS


def size_fault(at: Places, name: str) -> str:
    """What a look at names and sizes finds wrong with a release on /data; '' for nothing."""
    folder = at.folder(name)
    if folder.is_symlink() or not folder.is_dir():
        return "it is not there"
    manifest = places.read(folder / MANIFEST)
    if manifest is None:
        return f"{MANIFEST} is damaged"
    try:
        for path, size, *_ in manifest["files"]:
            if (folder / path).stat().st_size != size:
                return f"{path} is damaged"
    except FileNotFoundError:
        return f"{path} is missing"
    except (OSError, KeyError, TypeError, ValueError):
        return f"{MANIFEST} or a file in it is damaged"
    return ""


def _texts(document: dict[str, Any] | None, *names: str) -> dict[str, Any] | None:
    if document is None or not all(isinstance(document.get(name), str) for name in names):
        return None
    return document
