"""What the project says of itself, held against a run's figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ground_station.experiments.declaration import Claim

NOT_MEASURED = "not measured"
_UNITS = {"m": " m", "deg": "°", "s": " s", "95": ""}
"""By the end of a figure's name."""
_OVER_RUNS: dict[str, Callable[..., Any]] = {
    "mean": np.mean, "min": min, "max": max, "median": np.median,
    "p95": lambda values: np.percentile(values, 95),
}  # fmt: skip


def judge(claims: Sequence[Claim], experiments: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each claim with its figure, as plain values; `kept` is None where no run tells.

    A figure that runs should have and some have not, as the time of a recovery that never came,
    keeps nothing. Claims of experiments that were not wanted are left out.
    """
    cases = {f"{e['name']}.{c['name']}": [c] for e in experiments for c in e["cases"]}
    cases |= {e["name"]: e["cases"] for e in experiments}
    found = []
    for claim in claims:
        named = [row for row in (claim.row, claim.against) if row]
        if not all(row in cases for row in named):
            continue
        runs = [[run for case in cases[row] for run in _runs(case, claim)] for row in named]
        values = [_value(of, claim) for of in runs]
        value = values[0]
        if value is not None and claim.against:
            value = value / values[1] if values[1] else None
        measured = all(of and not any("failed" in run for run in of) for of in runs)
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


def _runs(case: dict[str, Any], claim: Claim) -> list[dict[str, Any]]:
    return list(case["presets"].get(claim.preset, {"runs": []})["runs"])


def _value(runs: Sequence[dict[str, Any]], claim: Claim) -> float | None:
    """None where a run has no such figure."""
    numbers = [run.get(claim.figure) for run in runs]
    if not numbers or None in numbers:
        return None
    return float(_OVER_RUNS[claim.statistic](numbers))


def _within(value: float, claim: Claim) -> bool:
    above = claim.least is None or value >= claim.least
    return above and (claim.most is None or value <= claim.most)
