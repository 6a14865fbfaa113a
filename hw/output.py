"""Files of this room, written beside and renamed, so that a killed program leaves the old whole."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hw.quantities import HardwareError
from pi_firmware.wire import files
from pi_firmware.wire.errors import os_errors_as


def make_folder(path: Path) -> None:
    """Makes a folder with those above it; a disk's refusal is a `HardwareError`."""
    with os_errors_as(path, HardwareError):
        path.mkdir(parents=True, exist_ok=True)


def write(path: Path, produce: Callable[[Path], object]) -> None:
    """Lets `produce` write beside `path` and renames; a disk's refusal is a `HardwareError`."""
    make_folder(path.parent)
    with os_errors_as(path, HardwareError), files.replacing(path) as part:
        produce(part)


def write_text(path: Path, text: str) -> None:
    write(path, lambda part: part.write_text(text, encoding="utf-8"))


def write_json(path: Path, document: Any) -> None:
    write_text(path, json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False) + "\n")
