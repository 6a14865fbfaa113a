"""Writing files so that a killed program or a power cut leaves the old one whole."""

from __future__ import annotations

import json
import math
import os
import shlex
from pathlib import Path
from typing import Any

from ground_station.errors import GroundStationError, InputError
from pi_firmware.wire import files
from pi_firmware.wire.errors import os_errors_as


def check_outputs(*paths: str | Path | None, are_folders: bool = False) -> None:
    """Refuses before the work what could not be written after it; None is skipped.

    Raises `InputError` for a folder that is not there or not writable, or in the file's own place.
    """
    for path in paths:
        if path is None:
            continue
        folder = Path(path).resolve().parent
        if not folder.is_dir():
            make = f"mkdir -p {shlex.quote(str(Path(path).parent))}"
            raise InputError(f"{path}: its folder does not exist; make it: {make}")
        if not are_folders and Path(path).is_dir():
            raise InputError(f"{path}: is a folder; name a file in it")
        if not os.access(folder, os.W_OK):
            raise InputError(f"{path}: no permission to write in {folder}; name another place")


def check_new(path: Path, *, force: bool) -> None:
    """Refuses a file that is there already, unless with force, and what `check_outputs` does."""
    check_outputs(path)
    if path.exists() and not force:
        raise InputError(f"{path}: it exists already; --force overwrites it")


def read_bytes(
    path: str | Path, most_bytes: int, kind: type[GroundStationError] = InputError
) -> bytes:
    """What a file holds; raises an error of that kind, also where it is larger than that."""
    path = Path(path)
    with os_errors_as(path, kind):
        if path.exists() and not path.is_file():  # a device may have no end
            raise kind(f"{path}: not a file")
        with path.open("rb") as file:
            # As much as is asked for is set aside, whatever the file has.
            data = file.read(min(os.fstat(file.fileno()).st_size, most_bytes) + 1)
    if len(data) > most_bytes:
        raise kind(f"{path}: more than {most_bytes >> 20} MiB")
    return data


def write_bytes(path: str | Path, data: bytes) -> None:
    """Writes a file; raises `GroundStationError` with one line when the disk refuses."""
    path = Path(path)
    with os_errors_as(path, GroundStationError):
        files.write(path, data)


def write_text(path: str | Path, text: str) -> None:
    """Writes a text file in UTF-8, as `write_bytes` does."""
    write_bytes(path, text.encode())


def write_json(path: str | Path, document: Any) -> None:
    """Writes a document as JSON; a number that is not finite becomes null, which JSON can say."""
    write_text(path, json.dumps(finite(document), indent=2, allow_nan=False) + "\n")


def finite(value: Any) -> Any:
    """Plain values with null in place of numbers that are not finite."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
