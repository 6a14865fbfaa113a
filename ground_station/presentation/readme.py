"""A part of a README that a program makes, between two lines of comment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ground_station.errors import InputError
from ground_station.files import write_text


@dataclass(frozen=True)
class Block:
    """What stands between the lines `begin` and `end`."""

    begin: str
    end: str

    def read(self, text: str) -> str | None:
        """What a README's text has there; None without the two lines."""
        _, begun, rest = text.partition(self.begin)
        made, ended, _ = rest.partition(self.end)
        return made.strip("\n") + "\n" if begun and ended else None

    def write(self, readme: Path, made: str) -> None:
        """Replaces it in a README; raises `InputError` for one without the two lines."""
        text = readme.read_text(encoding="utf-8")
        before, begun, rest = text.partition(self.begin)
        _, ended, after = rest.partition(self.end)
        if not (begun and ended):
            raise InputError(f"{readme}: has no line '{self.begin}' with '{self.end}' after it")
        write_text(readme, f"{before}{self.begin}\n{made}{self.end}{after}")
