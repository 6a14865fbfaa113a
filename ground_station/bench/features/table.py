"""The figures of all extractors as one table of plain text."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ground_station.presentation.text import columns

_NONE = "-"


def table(rows: dict[str, dict[str, Any]]) -> list[str]:
    """Lines of the table: one row an extractor, a column only where some extractor has a figure.

    A row is what `command.run` collects: `dimension`, and where they were measured `homographies`
    and `time`.
    """
    scenes = dict.fromkeys(
        scene for row in rows.values() for scene in row.get("homographies", {}).get("scenes", {})
    )
    head: list[tuple[str, Callable[[dict[str, Any]], str]]] = [
        ("features", lambda row: str(row["name"])),
        ("numbers", lambda row: str(row["dimension"])),
        ("repeated", lambda row: _percent(row, "homographies", "repeatability")),
        ("correct at 3 px", lambda row: _percent(row, "homographies", "accuracy")),
        *((scene, _scene(scene)) for scene in scenes),
        ("homography 1, 3, 5 px", _homography),
        ("ms", lambda row: _number(row, "time", "ms", ".1f")),
        ("of RootSIFT's", lambda row: _number(row, "time", "ratio", ".2f")),
    ]
    lines = [[title for title, _ in head]]
    lines += [[cell(row) for _, cell in head] for row in rows.values()]
    used = [k for k in range(len(head)) if any(line[k] != _NONE for line in lines[1:])]
    return columns([[line[k] for k in used] for line in lines])


def _value(row: dict[str, Any], kind: str, key: str) -> float | None:
    """A figure that was measured; None also for one that is no number."""
    value = row.get(kind, {}).get(key)
    return value if isinstance(value, int | float) and math.isfinite(value) else None


def _percent(row: dict[str, Any], kind: str, key: str) -> str:
    value = _value(row, kind, key)
    return _NONE if value is None else f"{100 * value:.1f} %"


def _scene(scene: str) -> Callable[[dict[str, Any]], str]:
    def cell(row: dict[str, Any]) -> str:
        value = row.get("homographies", {}).get("scenes", {}).get(scene)
        return _NONE if value is None else f"{100 * value:.1f} %"

    return cell


def _homography(row: dict[str, Any]) -> str:
    shares = row.get("homographies", {}).get("homography", {})
    return ", ".join(f"{100 * share:.0f}" for share in shares.values()) + " %" if shares else _NONE


def _number(row: dict[str, Any], kind: str, key: str, form: str) -> str:
    value = _value(row, kind, key)
    return _NONE if value is None else format(value, form)
