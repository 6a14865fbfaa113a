"""What `blimp map` prints: names and values, a line each."""

from __future__ import annotations

from typing import Any


def print_table(document: dict[str, Any]) -> None:
    """Prints what is not empty."""
    for name, value in document.items():
        if value is None or value == {} or value == []:
            continue
        if isinstance(value, float):
            value = f"{value:.6g}"
        elif isinstance(value, dict):
            value = ", ".join(f"{key} {number}" for key, number in value.items())
        elif isinstance(value, list):
            value = ", ".join(map(str, value))
        print(f"{name:<28} {value}")
