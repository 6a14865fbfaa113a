"""What the project says of itself, held against a run's figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ground_station.experiments.declaration import Claim

NOT_MEASURED = "not measured"
_UNITS = {"m": " m", "deg": "°", "s": " s", "95": ""}
"""By the end of a figure's name."""


def judge(claims: Sequence[Claim], experiments: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each claim with its figure, as plain values; `kept` is None where no run tells.

    A figure that runs should have and some have not, as the time of a recovery that never came,
    keeps nothing. Claims of experiments that were not wanted are left out.
    """
    cases = {(e["name"], c["name"]): c for e in experiments for c in e["cases"]}
    found = []
    for claim in claims:
        named = [_key(row) for row in (claim.row, claim.against) if row]
        if not all(key in cases for key in named):
            continue
        values = [_value(cases[key], claim) for key in named]
        value: float | None = None
        if None not in values:
            value = values[0] if len(values) == 1 else _ratio(*values)
        measured = not any(_unmeasured(cases[key], claim) for key in named)
        kept = value is not None and _within(value, claim) if measured else None
        unit = " times" if claim.against else _UNITS[claim.figure.rpartition("_")[2]]
        found.append({"text": claim.text, "value": value, "most": claim.most, "least": claim.least,
                      "kept": kept, "unit": unit})  # fmt: skip
    return found


def line(claim: dict[str, Any]) -> str:
    """A claim and what was measured, in a sentence."""
    if claim["kept"] is None:
        return f"{claim['text']}: {NOT_MEASURED}."
    unit = claim["unit"]
    told = "no figure in some run" if claim["value"] is None else f"{claim['value']:.3g}{unit}"
    word = "kept" if claim["kept"] else "not kept"
    side, bound = ("most", claim["most"]) if claim["least"] is None else ("least", claim["least"])
    return f"{claim['text']}: {word}, {told} (at {side} {bound:g}{unit})."


def _key(row: str) -> tuple[str, str]:
    experiment, _, case = row.partition(".")
    return experiment, case


def _value(case: dict[str, Any], claim: Claim) -> float | None:
    """None where a run has no such figure."""
    row = case["presets"].get(claim.preset)
    found = None if row is None else row[claim.figure]
    if row is None or found is None or found["n"] < len(row["runs"]):
        return None
    return float(found[claim.statistic])


def _ratio(value: float | None, unit: float | None) -> float | None:
    return value / unit if value is not None and unit else None


def _unmeasured(case: dict[str, Any], claim: Claim) -> bool:
    row = case["presets"].get(claim.preset)
    return row is None or bool(row["failed"])


def _within(value: float, claim: Claim) -> bool:
    above = claim.least is None or value >= claim.least
    return above and (claim.most is None or value <= claim.most)
