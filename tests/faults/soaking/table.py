"""A table of figures with their bounds, printed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One line of a table: a figure, its bound in words, and whether it holds."""

    name: str
    value: str
    bound: str = ""
    holds: bool = True


def show(rows: Iterable[Row]) -> None:
    """Prints the table."""
    for row in rows:
        verdict = ("ok" if row.holds else "MISSED") if row.bound or not row.holds else ""
        print(f"{row.name:38} {row.value:>42}  {row.bound:20} {verdict}".rstrip())
