"""Rows that took long are kept under what they depend on, so that a stopped bench goes on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ground_station.files import write_json

_VERSION = 1
"""Raised when the same inputs give other figures."""


def digest(paths: Iterable[Path]) -> str:
    """One hash of the names and contents of files."""
    whole = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").hexdigest()
        whole.update(f"{path.name}\0{content}\n".encode())
    return whole.hexdigest()


def row(
    folder: Path, depends_on: dict[str, Any], measure: Callable[[], dict[str, Any]]
) -> dict[str, Any]:
    """The row kept in `folder` for just these plain values, else the measured one, now kept.

    A file that was cut or is another's is measured anew.
    """
    text = json.dumps({"version": _VERSION, **depends_on}, sort_keys=True)
    path = folder / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.json"
    try:
        document = json.loads(path.read_text())
        if document["depends_on"] == json.loads(text):
            return dict(document["row"]) | {"kept": True}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        pass
    measured = measure()
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, {"depends_on": json.loads(text), "row": measured})
    return measured | {"kept": False}
