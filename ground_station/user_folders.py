"""Where a user's own files belong, by the XDG base directory specification."""

from __future__ import annotations

import os
from pathlib import Path

from ground_station.errors import GroundStationError


def data() -> Path:
    """`blimp` in `$XDG_DATA_HOME`, else in `~/.local/share`: what a user would miss."""
    return _base("XDG_DATA_HOME", Path(".local") / "share") / "blimp"


def cache() -> Path:
    """`blimp` in `$XDG_CACHE_HOME`, else in `~/.cache`: what can be made again."""
    return _base("XDG_CACHE_HOME", Path(".cache")) / "blimp"


def _base(variable: str, default: Path) -> Path:
    """Raises `GroundStationError` with one line where nobody knows the user's home."""
    chosen = os.environ.get(variable)
    # The specification has relative paths ignored.
    if chosen and Path(chosen).is_absolute():
        return Path(chosen)
    try:
        return Path.home() / default
    except RuntimeError:  # no $HOME, and the system does not know this user
        raise GroundStationError(f"neither ${variable} nor $HOME is set") from None
