"""Instructions by groups of shared objects, from the profile that valgrind's callgrind writes.

The format is Valgrind's "Callgrind Format Specification": cost lines belong to the last `ob=`,
names are written once and referred to as `(id)`, and the line behind `calls=` is the callee's.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ground_station.errors import GroundStationError

_NAME = re.compile(r"(c?)(ob|fn)=(?:\((\d+)\))? ?(.*)")
_CALLS_DEEP = 20
MADE_AT_RUN_TIME = "???"
"""Callgrind's name of code that lies in no file, as GStreamer's orc writes it."""

# What others call and what says nothing by itself: a copy is the cost of who wants it, and with
# libgstvideo both the scaling and the test picture convert.
_HELPERS = re.compile(r"/(libc|libm|ld-linux[^/]*|libpthread|libgstvideo)[.-][^/]*$|^\?\?\?$")

_GROUPS = (
    ("x264", r"/libx264"),
    ("test picture", r"/libgstvideotestsrc"),
    ("GStreamer", r"/libgst|/gstreamer-1\.0/|/liborc"),
    ("SRTP", r"/libsrtp|/libcrypto|/libssl"),
    ("numpy", r"/numpy/|/numpy\.libs/"),
    ("Zenoh", r"/zenoh"),
    ("bindings (gi, GLib)", r"/gi/|/libgirepository|/libg(object|lib|io|module)-|/libffi"),
    ("Python", r"/libpython3|/bin/python3|/lib-dynload/"),
)
OTHER = "other"
GROUPS = (*(name for name, _ in _GROUPS), OTHER)
"""The rows of the table, in this order."""


class ProfileError(GroundStationError):
    """A profile that is cut or not callgrind's."""


class Code(NamedTuple):
    """A function and the path of the object that it lies in."""

    object: str
    function: str


@dataclass(frozen=True)
class Profile:
    """Instructions by function: `own` those of its code, `called` those of calls, (caller, callee).

    A call's are all until its return, whoever's code they are.
    """

    own: Counter[Code]
    called: Counter[tuple[Code, Code]]


def read(path: Path) -> Profile:
    """Reads one file; raises `ProfileError` with one line, for one when it is not whole."""
    own: Counter[Code] = Counter()
    called: Counter[tuple[Code, Code]] = Counter()
    names: dict[tuple[str, str], str] = {}
    now = {"ob": MADE_AT_RUN_TIME, "fn": ""}
    callee: dict[str, str] = {}
    is_call = False
    positions, totals, at = 1, None, 0
    try:
        with path.open(encoding="utf-8", errors="replace") as lines:
            for at, line in enumerate(lines, 1):  # noqa: B007
                if line[0] in "0123456789+-*":
                    fields = line.split()
                    cost = int(fields[positions]) if len(fields) > positions else 0
                    caller = Code(now["ob"], now["fn"])
                    if is_call:
                        called[caller, Code(callee.get("ob", now["ob"]), callee["fn"])] += cost
                        callee, is_call = {}, False
                    else:
                        own[caller] += cost
                elif match := _NAME.match(line):
                    side, kind, key, name = match.groups()
                    if key is not None:
                        name = names.setdefault((kind, key), name) if name else names[kind, key]
                    (callee if side else now)[kind] = name
                elif line.startswith("calls="):
                    is_call = True
                elif line.startswith("positions:"):
                    positions = len(line.split()) - 1
                elif line.startswith("events:") and line.split()[1:2] != ["Ir"]:
                    raise ProfileError(f"{path}: counts {line[8:].strip()!r}, not instructions")
                elif line.startswith("totals:"):
                    totals = (totals or 0) + int(line.split()[1])
    except OSError as error:
        raise ProfileError(f"{path}: {error.strerror or error}") from None
    except (ValueError, KeyError, IndexError):
        raise ProfileError(f"{path}, line {at}: no record of callgrind's") from None
    if totals is None or totals != own.total():
        found = "no total" if totals is None else f"a total of {totals}"
        raise ProfileError(f"{path}: cut: {own.total()} instructions and {found}")
    return Profile(own, called)


def by_group(profile: Profile) -> dict[str, float]:
    """Instructions by `GROUPS`, where shared libraries and code made at run time fall to callers.

    Each caller of such a function bears its own instructions by its share of the instructions of
    all calls to it, and where that is such a function, too, its callers do. What nothing is known
    to call is `OTHER`.
    """
    callers: dict[Code, Counter[Code]] = {}
    for (caller, callee), whole in profile.called.items():
        if _HELPERS.search(callee.object) and caller != callee:
            callers.setdefault(callee, Counter())[caller] += whole
    result = dict.fromkeys(GROUPS, 0.0)
    left: dict[Code, float] = {code: float(cost) for code, cost in profile.own.items()}
    for _ in range(_CALLS_DEEP):
        sustained: dict[Code, float] = defaultdict(float)
        for code, cost in left.items():
            shares = callers.get(code)
            if shares is None or not shares.total():
                result[group_of(code.object)] += cost
                continue
            for caller, share in shares.items():
                sustained[caller] += cost * share / shares.total()
        left = sustained
    result[OTHER] += sum(left.values())  # functions that call each other in a ring
    return result


def group_of(name: str) -> str:
    """The group of an object, by its path."""
    return next((group for group, pattern in _GROUPS if re.search(pattern, name)), OTHER)
