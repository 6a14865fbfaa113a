"""The bounds of a recorder, by the names that both sides' `[recording]` tables have."""

from __future__ import annotations

from typing import Protocol


class Limits(Protocol):
    """What a recorder keeps to; each side's settings are one."""

    @property
    def folder(self) -> str:
        """Where recordings go; empty: none are made."""
        ...

    @property
    def max_file_MB(self) -> int:
        """A file ends at this size."""
        ...

    @property
    def max_total_MB(self) -> int:
        """The oldest files are deleted beyond it."""
        ...

    @property
    def min_free_MB(self) -> int:
        """What is left free on the disk."""
        ...

    @property
    def sync_s(self) -> float:
        """The most that a power cut costs."""
        ...
