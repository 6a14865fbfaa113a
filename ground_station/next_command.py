"""What a command says at its end: `next: COMMAND    (why)`."""

from __future__ import annotations

import argparse
import re
import shlex

_PLACE = re.compile(r"\{([a-z_|]+)\}")


def of(args: argparse.Namespace) -> str:
    """The command to give next, of a parsed command line: its `next` with its own values in it.

    Each command has `next` among its parser's defaults, and its `run` may put another in place.
    `{out|map}` stands for the first of these arguments that was given; "" where none was.
    """
    lacks = False

    def value(place: re.Match[str]) -> str:
        nonlocal lacks
        given = [getattr(args, name) for name in place[1].split("|")]
        found = next((one for one in given if one not in (None, [])), None)
        lacks |= found is None
        return shlex.join(map(str, found)) if isinstance(found, list) else shlex.quote(str(found))

    filled = _PLACE.sub(value, args.next)
    return "" if lacks else filled
