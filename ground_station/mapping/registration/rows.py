"""Rows of the tables that a person writes for a registration: CSV with named columns."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from ground_station.errors import MapError

_MOST_BYTES = 32 << 20
_LARGEST = 1e7
"""Of any number in such a table, metres or pixels: beyond, somebody mistook a column."""


def read_rows(
    path: str | Path, columns: Sequence[str], what: str
) -> list[tuple[str, dict[str, str | None]]]:
    """A table's rows, each with where it stands for messages ("FILE, `what` 3").

    Lines that are empty or begin with `#` are left out. Raises `MapError` with one line for a file
    that cannot be read, is not text or lacks one of the `columns`.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise MapError(f"{path}: more than {_MOST_BYTES} bytes, which no such table has")
        text = data.decode("utf-8-sig")
    except OSError as error:
        raise MapError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise MapError(f"{path}: not a text file") from None
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    reader = csv.DictReader(lines)
    try:
        missing = [name for name in columns if name not in (reader.fieldnames or ())]
        if missing:
            raise MapError(
                f"{path}: the column '{missing[0]}' is missing (needed: {','.join(columns)})"
            )
        return [(f"{path}, {what} {k}", row) for k, row in enumerate(reader, start=1)]
    except csv.Error as error:
        raise MapError(f"{path}: {error}") from None


def numbers(row: Mapping[str, str | None], names: Sequence[str], where: str) -> list[float]:
    """The numbers of a row in the columns `names`; raises `MapError` for what is none."""
    try:
        values = [float(row[name] or "") for name in names]
    except ValueError:
        raise MapError(f"{where}: numbers are needed in {', '.join(names)}") from None
    for name, value in zip(names, values, strict=True):
        if not math.isfinite(value):
            raise MapError(f"{where}: {name} is {value}; a number that is not finite is none")
        if abs(value) > _LARGEST:
            raise MapError(f"{where}: {name} is {value:g}; allowed: up to {_LARGEST:g}")
    return values


def word(row: Mapping[str, str | None], name: str, where: str) -> str:
    """The text of a row in the column `name`; raises `MapError` where it is empty."""
    text = (row[name] or "").strip()
    if not text:
        raise MapError(f"{where}: the column '{name}' is empty")
    return text
