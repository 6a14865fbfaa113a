"""Which release this program is: what the card's start says in `BLIMP_RELEASE`, or nothing."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass

from pi_firmware import __version__
from pi_firmware.wire.text import printable

ENVIRONMENT = "BLIMP_RELEASE"
_LONGEST = 300


@dataclass(frozen=True)
class Release:
    """This program's version and how it came to run.

    `how` is `factory` (it came with the card's image), `update`, `fell back` (an update did not
    work, `reason` says why), or empty outside of a card.
    """

    version: str = __version__
    how: str = ""
    reason: str = ""

    def __str__(self) -> str:
        told = f"version {self.version}" + (f" ({self.how})" if self.how else "")
        return f"{told}: {self.reason}" if self.reason else told


def of_environment(environment: Mapping[str, str] = os.environ) -> Release:
    """What the environment says; anything that is not as agreed counts as absent.

    The version is the release's, which names the commit; a release that says another version than
    this program's own is told with both.
    """
    try:
        told = json.loads(environment.get(ENVIRONMENT, ""))
        version, how, reason = (_clean(told[name]) for name in ("version", "how", "reason"))
    except (ValueError, KeyError, TypeError, RecursionError):
        return Release()
    if not version:
        version = __version__
    elif version.partition("+")[0] != __version__:
        version = f"{__version__} in {version}"
    return Release(version, how, reason)


def _clean(text: object) -> str:
    if not isinstance(text, str):
        raise ValueError("not text")
    return printable(text, _LONGEST)
