"""Sizes against accuracy as tables of plain text, a table a flight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from ground_station.presentation.text import columns

_HEAD = (
    "landmarks", "bytes each", "kB", "of whole", "tables", "of whole",
    "ATE, cm", "of whole", "localized", "found", "wrong", "time of whole",
)  # fmt: skip


def tables(rows: Sequence[dict[str, Any]], flights: dict[str, dict[str, Any]]) -> list[str]:
    """Lines; the first row is the whole map, which the others are shares of.

    A row has `name` and what `measure.row` gives; `flights` say by name `frames` and whether they
    are `simulated`.
    """
    lines: list[str] = []
    for name, about in flights.items():
        kind = "simulated flight" if about["simulated"] else "flight"
        lines += ["", f"{kind} '{name}', {about['frames']} frames"]
        lines += columns([["map", *_HEAD], *(_cells(row, rows[0], name) for row in rows)])
    return [
        *lines,
        "",
        "kB: the whole map; tables: landmarks and keyframes, what the localizer reads; ATE: "
        "unaligned RMSE;",
        "found, wrong: of frames that are looked for in the whole map without a guess",
    ]


def tables_bytes(row: dict[str, Any]) -> int:
    """The bytes that the localizer reads."""
    return int(row["bytes"]["landmarks"] + row["bytes"]["keyframes"])


def _cells(row: dict[str, Any], whole: dict[str, Any], flight: str) -> list[str]:
    mine, first = row["flights"][flight], whole["flights"][flight]
    total, tables = row["bytes"]["total"], tables_bytes(row)
    return [
        row["name"],
        str(row["landmarks"]),
        str(row["descriptor_bytes"]),
        f"{total / 1e3:.0f}",
        _percent(total / whole["bytes"]["total"]),
        f"{tables / 1e3:.0f}",
        _percent(tables / tables_bytes(whole)),
        "-" if math.isnan(mine["rmse_m"]) else f"{1e2 * mine['rmse_m']:.2f}",
        _percent(mine["rmse_m"] / first["rmse_m"] if first["rmse_m"] else math.nan),
        f"{mine['localized_share']:.1%}",
        _percent(mine["found_share"]),
        _percent(mine["wrong_share"]),
        _percent(mine["ms"] / first["ms"] if first["ms"] else math.nan),
    ]


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{share:.0%}"
